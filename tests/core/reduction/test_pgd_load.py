"""PGD and separated fields: exact recovery, optimality, honest reports."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from avatar_core.errors import ConvergenceError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.reduction.pgd import EnrichmentStatus, LoadProblem, PGDRule, solve_pgd
from avatar_core.reduction.separated import SeparatedField


def problem_of_rank(
    elasticity: Elasticity, rank: int, n_loads: int = 30, seed: int = 0
) -> tuple[LoadProblem, np.ndarray]:
    """Loads that are combinations of ``rank`` forces, and their exact solutions."""
    rng = np.random.default_rng(seed)
    force = rng.standard_normal((3 * elasticity.n_nodes, rank))
    force.reshape(-1, 3, rank)[elasticity.clamped_nodes] = 0.0
    loads = force @ (rng.standard_normal((rank, n_loads)) * 0.5 ** np.arange(rank)[:, None])
    exact = elasticity.solve(loads)
    energy = np.einsum("ij,ij->j", loads, exact)
    return LoadProblem(elasticity, sp.csr_matrix(loads), 1.0 / energy, energy), exact


@pytest.mark.parametrize("block", [1, 4])
def test_field_of_rank_four_is_recovered_exactly(box_elasticity: Elasticity, block: int) -> None:
    problem, exact = problem_of_rank(box_elasticity, 4)
    rule = PGDRule(10, 1e-9, block=block, max_sweeps=200, sweep_tolerance=1e-13)
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


def test_stated_energy_error_is_the_true_one(box_elasticity: Elasticity) -> None:
    problem, exact = problem_of_rank(box_elasticity, 12)
    solution = solve_pgd(problem, PGDRule(5, 0.0, block=2))
    left = exact - solution.space @ solution.load.T
    energy = np.einsum("ij,ij->j", left, box_elasticity.apply(left))
    true = np.sqrt(problem.weights @ energy / (problem.weights @ problem.energy))
    assert solution.history[-1].energy_error == pytest.approx(true, rel=1e-6)


def test_one_sweep_is_reported_not_silent(box_elasticity: Elasticity) -> None:
    problem, _ = problem_of_rank(box_elasticity, 12)
    solution = solve_pgd(problem, PGDRule(4, 1e-9, block=1, max_sweeps=1))
    assert all(r.status is EnrichmentStatus.SWEEP_LIMIT for r in solution.history)
    assert not solution.converged


def test_enrichment_beyond_rounding_stops(box_elasticity: Elasticity) -> None:
    problem, _ = problem_of_rank(box_elasticity, 2)
    solution = solve_pgd(problem, PGDRule(20, 0.0, block=2, max_sweeps=30))
    assert solution.history[-1].status is EnrichmentStatus.EXHAUSTED
    assert np.isfinite(solution.space).all()


def test_zero_load_is_refused(box_elasticity: Elasticity) -> None:
    problem, _ = problem_of_rank(box_elasticity, 2, n_loads=3)
    zero = LoadProblem(box_elasticity, problem.loads * 0.0, problem.weights, np.zeros(3))
    with pytest.raises(ConvergenceError, match="zero"):
        solve_pgd(zero, PGDRule(5, 1e-3))
