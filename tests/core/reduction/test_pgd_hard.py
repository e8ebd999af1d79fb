"""PGD at the edge: one sweep, no load, full rank, only rounding left, ends of ranges, 1 to 5."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf, nan, nextafter

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.sparse.linalg import aslinearoperator

from avatar_core.errors import ConvergenceError, CoordinateError
from avatar_core.fem.elasticity import Elasticity, Inclusion, Material
from avatar_core.fem.patch_loads import load_surface, patch_loads
from avatar_core.offline.parametric import build_parametric_vademecum
from avatar_core.offline.rule import BuildRule
from avatar_core.reduction import pgd
from avatar_core.reduction import pgd_parametric as canonical
from avatar_core.reduction.affine import AffineProblem, CanonicalField, Samples
from avatar_core.reduction.affine_elasticity import affine_problem, gauss_nodes
from avatar_core.reduction.coordinates import Coordinate, problem_at
from avatar_core.reduction.pgd_hadamard import solve_hadamard
from avatar_core.vademecum.at_values import at_values
from avatar_core.vademecum.model import Provenance, Vademecum
from tests.helpers.elastic_shapes import cube, regions_of
from tests.helpers.examples import examples

Figure = Callable[[str], None]

N, N_LOADS, N_NODES = 12, 6, 4  # places, loads, nodes of a parameter
EXACT = canonical.CanonicalPGDRule(
    30, 0.0, max_sweeps=50, sweep_tolerance=1e-4, solve_tolerance=1e-10, stall=60
)


def manufactured(n_coordinates: int, rank: int, seed: int = 0) -> tuple[AffineProblem, np.ndarray]:
    """(K_0 + sum_d p_d K_d) u = f, with f made for a u of known rank, and that u at all nodes."""
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((n_coordinates + 1, N, N))
    terms = [root @ root.T / N + 0.3 * np.eye(N) for root in roots]
    values = np.linspace(0.5, 2.0, N_NODES)
    factors = tuple(
        np.array([values if q == d + 1 else np.ones(N_NODES) for q in range(len(terms))])
        for d in range(n_coordinates)
    )
    known = CanonicalField(
        np.linalg.qr(rng.standard_normal((N, rank)))[0] * 3.0 ** -np.arange(rank),
        np.linalg.qr(rng.standard_normal((N_LOADS, rank)))[0],
        tuple(rng.uniform(0.5, 1.5, (N_NODES, rank)) for _ in range(n_coordinates)),
    )
    pairs = [(q, k) for q in range(len(terms)) for k in range(rank)]
    sources = [np.outer(terms[q] @ known.space[:, k], known.load[:, k]) for q, k in pairs]
    along = zip(factors, known.parameters, strict=True)
    problem = AffineProblem(
        terms=tuple(map(aslinearoperator, terms)),
        sources=tuple(map(aslinearoperator, sources)),
        factors=factors,
        source_factors=tuple(np.array([f[q] * p[:, k] for q, k in pairs]) for f, p in along),
        load_weights=np.ones(N_LOADS),
        weights=n_coordinates * (np.full(N_NODES, 1.0 / N_NODES),),
        precondition=aslinearoperator(np.linalg.inv(sum(terms[1:], terms[0]))),
    )
    return problem, everywhere(known)


def everywhere(field: CanonicalField) -> np.ndarray:
    """A field at all loads and nodes, shape (n, n_loads, nodes of each parameter ...)."""
    letters = "abcde"[: len(field.parameters)]
    pattern = f"xk,sk,{','.join(letter + 'k' for letter in letters)}->xs{letters}"
    return np.einsum(pattern, field.space, field.load, *field.parameters, optimize=True)


def off(field: CanonicalField, exact: np.ndarray) -> float:
    """Relative error over all loads and nodes."""
    return float(np.linalg.norm(everywhere(field) - exact) / np.linalg.norm(exact))


@pytest.fixture(scope="module")
def block() -> Elasticity:
    mesh = cube(3)
    return Elasticity(mesh, Material(), regions_of(mesh).clamped)


def of_rank(
    elasticity: Elasticity, rank: int, n_loads: int, decay: float = 0.5
) -> tuple[pgd.LoadProblem, np.ndarray]:
    """Loads that are combinations of ``rank`` forces, and their exact displacements."""
    rng = np.random.default_rng(rank)
    force = rng.standard_normal((3 * elasticity.n_nodes, rank))
    force.reshape(-1, 3, rank)[elasticity.clamped_nodes] = 0.0
    mixing = rng.standard_normal((rank, n_loads)) * decay ** np.arange(rank)[:, None]
    loads = force @ mixing
    exact = elasticity.solve(loads)
    energy = np.einsum("ij,ij->j", loads, exact)
    problem = pgd.LoadProblem(elasticity, sp.csr_matrix(loads), 1.0 / energy, energy)
    return problem, exact


# --- one allowed sweep ------------------------------------------------------------------------


def test_one_sweep_over_coordinates_is_reported(figure: Figure) -> None:
    """Each product says that it was cut short, and still lowers the energy of the error."""
    problem, exact = manufactured(2, 3)
    rule = replace(EXACT, max_modes=8, max_sweeps=1)
    found = canonical.solve_canonical_pgd(problem, rule)
    assert [step.outcome for step in found.history] == 8 * [canonical.Outcome.SWEEP_LIMIT]
    assert [step.sweeps for step in found.history] == 8 * [1]
    assert found.outcome is canonical.Outcome.MODE_LIMIT
    assert not found.converged
    met = canonical.solve_canonical_pgd(
        problem, replace(rule, tolerance=0.9)
    )  # by a product that was cut short
    assert met.outcome is canonical.Outcome.CONVERGED
    assert not met.converged
    terms = np.array([k @ np.eye(N) for k in problem.terms])
    energies = []
    for rank in range(1, 9):
        left = (
            everywhere(canonical.solve_canonical_pgd(problem, replace(rule, max_modes=rank)).field)
            - exact
        )
        forces = np.einsum("qa,qb,qxy,ysab->xsab", *problem.factors, terms, left, optimize=True)
        energies.append(float((left * forces).sum()))
    figure(
        f"8 of 8 say so; energy of the error down to {energies[-1] / energies[0]:.1e} of the first"
    )
    assert (np.diff(energies) < 0.0).all()


def test_one_sweep_over_loads_is_reported(block: Elasticity, figure: Figure) -> None:
    """The energy error that it states is the true one all the same."""
    problem, exact = of_rank(block, 12, 20)
    rule = pgd.PGDRule(6, 0.0, block=2, max_sweeps=1)
    found = pgd.solve_pgd(problem, rule)
    assert {step.status for step in found.history} == {pgd.EnrichmentStatus.SWEEP_LIMIT}
    assert not found.converged
    left = exact - found.space @ found.load.T
    energy = np.einsum("ij,ij->j", left, block.apply(left))
    true = np.sqrt(problem.weights @ energy / (problem.weights @ problem.energy))
    stated = [step.energy_error for step in found.history]
    figure(f"3 of 3 say so; energy error {stated[-1]:.2%}, true {true:.2%}")
    assert stated[-1] == pytest.approx(true, rel=1e-6)
    assert stated == sorted(stated, reverse=True)


def test_one_sweep_of_the_papers_form_is_reported(block: Elasticity, figure: Figure) -> None:
    problem, _ = of_rank(block, 3, 8)
    short = solve_hadamard(block, problem.loads, 3, max_sweeps=1)
    long = solve_hadamard(block, problem.loads, 3, max_sweeps=60)
    figure(f"converged: {short.converged.count(True)} of 3; with 60 sweeps all")
    assert short.sweeps == (1, 1, 1)
    assert short.converged == (False, False, False)
    assert long.converged == (True, True, True)


# --- no load ----------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["coordinates", "minimal residual", "loads", "paper"])
def test_a_right_hand_side_of_zero_is_refused(form: str, block: Elasticity, figure: Figure) -> None:
    problem, _ = manufactured(2, 1)
    nothing = replace(problem, sources=(aslinearoperator(np.zeros((N, N_LOADS))),))
    nothing = replace(nothing, source_factors=2 * (np.ones((1, N_NODES)),))
    on_clamp = np.zeros((block.n_nodes, 3, 2))
    on_clamp[block.clamped_nodes] = 1.0  # forces that move nothing
    loads = sp.csr_matrix(on_clamp.reshape(-1, 2))
    with pytest.raises(ConvergenceError, match="all loads are zero") as refused:
        if form == "coordinates":
            canonical.solve_canonical_pgd(nothing, EXACT)
        elif form == "minimal residual":
            canonical.solve_canonical_pgd(canonical.minimal_residual(nothing), EXACT)
        elif form == "loads":
            still = pgd.LoadProblem(block, loads, np.ones(2), np.zeros(2))
            pgd.solve_pgd(still, pgd.PGDRule(4, 0.0))
        else:
            solve_hadamard(block, loads, 2)
    assert "\n" not in str(refused.value)
    figure(f"refused: {refused.value}")


def test_one_load_among_many_zeros_is_found(figure: Figure) -> None:
    """A sample of the loads alone may miss it, and would call the problem empty."""
    problem, _ = manufactured(1, 1)
    force = np.zeros((N, 400))
    force[:, 123] = np.arange(1.0, N + 1.0)
    lone = replace(
        problem,
        sources=(aslinearoperator(force),),
        source_factors=(np.ones((1, N_NODES)),),
        load_weights=np.ones(400),
    )
    found = canonical.solve_canonical_pgd(lone, replace(EXACT, tolerance=1e-8))
    values = problem.factors[0][1]
    terms = [k @ np.eye(N) for k in problem.terms]
    error = 0.0
    for node, p in enumerate(values):
        exact = np.linalg.solve(terms[0] + p * terms[1], force)
        error = max(error, np.abs(found.field.at((node,)) - exact).max() / np.abs(exact).max())
    figure(f"{error:.1e} off with {found.field.rank} products")
    assert found.outcome is canonical.Outcome.CONVERGED
    assert error < 1e-7


# --- rank one to full rank --------------------------------------------------------------------


def test_rank_one_takes_one_product(figure: Figure) -> None:
    """p_1 p_2 K u = f with one pattern of load: u = K^-1 f / (p_1 p_2)."""
    problem, _ = manufactured(2, 1)
    values = np.linspace(0.5, 2.0, N_NODES)
    force = np.outer(np.arange(1.0, N + 1.0), np.linspace(-1.0, 1.0, N_LOADS))
    single = replace(
        problem,
        terms=problem.terms[:1],
        factors=2 * (values[None],),
        sources=(aslinearoperator(force),),
        source_factors=2 * (np.ones((1, N_NODES)),),
    )
    found = canonical.solve_canonical_pgd(single, replace(EXACT, tolerance=1e-8))
    still = np.linalg.solve(problem.terms[0] @ np.eye(N), force)
    exact = still[:, :, None, None] / np.multiply.outer(values, values)
    error = off(found.field, exact)
    figure(f"{found.field.rank} product, {error:.1e} off")
    assert (found.field.rank, found.outcome) == (1, canonical.Outcome.CONVERGED)
    assert error < 1e-9
    # by alternating directions alone too, which the update would otherwise make up for
    alone = canonical.solve_canonical_pgd(single, replace(EXACT, tolerance=1e-8, update=False))
    assert (alone.field.rank, alone.outcome) == (1, canonical.Outcome.CONVERGED)
    assert off(alone.field, exact) < 1e-9


@pytest.mark.examples
def test_any_rank_over_loads_takes_as_many_modes(block: Elasticity, figure: Figure) -> None:
    """Rank one, full rank and between, whatever number of pairs is sought at once."""
    worst = [0.0]

    @examples(25)
    @given(st.integers(1, 16), st.integers(1, 24), st.sampled_from([0.5, 1.0]))
    @example(1, 1, 0.5)
    @example(16, 16, 1.0)
    @example(12, 10, 0.5)  # the second block asks for 10 where 2 are left
    @example(4, 3, 0.5)
    def check(rank: int, n_at_once: int, decay: float) -> None:
        problem, exact = of_rank(block, rank, 16, decay)
        rule = pgd.PGDRule(40, 0.0, n_at_once, max_sweeps=30)
        found = pgd.solve_pgd(problem, rule)
        assert found.space.shape[1] == rank
        assert sum(step.modes for step in found.history) == rank
        gram = found.space.T @ block.apply(found.space)
        np.testing.assert_allclose(gram, np.eye(rank), atol=1e-10)
        worst.append(np.abs(found.space @ found.load.T - exact).max() / np.abs(exact).max())
        assert worst[-1] < 1e-7  # what the bar of energy at rounding, 1e-13, allows
        most = max(1, rank - 1)  # no block goes beyond what is allowed
        assert pgd.solve_pgd(problem, replace(rule, max_modes=most)).space.shape[1] == most

    check()
    figure(f"{max(worst):.1e} off with as many modes as the rank, 1 to 16")


def test_full_rank_over_coordinates_closes_in(figure: Figure) -> None:
    """As many unrelated loads as places: ever closer to the direct solution, and never astray."""
    problem, _ = manufactured(1, 1, seed=4)
    force = np.random.default_rng(4).standard_normal((N, N))
    full = replace(
        problem,
        sources=(aslinearoperator(force),),
        source_factors=(np.ones((1, N_NODES)),),
        load_weights=np.ones(N),
    )
    terms = [k @ np.eye(N) for k in problem.terms]
    values = problem.factors[0][1]
    exact = np.stack([np.linalg.solve(terms[0] + p * terms[1], force) for p in values], axis=-1)
    errors = [
        off(
            canonical.solve_canonical_pgd(full, replace(EXACT, max_modes=rank, stall=200)).field,
            exact,
        )
        for rank in (10, 40, 120)
    ]
    figure("10, 40, 120 products: " + ", ".join(f"{error:.1e}" for error in errors) + " off")
    assert errors[1] < 0.01 * errors[0]
    assert errors[2] < 1e-9  # any field of 12 places at 4 nodes is a sum of 48 products


# --- nothing left but rounding ----------------------------------------------------------------


@pytest.mark.parametrize("update", [True, False])
@pytest.mark.parametrize("solve_tolerance", [1e-3, 1e-10, 1e-14])
def test_enrichment_stops_at_rounding(update: bool, solve_tolerance: float, figure: Figure) -> None:
    """Asked for 40 products of a field of rank one: no garbage is added, and it is said."""
    problem, exact = manufactured(1, 1)
    rule = replace(EXACT, max_modes=40, update=update, solve_tolerance=solve_tolerance)
    found = canonical.solve_canonical_pgd(problem, rule)
    error = off(found.field, exact)
    figure(f"{found.field.rank} products, {error:.1e} off, {found.outcome.value}")
    assert found.outcome is canonical.Outcome.EXHAUSTED
    assert found.field.rank == len(found.history) < 20
    assert error < 1e-11
    assert Samples(problem, 24).residual(found.field) < 1e-11


def test_enrichment_of_a_nearly_incompressible_organ_stops_at_rounding(figure: Figure) -> None:
    """Poisson's ratio from 0.4 to 0.4999, whose stiffness cancels four digits."""
    mesh = cube(2)
    typical = Elasticity(mesh, Material(), regions_of(mesh).clamped, "Taylor-Hood")
    loads = patch_loads(typical, np.array([[0.05, 0.1, 0.05]]), 0.05)[:, 1:2].tocsr()
    ratio = Coordinate("poisson", 0.4, 0.4999)
    problem = affine_problem(typical, loads, (ratio,), np.ones(1))
    found = canonical.solve_canonical_pgd(
        problem, replace(EXACT, max_modes=40, sweep_tolerance=1e-2)
    )
    error = 0.0
    for node, value in enumerate(gauss_nodes(ratio)[0]):
        exact = problem_at(typical, {"poisson": float(value)}).solve(loads)
        error = max(error, float(np.abs(found.field.at((node,)) - exact).max() / exact.max()))
    figure(f"{found.field.rank} products, {error:.1e} off, {found.outcome.value}")
    assert found.outcome is canonical.Outcome.EXHAUSTED
    assert error < 1e-8


