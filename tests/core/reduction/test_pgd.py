"""PGD in any number of coordinates, on small problems whose solution is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import aslinearoperator

from avatar_core.errors import ConvergenceError
from avatar_core.reduction.affine import AffineProblem, CanonicalField, Samples
from avatar_core.reduction.pgd_parametric import (
    CanonicalPGDRule,
    Outcome,
    minimal_residual,
    solve_canonical_pgd,
)

N, N_LOADS, N_NODES = 24, 10, (5, 4)


def _stiffnesses(rng: np.random.Generator) -> list[np.ndarray]:
    roots = [rng.standard_normal((N, N)) for _ in range(2)]
    return [root @ root.T / N + 0.3 * np.eye(N) for root in roots]


def _problem(seed: int = 0, spread: float = 3.0) -> AffineProblem:
    """[theta_1(p) K_1 + theta_2(p, c) K_2] u = f(s), theta_2 = p c."""
    rng = np.random.default_rng(seed)
    terms = _stiffnesses(rng)
    p, c = np.linspace(1.0, spread, N_NODES[0]), np.linspace(0.5, 2.0, N_NODES[1])
    middle = terms[0] + p[2] * c[1] * terms[1]
    return AffineProblem(
        terms=tuple(map(aslinearoperator, terms)),
        sources=(aslinearoperator(rng.standard_normal((N, N_LOADS))),),
        factors=(np.array([np.ones_like(p), p]), np.array([np.ones_like(c), c])),
        source_factors=(np.ones((1, len(p))), np.ones((1, len(c)))),
        load_weights=rng.uniform(0.5, 2.0, N_LOADS),
        weights=(np.full(len(p), 1 / len(p)), np.full(len(c), 1 / len(c))),
        precondition=aslinearoperator(np.linalg.inv(middle)),
    )


def _dense(operator: object) -> np.ndarray:
    return np.asarray(operator @ np.eye(operator.shape[1]))  # type: ignore[attr-defined]


def _exact(problem: AffineProblem) -> np.ndarray:
    """u at all nodes, shape (n_p, n_c, n, n_loads)."""
    terms, force = [_dense(k) for k in problem.terms], _dense(problem.sources[0])
    out = np.empty((*N_NODES, N, N_LOADS))
    for a, b in np.ndindex(*N_NODES):
        theta = problem.factors[0][:, a] * problem.factors[1][:, b]
        out[a, b] = np.linalg.solve(theta[0] * terms[0] + theta[1] * terms[1], force)
    return out


def _error(field: CanonicalField, exact: np.ndarray) -> float:
    found = np.array([[field.at((a, b)) for b in range(N_NODES[1])] for a in range(N_NODES[0])])
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def test_a_field_of_rank_three_is_recovered_in_as_many_products() -> None:
    rng = np.random.default_rng(5)
    vectors = [np.linalg.qr(rng.standard_normal((n, 3)))[0] for n in (N, N_LOADS, *N_NODES)]
    known = CanonicalField(vectors[0] * [9.0, 3.0, 1.0], vectors[1], (vectors[2], vectors[3]))
    one = aslinearoperator(np.eye(N))
    problem = replace(  # u = known
        _problem(),
        terms=(one,),
        factors=tuple(np.ones((1, n)) for n in N_NODES),
        sources=tuple(
            aslinearoperator(np.outer(known.space[:, k], known.load[:, k])) for k in range(3)
        ),
        source_factors=(vectors[2].T, vectors[3].T),
        load_weights=np.ones(N_LOADS),
        weights=tuple(np.ones(n) for n in N_NODES),
        precondition=one,
    )
    rule = CanonicalPGDRule(3, 1e-4, max_sweeps=30, sweep_tolerance=1e-3)
    found = solve_canonical_pgd(problem, rule)
    assert found.field.rank == 3
    exact = np.array([[known.at((a, b)) for b in range(N_NODES[1])] for a in range(N_NODES[0])])
    assert _error(found.field, exact) < 1e-3  # the sweeps' own tolerance


def test_separable_solution_needs_one_product_a_load_pattern() -> None:
    """p c K u = f with one load pattern: u = K^-1 f / (p c), a single product."""
    problem = _problem()
    same = replace(problem, terms=(problem.terms[0],), factors=(
        np.array([np.linspace(1.0, 3.0, N_NODES[0])]), np.array([np.linspace(0.5, 2.0, N_NODES[1])])
    ))  # fmt: skip
    load = np.random.default_rng(1).standard_normal((N, 1)) @ np.ones((1, N_LOADS))
    same = replace(same, sources=(aslinearoperator(load),))
    found = solve_canonical_pgd(
        same, CanonicalPGDRule(3, 1e-6, sweep_tolerance=1e-4, solve_tolerance=1e-10)
    )
    assert (found.field.rank, found.outcome) == (1, Outcome.CONVERGED)
    u = np.linalg.solve(_dense(same.terms[0]), load)
    np.testing.assert_allclose(found.field.at((4, 0)), u / (3.0 * 0.5), rtol=1e-5)


def test_a_product_leaves_no_residual_in_its_own_directions() -> None:
    """Galerkin orthogonality: r, tested with three of R, S, P, Q, has nothing in the fourth."""
    problem = _problem()
    rule = CanonicalPGDRule(4, 1e-9, 2000, 1e-10, solve_tolerance=1e-12, update=False, stall=30)
    field = solve_canonical_pgd(problem, rule).field
    terms, force = [_dense(k) for k in problem.terms], _dense(problem.sources[0])
    residual = np.empty((*N_NODES, N, N_LOADS))
    for a, b in np.ndindex(*N_NODES):
        theta = problem.factors[0][:, a] * problem.factors[1][:, b]
        stiffness = theta[0] * terms[0] + theta[1] * terms[1]
        residual[a, b] = force - stiffness @ field.at((a, b))
    p, c = (w * f[:, -1] for w, f in zip(problem.weights, field.parameters, strict=True))
    tests = {"a": p, "b": c, "x": field.space[:, -1], "s": problem.load_weights * field.load[:, -1]}
    for free in tests:
        others = [letter for letter in tests if letter != free]
        pattern = f"abxs,{','.join(others)}->{free}"
        given = [tests[letter] for letter in others]
        left = np.einsum(pattern, residual, *given)
        whole = np.einsum(pattern, np.broadcast_to(force, residual.shape), *given)
        assert np.linalg.norm(left) < 1e-6 * np.linalg.norm(whole), free


@pytest.mark.parametrize("variant", ["Galerkin", "no update", "minimal residual"])
def test_every_variant_closes_in_on_the_direct_solution(variant: str) -> None:
    problem = _problem()
    exact = _exact(problem)
    if variant == "minimal residual":
        problem = minimal_residual(problem)
    rule = CanonicalPGDRule(30, 1e-9, sweep_tolerance=1e-2, solve_tolerance=1e-8, stall=30)
    if variant == "no update":
        rule = replace(rule, update=False)
    found = solve_canonical_pgd(problem, rule).field
    errors = [_error(found, exact)]
    few = solve_canonical_pgd(problem, replace(rule, max_modes=6)).field
    assert errors[0] < 0.5 * _error(few, exact)
    assert errors[0] < 0.12  # of ten unrelated loads, thirty products


def test_an_update_makes_as_many_products_worth_more() -> None:
    problem = _problem()
    exact = _exact(problem)
    rule = CanonicalPGDRule(12, 1e-9, solve_tolerance=1e-8, stall=30)
    plain = solve_canonical_pgd(problem, replace(rule, update=False)).field
    updated = solve_canonical_pgd(problem, rule).field
    assert _error(updated, exact) < _error(plain, exact)


def test_an_enrichment_that_is_cut_short_is_reported() -> None:
    found = solve_canonical_pgd(_problem(), CanonicalPGDRule(4, 1e-9, max_sweeps=1))
    assert {step.outcome for step in found.history} == {Outcome.SWEEP_LIMIT}
    assert not found.converged
    assert found.outcome is Outcome.MODE_LIMIT


def test_stagnation_ends_the_enrichment_and_is_said() -> None:
    """Half the residual in three products is more than a spread of 1,000 allows."""
    found = solve_canonical_pgd(
        _problem(spread=1e3), CanonicalPGDRule(40, 1e-9, stall=3, least_gain=0.5)
    )
    assert found.outcome is Outcome.STAGNATED
    assert found.field.rank < 40


def test_estimates_follow_the_true_error_and_the_bound_holds() -> None:
    problem = _problem()
    exact = _exact(problem)
    field = solve_canonical_pgd(
        problem, CanonicalPGDRule(15, 1e-9, solve_tolerance=1e-8, stall=30)
    ).field
    samples = Samples(problem, 40, seed=3)
    theta = problem.factors[0][:, 2] * problem.factors[1][:, 1]
    estimate = samples.estimate(field, theta)
    force = _dense(problem.sources[0])
    true = []
    for j, (a, b) in zip(samples.loads, samples.nodes, strict=True):
        right = force[:, j] @ exact[a, b][:, j]
        mine = force[:, j] @ field.at((a, b))[:, j]
        true.append(abs(right - mine) / abs(mine))
    assert 0.5 < estimate.contact / np.mean(true) < 2.0
    assert estimate.contact_bound >= np.mean(true)


def test_no_load_is_refused() -> None:
    problem = _problem()
    nothing = replace(problem, sources=(aslinearoperator(np.zeros((N, N_LOADS))),))
    with pytest.raises(ConvergenceError, match="zero"):
        solve_canonical_pgd(nothing, CanonicalPGDRule(3))
