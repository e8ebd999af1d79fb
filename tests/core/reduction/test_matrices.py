"""PGD, POD, Galerkin and regions of plain matrices, against one another and linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

import avatar_core as av
from avatar_core.errors import ConvergenceError
from avatar_core.fem.elasticity import Elasticity

MASS = np.linspace(0.5, 2.0, 120)


@pytest.fixture(scope="module")
def stiffness() -> sp.csr_matrix:
    """A chain of springs that is held at both ends."""
    n = len(MASS)
    return sp.diags([-np.ones(n - 1), 2.01 * np.ones(n), -np.ones(n - 1)], [-1, 0, 1]).tocsr()


@pytest.fixture(scope="module")
def loads() -> np.ndarray:
    """Bumps along the chain, shape (120, 30)."""
    x, s = np.linspace(0.0, 1.0, len(MASS)), np.linspace(0.1, 0.9, 30)
    return np.asarray(np.exp(-200.0 * (x[:, None] - s) ** 2))


@pytest.fixture(scope="module")
def exact(stiffness: sp.csr_matrix, loads: np.ndarray) -> np.ndarray:
    return np.linalg.solve(stiffness.toarray(), loads)


def in_energy(stiffness: sp.csr_matrix, field: np.ndarray) -> float:
    return float(np.sqrt(np.einsum("is,is->", field, stiffness @ field)))


def test_pgd_of_matrices_is_that_of_the_energy_norm(
    stiffness: sp.csr_matrix, loads: np.ndarray, exact: np.ndarray
) -> None:
    rule = av.mor.PGDRule(8, 0.0, block=1, max_sweeps=60, sweep_tolerance=1e-12)
    found = av.mor.solve_pgd(av.mor.LoadProblem(stiffness, sp.csr_matrix(loads)), rule)
    left = exact - found.space @ found.load.T
    told = found.history[-1].energy_error
    assert in_energy(stiffness, left) / in_energy(stiffness, exact) == pytest.approx(told)
    # the optimum in energy: POD of L^T U, with K = L L^T
    root = np.linalg.cholesky(stiffness.toarray())
    value = np.linalg.svd(root.T @ exact, compute_uv=False)
    best = np.sqrt(np.sum(value[8:] ** 2) / np.sum(value**2))
    assert best * (1.0 - 1e-9) <= told < 1.05 * best


def test_a_matrix_and_an_elasticity_are_one_problem(box_elasticity: Elasticity) -> None:
    free = np.setdiff1d(
        np.arange(3 * box_elasticity.n_nodes),
        (3 * box_elasticity.clamped_nodes[:, None] + np.arange(3)).ravel(),
    )
    rng = np.random.default_rng(0)
    loads = np.zeros((3 * box_elasticity.n_nodes, 6))
    loads[free] = rng.standard_normal((len(free), 6))
    rule = av.mor.PGDRule(4, 0.0)
    whole = av.mor.solve_pgd(av.mor.LoadProblem(box_elasticity, loads), rule)
    matrix = box_elasticity.stiffness[free][:, free]
    part = av.mor.solve_pgd(av.mor.LoadProblem(matrix, loads[free]), rule)
    field = whole.space @ whole.load.T
    np.testing.assert_allclose(
        part.space @ part.load.T, field[free], atol=1e-8 * np.abs(field).max()
    )


def test_pod_leaves_the_least_that_so_many_modes_can(exact: np.ndarray) -> None:
    found = av.mor.pod(exact, 5, MASS)
    np.testing.assert_allclose(found.space.T @ (MASS[:, None] * found.space), np.eye(5), atol=1e-9)
    root = np.sqrt(MASS)[:, None]
    value = np.linalg.svd(root * exact, compute_uv=False)
    left = np.linalg.norm(root * (exact - found.evaluate()))
    assert left == pytest.approx(np.sqrt(np.sum(value[5:] ** 2)))
    fewer = av.mor.pod(exact, 3, MASS)
    np.testing.assert_allclose(fewer.evaluate(), found.truncate(3).evaluate(), atol=1e-12)
    whole = av.mor.pod(exact, 1000)
    assert whole.rank <= 30
    np.testing.assert_allclose(whole.evaluate(), exact, atol=1e-9)


def test_pod_of_relative_errors_does_not_see_how_large_a_snapshot_is(exact: np.ndarray) -> None:
    factor = 10.0 ** np.linspace(-3.0, 3.0, exact.shape[1])
    plain = av.mor.pod(exact, 4, MASS, relative=True)
    scaled = av.mor.pod(exact * factor, 4, MASS, relative=True)
    np.testing.assert_allclose(scaled.evaluate() / factor, plain.evaluate(), atol=1e-9)
    with pytest.raises(ConvergenceError, match="not all zero"):
        av.mor.pod(np.zeros((4, 3)), 2)


def test_galerkin_in_a_space_is_the_best_of_that_space(
    stiffness: sp.csr_matrix, loads: np.ndarray, exact: np.ndarray
) -> None:
    basis = exact[:, ::3]
    found = av.mor.solve_galerkin(stiffness, loads, basis)
    np.testing.assert_allclose(found.space.T @ (stiffness @ found.space), np.eye(10), atol=1e-8)
    left = exact - found.evaluate()
    np.testing.assert_allclose(basis.T @ (stiffness @ left), 0.0, atol=1e-8)  # orthogonal in K
    np.testing.assert_allclose(left[:, ::3], 0.0, atol=1e-8)
    np.testing.assert_allclose(
        found.load @ found.load.T + left.T @ (stiffness @ left), loads.T @ exact, atol=1e-7
    )
    again = av.mor.solve_galerkin(stiffness, loads, np.hstack([basis, 1e3 * basis[:, :1]]))
    assert again.rank == 10  # a function that others hold adds nothing
    np.testing.assert_allclose(again.evaluate(), found.evaluate(), atol=1e-8)


def test_regions_of_an_array_count_relative_to_its_columns(exact: np.ndarray) -> None:
    region = av.mor.regions_of(np.linspace(0.0, 1.0, 30)[:, None] * np.eye(3)[0], 3)
    rule = av.mor.RegionalRule(0.0, 0.0, 4)
    columns = exact[:, :, None]
    modes, errors = av.mor.separate_regions(region, columns, rule)
    size = np.linalg.norm(exact, axis=0)[:, None]
    again, same = av.mor.separate_regions(
        region, lambda at: columns[:, at], rule, size, np.ones(len(exact))
    )
    np.testing.assert_allclose(errors, same, rtol=1e-5)
    for r, (one, other) in enumerate(zip(modes, again, strict=True)):
        np.testing.assert_allclose(one.space, other.space, atol=1e-5)
        left = exact[:, region == r] - one.space @ one.load[:, 0].T
        told = errors[4, region == r, 0]
        np.testing.assert_allclose(
            np.linalg.norm(left, axis=0) / size[region == r, 0], told, atol=1e-3
        )


def test_a_matrix_of_one_triangle_is_refused(stiffness: sp.csr_matrix) -> None:
    with pytest.raises(ConvergenceError, match="give both triangles"):
        av.mor.LoadProblem(sp.triu(stiffness), np.ones((stiffness.shape[0], 1)))


@pytest.mark.parametrize(
    ("rank", "mass", "reason"),
    [
        (-1, None, "the rank is -1; give 0 or more"),
        (2, np.zeros(120), "give 120 positive numbers"),
        (2, -MASS, "give 120 positive numbers"),
        (2, MASS[:-1], "give 120 positive numbers"),
        (2, np.full(120, np.nan), "give 120 positive numbers"),
    ],
)
def test_pod_of_no_rank_or_norm_is_refused(
    exact: np.ndarray, rank: int, mass: np.ndarray | None, reason: str
) -> None:
    with pytest.raises(ConvergenceError, match=reason):
        av.mor.pod(exact, rank, mass)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_a_basis_with_a_column_that_is_no_field_is_refused(
    stiffness: sp.csr_matrix, loads: np.ndarray, exact: np.ndarray, value: float
) -> None:
    basis = exact[:, ::3].copy()
    basis[:, 4] = value
    with pytest.raises(ConvergenceError, match="zero or not finite; leave it out"):
        av.mor.solve_galerkin(stiffness, loads, basis)