def test_enrichment_of_the_papers_form_stops_at_rounding(block: Elasticity, figure: Figure) -> None:
    problem, exact = of_rank(block, 1, 8)
    found = solve_hadamard(block, problem.loads, 12, max_sweeps=30)
    error = np.abs(found.evaluate() - exact).max() / np.abs(exact).max()
    figure(f"{found.space.shape[2]} of 12 modes, {error:.1e} off")
    assert found.space.shape[2] == len(found.sweeps) < 8
    assert error < 1e-11


def test_a_field_that_vanishes_in_the_mean_is_not_mistaken_for_rounding(figure: Figure) -> None:
    """Constants, with which the sweeps start, see nothing of it."""
    problem, _ = manufactured(2, 1)
    rng = np.random.default_rng(7)
    odd = np.array([-3.0, -1.0, 1.0, 3.0])[:, None]
    known = CanonicalField(rng.standard_normal((N, 1)), np.ones((N_LOADS, 1)), (odd, odd))
    one = aslinearoperator(np.eye(N))
    problem = replace(  # u = known
        problem,
        terms=(one,),
        factors=2 * (np.ones((1, N_NODES)),),
        sources=(aslinearoperator(np.outer(known.space, known.load)),),
        source_factors=(odd.T, odd.T),
        precondition=one,
    )
    rule = canonical.CanonicalPGDRule(1, 1e-6, max_sweeps=30, sweep_tolerance=1e-3)
    found = canonical.solve_canonical_pgd(problem, rule)
    error = off(found.field, everywhere(known))
    figure(f"{found.field.rank} product, {error:.1e} off")
    assert (found.field.rank, found.outcome) == (1, canonical.Outcome.CONVERGED)
    assert error < 1e-5


