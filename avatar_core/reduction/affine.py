"""Affine problems over places, loads and parameters, canonical fields, and how well they fit.

    sum_q [prod_d theta_q^d(p_d)] K_q u(x, s, p) = sum_j F_j(x, s) prod_d phi_j^d(p_d)

K_q are symmetric positive semi-definite, theta_q and phi_j positive. Errors are estimated from
the residual r = f - K u of a field, as in the reduced basis method (Rozza, Huynh & Patera, Arch.
Comput. Methods Eng. 15:229, 2008):

    e . K e = r . K^-1 r <= r . K_0^-1 r / alpha(p),   alpha(p) = min_q theta_q(p) / theta_q(p_0)

and the work f . u of a load, for a unit patch load the displacement in contact, by

    f . (u_exact - u) = r . u + r . K^-1 r.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ConvergenceError


@dataclass(frozen=True, eq=False)
class AffineProblem:
    """sum_q theta_q(p) K_q u = sum_j phi_j(p) F_j(s) with its norms.

    terms : K_q, linear operators of shape (n, n)
    sources : F_j, linear operators of shape (n, n_loads)
    factors : one ndarray a parameter, shape (n_terms, n_nodes), theta_q^d
    source_factors : one ndarray a parameter, shape (n_sources, n_nodes), phi_j^d
    load_weights : ndarray, shape (n_loads,)
    weights : one ndarray a parameter, shape (n_nodes,), quadrature weights
    precondition : K_0^-1, the inverse of a typical operator, shape (n, n)
    """

    terms: tuple[LinearOperator, ...]
    sources: tuple[LinearOperator, ...]
    factors: tuple[FloatArray, ...]
    source_factors: tuple[FloatArray, ...]
    load_weights: FloatArray
    weights: tuple[FloatArray, ...]
    precondition: LinearOperator

    @property
    def n(self) -> int:
        """Number of unknowns in space."""
        return int(self.terms[0].shape[0])


@dataclass(frozen=True, eq=False)
class CanonicalField:
    """u = sum_k X_k(x) S_k(s) prod_d P_k^d(p_d).

    space : ndarray, shape (n, rank); load : shape (n_loads, rank), which carries the amplitude
    parameters : one ndarray a parameter, shape (n_nodes, rank)
    """

    space: FloatArray
    load: FloatArray
    parameters: tuple[FloatArray, ...]

    @property
    def rank(self) -> int:
        """Number of products."""
        return self.space.shape[1]

    def at(self, nodes: tuple[int, ...], loads: FloatArray | slice = slice(None)) -> FloatArray:
        """The field at one node of each parameter, shape (n, n_chosen)."""
        factor = np.ones(self.rank)
        for functions, node in zip(self.parameters, nodes, strict=True):
            factor = factor * functions[node]
        return self.space @ (self.load[loads] * factor).T

    def truncate(self, rank: int) -> CanonicalField:
        """The first products; those that are left were computed together with the others."""
        return CanonicalField(
            self.space[:, :rank], self.load[:, :rank], tuple(p[:, :rank] for p in self.parameters)
        )


@dataclass(frozen=True)
class ResidualErrorEstimate:
    """Estimated relative errors of a field over sampled points.

    residual : |r| / |f| in the norm of K_0^-1, root mean square
    contact : |f . (u_exact - u)| / (f . u), mean, with K_0 for K(p)
    contact_bound : the same with the bound of alpha(p), mean; no true error is larger
    """

    residual: float
    contact: float
    contact_bound: float


class Samples:
    """Some loads, not zero, and nodes of the parameters, where residuals are formed in full.

    Parameters
    ----------
    problem : AffineProblem
    n : number of points; ``seed`` draws them, by the weights of loads and nodes

    Raises
    ------
    ConvergenceError
        If the right-hand side is zero.
    """

    def __init__(self, problem: AffineProblem, n: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self._problem = problem
        acting = _acting(problem)
        if not acting.any():
            raise ConvergenceError("all loads are zero: there is nothing to separate")
        self.loads = rng.choice(len(acting), n, p=_normalized(problem.load_weights * acting))
        nodes = [rng.choice(len(w), n, p=_normalized(w)) for w in problem.weights]
        self.nodes: NDArray[np.int64] = np.stack([*nodes, np.zeros(n, np.int64)])[:-1].T
        self._force = np.column_stack([self._right(k) for k in range(n)])
        self._size = self._norm(self._force)
        if not self._size > 0:
            raise ConvergenceError("the right-hand side is zero at all sampled nodes; take more")

    def residual(self, field: CanonicalField) -> float:
        """|r| / |f| in the norm of K_0^-1, root mean square."""
        return self._norm(self._left(self.fields(field))) / self._size

    def estimate(self, field: CanonicalField, reference: FloatArray) -> ResidualErrorEstimate:
        """Errors of displacement in energy and of the displacement in contact.

        reference : ndarray, shape (n_terms,), theta_q(p_0) of ``precondition``
        """
        displacement = self.fields(field)
        left = self._left(displacement)
        squared = (left * (self._problem.precondition @ left)).sum(axis=0)
        own = (left * displacement).sum(axis=0)
        work = np.abs((self._force * displacement).sum(axis=0))
        alpha = np.array([(self._theta(k) / reference).min() for k in range(len(self.loads))])
        return ResidualErrorEstimate(
            residual=float(np.sqrt(squared.sum())) / self._size,
            contact=float((np.abs(own + squared) / work).mean()),
            contact_bound=float(((np.abs(own) + squared / alpha) / work).mean()),
        )

    def fields(self, field: CanonicalField) -> FloatArray:
        """The field at the samples, shape (n, n_samples)."""
        return np.column_stack(
            [
                field.at(tuple(nodes), np.array([j]))[:, 0]
                for j, nodes in zip(self.loads, self.nodes, strict=True)
            ]
        )

    def _left(self, displacement: FloatArray) -> FloatArray:
        left = self._force.copy()
        for q, term in enumerate(self._problem.terms):
            theta = np.array([self._theta(k)[q] for k in range(len(self.loads))])
            left -= theta * (term @ displacement)
        return left

    def _theta(self, k: int) -> FloatArray:
        return _at_nodes(self._problem.factors, self.nodes[k], len(self._problem.terms))

    def _right(self, k: int) -> FloatArray:
        one = np.zeros(len(self._problem.load_weights))
        one[self.loads[k]] = 1.0
        phi = _at_nodes(self._problem.source_factors, self.nodes[k], len(self._problem.sources))
        terms = zip(phi, self._problem.sources, strict=True)
        return np.asarray(sum(p * (source @ one) for p, source in terms))

    def _norm(self, forces: FloatArray) -> float:
        return float(np.sqrt((forces * (self._problem.precondition @ forces)).sum()))


def _at_nodes(factors: tuple[FloatArray, ...], nodes: NDArray[np.int64], n: int) -> FloatArray:
    out = np.ones(n)
    for factor, node in zip(factors, nodes, strict=True):
        out = out * factor[:, node]
    return out


def _acting(problem: AffineProblem) -> NDArray[np.bool_]:
    """Which loads are not zero, by their work on a random displacement, shape (n_loads,)."""
    probe = np.random.default_rng(0).standard_normal(problem.n)
    return np.any([source.rmatvec(probe) != 0.0 for source in problem.sources], axis=0)


def _normalized(weights: FloatArray) -> FloatArray:
    return weights / weights.sum()
