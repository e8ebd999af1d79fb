"""PGD over loads: exact recovery, optimality, true reports; one sweep, no load, any rank."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.errors import ConvergenceError
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.reduction.pgd import EnrichmentStatus, LoadProblem, PGDRule, solve_pgd
from avatar_core.reduction.separated import SeparatedField
from tests.helpers.elastic_shapes import cube, regions_of
from tests.helpers.examples import examples

Figure = Callable[[str], None]


@pytest.fixture(scope="module")
def block() -> Elasticity:
    """Return a smaller problem than ``box_elasticity``, for many drawn problems."""
    mesh = cube(3)
    return Elasticity(mesh, Material(), regions_of(mesh).clamped)


def problem_of_rank(
    elasticity: Elasticity, rank: int, n_loads: int = 30, decay: float = 0.5
) -> tuple[LoadProblem, np.ndarray]:
    """Return loads that combine ``rank`` forces, and their exact solutions."""
    rng = np.random.default_rng(rank)
    force = rng.standard_normal((3 * elasticity.n_nodes, rank))
    force.reshape(-1, 3, rank)[elasticity.clamped_nodes] = 0.0
    loads = force @ (rng.standard_normal((rank, n_loads)) * decay ** np.arange(rank)[:, None])
    exact = elasticity.solve(loads)
    energy = np.einsum("ij,ij->j", loads, exact)
    return LoadProblem(elasticity, sp.csr_matrix(loads), 1.0 / energy, energy), exact


@pytest.mark.parametrize("n_at_once", [1, 4])
def test_field_of_rank_four_is_recovered_exactly(
    box_elasticity: Elasticity, n_at_once: int
) -> None:
    problem, exact = problem_of_rank(box_elasticity, 4)
    rule = PGDRule(10, 1e-9, block=n_at_once, max_sweeps=200, sweep_tolerance=1e-13)
    solution = solve_pgd(problem, rule)
    field = SeparatedField(solution.space, solution.load)
    assert field.rank == 4
    assert np.abs(field.evaluate() - exact).max() < 1e-7 * np.abs(exact).max()


def test_modes_are_orthonormal_in_energy(box_elasticity: Elasticity) -> None:
    problem, _ = problem_of_rank(box_elasticity, 12)
    solution = solve_pgd(problem, PGDRule(8, 1e-9, block=3))
    gram = solution.space.T @ box_elasticity.apply(solution.space)
    np.testing.assert_allclose(gram, np.eye(gram.shape[0]), atol=1e-8)


def test_greedy_modes_are_near_the_svd_optimum(box_elasticity: Elasticity) -> None:
    """In (x, s) the best modes are the eigenvectors of the weighted compliance."""
    problem, exact = problem_of_rank(box_elasticity, 20, n_loads=60)
    solution = solve_pgd(problem, PGDRule(8, 0.0, block=8, max_sweeps=30, sweep_tolerance=1e-6))
    scale = np.sqrt(problem.weights)
    spectrum = np.linalg.eigvalsh(scale[:, None] * (problem.loads.T @ exact) * scale)[::-1]
    optimum = np.sqrt(spectrum[8:].sum() / spectrum.sum())
    assert optimum <= solution.history[-1].energy_error * (1 + 1e-9)
    assert solution.history[-1].energy_error < 1.02 * optimum


@pytest.mark.parametrize(("n_at_once", "sweeps"), [(2, 1), (2, 10), (1, 1)])
def test_stated_energy_error_is_the_true_one(
    box_elasticity: Elasticity, n_at_once: int, sweeps: int
) -> None:
    """It is stated after one sweep too, which is reported as cut short."""
    problem, exact = problem_of_rank(box_elasticity, 12)
    solution = solve_pgd(problem, PGDRule(6, 0.0, block=n_at_once, max_sweeps=sweeps))
    left = exact - solution.space @ solution.load.T
    energy = np.einsum("ij,ij->j", left, box_elasticity.apply(left))
    true = np.sqrt(problem.weights @ energy / (problem.weights @ problem.energy))
    stated = [step.energy_error for step in solution.history]
    assert stated[-1] == pytest.approx(true, rel=1e-6)
    assert stated == sorted(stated, reverse=True)
    if sweeps == 1:
        assert {step.status for step in solution.history} == {EnrichmentStatus.SWEEP_LIMIT}
        assert not solution.converged


def test_enrichment_beyond_rounding_stops(box_elasticity: Elasticity) -> None:
    problem, _ = problem_of_rank(box_elasticity, 2)
    solution = solve_pgd(problem, PGDRule(20, 0.0, block=2, max_sweeps=30))
    assert solution.history[-1].status is EnrichmentStatus.EXHAUSTED
    assert np.isfinite(solution.space).all()


def test_forces_on_the_clamp_alone_are_refused(block: Elasticity) -> None:
    """They move nothing, so that no relative error exists."""
    on_clamp = np.zeros((block.n_nodes, 3, 2))
    on_clamp[block.clamped_nodes] = 1.0
    still = LoadProblem(block, sp.csr_matrix(on_clamp.reshape(-1, 2)), np.ones(2), np.zeros(2))
    with pytest.raises(ConvergenceError, match="all loads are zero") as refused:
        solve_pgd(still, PGDRule(4, 0.0))
    assert "\n" not in str(refused.value)


@pytest.mark.examples
def test_any_rank_over_loads_takes_as_many_modes(block: Elasticity, figure: Figure) -> None:
    """Rank one, full rank and between, for any number of pairs at once."""
    worst = [0.0]

    @examples(25)
    @given(st.integers(1, 16), st.integers(1, 24), st.sampled_from([0.5, 1.0]))
    @example(1, 1, 0.5)
    @example(16, 16, 1.0)
    @example(12, 10, 0.5)  # the second block asks for 10 where 2 are left
    @example(4, 3, 0.5)
    def check(rank: int, n_at_once: int, decay: float) -> None:
        problem, exact = problem_of_rank(block, rank, 16, decay)
        rule = PGDRule(40, 0.0, n_at_once, max_sweeps=30)
        found = solve_pgd(problem, rule)
        assert found.space.shape[1] == rank
        assert sum(step.modes for step in found.history) == rank
        gram = found.space.T @ block.apply(found.space)
        np.testing.assert_allclose(gram, np.eye(rank), atol=1e-10)
        worst.append(np.abs(found.space @ found.load.T - exact).max() / np.abs(exact).max())
        assert worst[-1] < 1e-7  # the limit of the energy bar at rounding, 1e-13
        most = max(1, rank - 1)  # no block exceeds the allowed number
        assert solve_pgd(problem, replace(rule, max_modes=most)).space.shape[1] == most

    check()
    figure(f"{max(worst):.1e} off with as many modes as the rank, 1 to 16")