# --- the ends of the ranges -------------------------------------------------------------------


@pytest.mark.examples
def test_ends_are_nodes_and_nothing_beyond_is_answered(figure: Figure) -> None:
    """Any range: its ends answer with one node each; the next number outside is refused."""
    seen = []

    @examples(100)
    @given(
        st.one_of(
            st.tuples(st.just("poisson"), st.floats(0.0, 0.4999), st.floats(0.0, 0.4999)),
            st.tuples(st.just("contrast"), st.floats(0.01, 100.0), st.floats(0.01, 100.0)),
        ),
        st.floats(0.0, 1.0),
        st.integers(2, 9),
    )
    @example(("poisson", 0.0, 0.4999), 0.5, 2)
    @example(("contrast", 0.01, 100.0), 0.5, 3)
    @example(("contrast", nextafter(50.0, 0.0), 50.0), 0.5, 2)  # of one logarithm
    def check(ends: tuple[str, float, float], between: float, n_nodes: int) -> None:
        name, (low, high) = ends[0], sorted(ends[1:])
        try:
            coordinate = Coordinate(name, low, high, n_nodes)
        except CoordinateError as refused:
            assert high - low < 1e-14 * high or low == high, refused  # a range of nothing
            return
        seen.append(coordinate)
        for end, node in ((low, 0), (high, n_nodes - 1)):
            expected = np.eye(n_nodes)[node]
            np.testing.assert_allclose(coordinate.weights(end), expected, atol=1e-6)
        inside = coordinate.weights(coordinate.value_at(between))
        assert inside.min() >= 0.0
        assert inside.sum() == pytest.approx(1.0, abs=1e-9)
        for value in (nextafter(low, -inf), nextafter(high, inf), -inf, inf, nan):
            with pytest.raises(CoordinateError, match="this vademecum holds"):
                coordinate.weights(value)

    check()
    figure(f"{len(seen)} ranges, the last numbers inside and the first outside of each")


