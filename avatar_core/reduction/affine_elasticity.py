"""An organ with material coordinates as an affine problem for parametric PGD."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from avatar_core.common.arrays import FloatArray
from avatar_core.fem.elasticity import Elasticity
from avatar_core.reduction.affine import AffineProblem
from avatar_core.reduction.coordinates import Coordinate, problem_at

N_NODES = 8  # Gauss points of a coordinate


def gauss_nodes(coordinate: Coordinate, n: int = N_NODES) -> tuple[FloatArray, FloatArray]:
    """Values and weights of Gauss's rule in the coordinate's own scale; the weights sum to 1."""
    place, weight = np.polynomial.legendre.leggauss(n)
    values = np.array([coordinate.value_at(0.5 + 0.5 * t) for t in place])
    return values, weight / 2.0


def affine_problem(
    elasticity: Elasticity,
    loads: sp.csr_matrix,
    coordinates: Sequence[Coordinate],
    load_weights: FloatArray,
    n_nodes: int = N_NODES,
) -> AffineProblem:
    """K(p) u = f(s) with K(p) = sum_q theta_q(p) K_q; the clamp is kept by the operators.

    Parameters
    ----------
    elasticity : a typical problem, whose solution preconditions the others
    loads : sparse, shape (3 n_nodes, n_loads)
    coordinates : at least one; the other values are those of ``elasticity``
    load_weights : ndarray, shape (n_loads,)
    """
    free = np.ones((elasticity.n_nodes, 3))
    free[elasticity.clamped_nodes] = 0.0
    free = free.ravel()
    n_terms = len(elasticity.factors)
    held = sp.diags(free)
    factors = _factors(elasticity, coordinates, n_nodes)
    return AffineProblem(
        terms=tuple(_symmetric(elasticity, q, free) for q in range(n_terms)),
        sources=(aslinearoperator((held @ loads).tocsr()),),
        factors=factors,
        source_factors=tuple(np.ones((1, n_nodes)) for _ in coordinates),
        load_weights=load_weights,
        weights=tuple(gauss_nodes(c, n_nodes)[1] for c in coordinates),
        precondition=_inverse(elasticity, free),
    )


def _factors(
    elasticity: Elasticity, coordinates: Sequence[Coordinate], n_nodes: int
) -> tuple[FloatArray, ...]:
    """theta_q along each coordinate; with those of ``elasticity`` they multiply to theta_q(p)."""
    here, out = elasticity.factors, []
    for coordinate in coordinates:
        values = gauss_nodes(coordinate, n_nodes)[0]
        along = [problem_at(elasticity, {coordinate.name: value}).factors for value in values]
        out.append(np.array(along).T / here[:, None])
    out[0] = out[0] * here[:, None]
    return tuple(out)


def _symmetric(elasticity: Elasticity, q: int, free: FloatArray) -> LinearOperator:
    def apply(vectors: FloatArray) -> FloatArray:
        columns = (vectors.reshape(len(free), -1).T * free).T
        forces = elasticity.apply_term(q, columns)
        return ((forces.T * free).T).reshape(vectors.shape)

    n = len(free)
    return LinearOperator((n, n), matvec=apply, matmat=apply, rmatvec=apply, rmatmat=apply)


def _inverse(elasticity: Elasticity, free: FloatArray) -> LinearOperator:
    def apply(forces: FloatArray) -> FloatArray:
        return elasticity.solve(forces.reshape(len(free), -1)).reshape(forces.shape)

    n = len(free)
    return LinearOperator((n, n), matvec=apply, matmat=apply, rmatvec=apply, rmatmat=apply)