POISSON, CONTRAST = Coordinate("poisson", 0.30, 0.49, 2), Coordinate("contrast", 0.1, 10.0, 2)


@pytest.fixture(scope="module")
def organ() -> tuple[Vademecum, Elasticity]:
    """A block with a stiff core, over Poisson's ratio and the core's contrast."""
    mesh = cube(4)
    regions = regions_of(mesh)
    middle = np.abs(mesh.vertices[mesh.tets].mean(axis=1) - 0.05).max(axis=1) < 0.025
    core = Inclusion(middle.astype(float), 1.0)
    problem = Elasticity(mesh, Material(poisson_ratio=0.45), regions.clamped, "P2", core)
    surface = load_surface(mesh, regions, 0.03)
    coordinates, rule = (POISSON, CONTRAST), BuildRule(max_modes=20)
    nowhere = Provenance("", "")
    return (
        build_parametric_vademecum("block", problem, regions, surface, coordinates, rule, nowhere),
        problem,
    )


def test_at_the_ends_of_the_ranges_contact_is_that_of_finite_elements(
    organ: tuple[Vademecum, Elasticity], figure: Figure
) -> None:
    """All four corners of the two ranges, at positions of the build."""
    vademecum, problem = organ
    surface, worst = vademecum.surface, 0.0
    some = np.arange(0, surface.n_positions, 9)
    for poisson in (POISSON.low, POISSON.high):
        for contrast in (CONTRAST.low, CONTRAST.high):
            corner = {"poisson": poisson, "contrast": contrast}
            here, truth = at_values(vademecum, corner), problem_at(problem, corner)
            loads = patch_loads(truth, surface.centers[some], surface.patch_radius)
            exact = (loads.T @ truth.solve(loads)).reshape(len(some), 3, len(some), 3)
            for k, position in enumerate(some):
                own = here.compliance(np.array([position]), np.ones(1))
                worst = max(worst, float(np.abs(own - exact[k, :, k]).max() / exact.max()))
    figure(f"{worst:.1e} off at the worst corner")
    assert worst < 2e-5  # single precision, of blocks that take the modes' part away


@pytest.mark.parametrize("coordinate", [POISSON, CONTRAST], ids=["poisson", "contrast"])
def test_a_vademecum_does_not_answer_beyond_its_ranges(
    organ: tuple[Vademecum, Elasticity], coordinate: Coordinate, figure: Figure
) -> None:
    for value in (nextafter(coordinate.low, -inf), nextafter(coordinate.high, inf), -1.0, inf, nan):
        with pytest.raises(CoordinateError, match="this vademecum holds") as refused:
            at_values(organ[0], {coordinate.name: value})
        assert "\n" not in str(refused.value)
    figure(f"refused: {refused.value}")


# --- 1, 2 and 5 coordinates -------------------------------------------------------------------


@pytest.mark.parametrize("rank", [1, 3])
@pytest.mark.parametrize("n_coordinates", [1, 2, 5])
def test_a_known_field_over_coordinates_is_found(
    n_coordinates: int, rank: int, figure: Figure
) -> None:
    """K_0 + sum_d p_d K_d: at every node of all coordinates, 1,024 of them in five."""
    problem, exact = manufactured(n_coordinates, rank)
    found = canonical.solve_canonical_pgd(problem, replace(EXACT, tolerance=1e-5))
    error = off(found.field, exact)
    figure(f"{found.field.rank} products for {exact.size:,} values, {error:.1e} off")
    assert found.outcome is canonical.Outcome.CONVERGED
    assert found.field.rank <= (2 if rank == 1 else 30)
    assert error < 5e-5
