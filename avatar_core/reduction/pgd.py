"""Proper Generalized Decomposition over load position (paper Sec. 2.1).

For K u(s) = f(s) with u(x, s) = sum_k X_k(x) Y_k(s), each enrichment R(x) S(s) minimizes the
weighted energy of the residual (paper Eqs. 7-14). One scalar S per load replaces the paper's
entry-wise product, which reduces to it when each load has one direction:

    S known:  K R = sum_s w(s) S(s) r(s) / sum_s w(s) S(s)^2        (Eq. 14)
    R known:  S(s) = R . r(s) / (R . K R)                           (Eq. 11)

with the residual r = f - K u^m. Space functions are kept K-orthonormal. The Galerkin update of
*all* load functions is then Y_k(s) = X_k . f(s), and the residual energy is known exactly.
Alternating directions become a power iteration for the next eigenvector of the residual's energy.

Eigenvalues lie close together, so a single pair converges slowly. Therefore ``block`` pairs are
sought at once (a subspace iteration, each pair normalized against the others). ``block = 1`` is the
paper's method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from avatar_core.errors import ConvergenceError
from avatar_core.fem.norms import require_orthonormal
from avatar_core.reduction.operator import Operator, operator_of

# An enrichment that captures less of the total energy than this is made of rounding errors.
_ROUNDING = 1e-13


class EnrichmentStatus(Enum):
    """Outcome of an enrichment."""

    CONVERGED = "converged"
    SWEEP_LIMIT = "sweep limit"  # accepted: the mode still lowers the energy, less than it could
    EXHAUSTED = "exhausted"  # the residual is rounding; nothing was added


@dataclass(frozen=True)
class EnrichmentReport:
    """Report of one greedy enrichment: its status, its sweeps and the remaining error.

    Attributes
    ----------
    sweeps : int
        Number of alternating sweeps.
    modes : int
        Number of pairs added.
    change : float
        Relative change of the energy that R S captures, in the last sweep.
    energy_error : float
        sqrt(residual energy / total energy) after the enrichment.

    Examples
    --------
    >>> found = av.mor.solve_pgd(av.mor.LoadProblem(K, F), av.mor.PGDRule(3, 0.0, block=1))
    >>> [report.modes for report in found.history]
    [1, 1, 1]
    """

    status: EnrichmentStatus
    modes: int
    sweeps: int
    change: float
    energy_error: float


@dataclass(frozen=True)
class PGDRule:
    """Stopping criteria of the enrichments.

    Attributes
    ----------
    max_modes : int
        Largest number of pairs.
    tolerance : float
        Relative energy error below which enrichment stops.
    block : int
        Number of pairs sought at once.
    max_sweeps : int
        Largest number of alternating sweeps per enrichment.
    sweep_tolerance : float
        Relative change of the captured energy below which an enrichment has converged.

    Examples
    --------
    >>> av.mor.PGDRule(max_modes=20, tolerance=1e-3, block=1).max_sweeps  # block 1: the paper's
    5
    """

    max_modes: int
    tolerance: float
    block: int = 10
    max_sweeps: int = 5
    sweep_tolerance: float = 2e-2


@dataclass(frozen=True)
class PGDSolution:
    """K-orthonormal space functions, their load functions, and the enrichments that gave them.

    Attributes
    ----------
    space : ndarray, shape (3 n_nodes, rank)
        X, or as the problem writes it.
    load : ndarray, shape (n_loads, rank)
        Y.

    Examples
    --------
    >>> found = av.mor.solve_pgd(av.mor.LoadProblem(K, F), av.mor.PGDRule(5, 0.0))
    >>> np.allclose(found.space.T @ (K @ found.space), np.eye(5))
    True
    """

    space: np.ndarray
    load: np.ndarray
    history: tuple[EnrichmentReport, ...]

    @property
    def converged(self) -> bool:
        """Whether every enrichment reached its own sweep tolerance."""
        return all(report.status is not EnrichmentStatus.SWEEP_LIMIT for report in self.history)


class _Expansion:
    """The growing K-orthonormal expansion, and the residual energy of each load."""

    def __init__(self, problem: PGDProblem, capacity: int) -> None:
        self.problem = problem
        n_dofs, n_loads = problem.shape
        self._space = np.zeros((n_dofs, capacity), order="F")
        self._load = np.zeros((n_loads, capacity), order="F")
        self.rank = 0
        self.energy = problem.energy.copy()  # residual of each load, f . K^-1 f - sum_k Y_k^2

    @property
    def space(self) -> np.ndarray:
        return self._space[:, : self.rank]

    @property
    def load(self) -> np.ndarray:
        return self._load[:, : self.rank]

    @property
    def error(self) -> float:
        """Relative weighted energy error."""
        weights, total = self.problem.weights, self.problem.energy
        left = weights @ np.maximum(self.energy, 0.0)
        return float(np.sqrt(left / (weights @ total)))

    def append(self, space: np.ndarray) -> int:
        """Add space functions, made K-orthonormal; return the number of new ones.

        Raises ConvergenceError if the modes do not come out orthonormal.
        """
        for _ in range(2):  # once more for rounding
            dual = self.problem.apply(space)
            space = space - self.space @ (self.space.T @ dual)
        dual = self.problem.apply(space)
        value, vector = np.linalg.eigh(space.T @ dual)
        new = value > 1e-18 * value.max()
        scale = vector[:, new] / np.sqrt(value[new])
        space, dual = space @ scale, dual @ scale
        load = self.problem.observe(space)
        columns = slice(self.rank, self.rank + space.shape[1])
        self._space[:, columns], self._load[:, columns] = space, load
        modes = self._space[:, : columns.stop]
        require_orthonormal(modes, dual, "PGD modes", self.problem.rounding)
        self.energy -= (load**2).sum(axis=1)
        self.rank += space.shape[1]
        return int(space.shape[1])


class PGDProblem(Protocol):
    """Interface of K u(s) = f(s) for all loads s, for alternating directions."""

    @property
    def weights(self) -> np.ndarray:
        """Positive weight of each load in the norm over s, shape (n_loads,)."""

    @property
    def energy(self) -> np.ndarray:
        """f(s) . K^-1 f(s), the patch compliance, shape (n_loads,) [J]."""

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of entries of a space function, and of loads."""

    @property
    def rounding(self) -> float:
        """Allowed error of orthonormality."""

    def solve(self, amounts: np.ndarray) -> np.ndarray:
        """Return the space functions K^-1 sum_s f(s) a(s) of amounts a, shape (n_loads, n)."""

    def observe(self, space: np.ndarray) -> np.ndarray:
        """Return X . f(s) of space functions, shape (n_loads, n)."""

    def apply(self, space: np.ndarray) -> np.ndarray:
        """Return the dual functions, whose product with others is that in energy."""


@dataclass(frozen=True)
class LoadProblem:
    """A problem whose loads are solved on the way; see :class:`PGDProblem`.

    Parameters
    ----------
    operator : Operator or sparse matrix, shape (n_dofs, n_dofs)
        K, symmetric positive definite: an
        :class:`avatar_core.fem.elasticity.Elasticity`, or a matrix, which is factored.
    loads : ndarray or sparse matrix, shape (n_dofs, n_loads)
        F, one load a column.
    weights : ndarray, shape (n_loads,), optional
        Weight of each load in the norm over the loads. The default is 1.
    energy : ndarray, shape (n_loads,), optional
        f . K^-1 f of each load. The default solves every load once for it.

    Examples
    --------
    >>> problem = av.mor.LoadProblem(K, F)  # sparse K, and one load a column of F
    >>> problem.shape == F.shape
    True
    """

    operator: Operator | sp.spmatrix
    loads: np.ndarray | sp.csr_matrix
    weights: np.ndarray = None  # type: ignore[assignment]  # set below
    energy: np.ndarray = None  # type: ignore[assignment]  # set below

    def __post_init__(self) -> None:
        operator = operator_of(self.operator)
        object.__setattr__(self, "operator", operator)
        if self.weights is None:
            object.__setattr__(self, "weights", np.ones(self.loads.shape[1]))
        if self.energy is None:
            dense = self.loads.toarray() if sp.issparse(self.loads) else self.loads
            work = np.einsum("is,is->s", dense, operator.solve(dense))
            object.__setattr__(self, "energy", work)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of entries of a space function, and of loads."""
        return self.loads.shape

    @property
    def rounding(self) -> float:
        """Allowed error of orthonormality."""
        return 1e-6

    def solve(self, amounts: np.ndarray) -> np.ndarray:
        """Return K^-1 F a."""
        return self.operator.solve(self.loads @ amounts)

    def observe(self, space: np.ndarray) -> np.ndarray:
        """Return F^T X."""
        return np.asarray(self.loads.T @ space)

    def apply(self, space: np.ndarray) -> np.ndarray:
        """Return K X."""
        return self.operator.apply(space)


@dataclass(frozen=True)
class SolvedLoads:
    """A problem whose loads have all been solved: a sweep costs a product, not a solution.

    A space function X = K^-1 F c is written as its amounts c of the loads' solutions. Its products
    with the loads are C c, with C = F^T K^-1 F; in energy, X . K X' = c . C c'.

    Attributes
    ----------
    compliance : ndarray, shape (n_loads, n_loads)
        C, symmetric. In single precision, modes are orthonormal to 1e-2 only, and modes of little
        energy are not found.
    """

    compliance: np.ndarray
    weights: np.ndarray
    energy: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of entries of a space function, and of loads."""
        return self.compliance.shape[0], self.compliance.shape[1]

    @property
    def rounding(self) -> float:
        """Allowed error of orthonormality, by the precision of C."""
        return 1e-6 if self.compliance.dtype == np.float64 else 1e-2

    def solve(self, amounts: np.ndarray) -> np.ndarray:
        """Return the amounts, which represent K^-1 F a."""
        return amounts

    def observe(self, space: np.ndarray) -> np.ndarray:
        """Return C c."""
        return np.asarray(self.compliance @ space.astype(self.compliance.dtype), float)

    apply = observe


def solve_pgd(
    problem: PGDProblem, rule: PGDRule, progress: Callable[[int], None] = lambda rank: None
) -> PGDSolution:
    """Enrich greedily with alternating directions until the rule stops it; return the solution.

    Parameters
    ----------
    problem : PGDProblem
        LoadProblem or SolvedLoads.
    progress : Callable[[int], None]
        Called with the rank after every enrichment.

    Raises
    ------
    ConvergenceError
        If the right-hand side is zero, so that no relative error exists, or modes do not come out
        orthonormal.

    Examples
    --------
    >>> found = av.mor.solve_pgd(av.mor.LoadProblem(K, F), av.mor.PGDRule(12, 1e-9))
    >>> U = np.linalg.solve(K.toarray(), F)
    >>> np.allclose(found.space @ found.load.T, U, atol=1e-6)
    True
    """
    if not problem.weights @ problem.energy > 0:
        raise ConvergenceError("all loads are zero: there is nothing to separate")
    expansion = _Expansion(problem, rule.max_modes)
    history: list[EnrichmentReport] = []
    while expansion.rank < rule.max_modes and expansion.error > rule.tolerance:
        report = _enrich(expansion, rule)
        history.append(report)
        progress(expansion.rank)
        if report.status is EnrichmentStatus.EXHAUSTED:
            break
    return PGDSolution(expansion.space.copy(), expansion.load.copy(), tuple(history))


def _enrich(expansion: _Expansion, rule: PGDRule) -> EnrichmentReport:
    """Run one enrichment: start at random loads with energy left, alternate, keep the result."""
    problem = expansion.problem
    rounding = _ROUNDING * float(problem.weights @ problem.energy)
    load = _start(expansion, min(rule.block, rule.max_modes - expansion.rank))
    status, change, captured, sweeps = EnrichmentStatus.SWEEP_LIMIT, np.inf, 0.0, 0
    while sweeps < rule.max_sweeps and status is EnrichmentStatus.SWEEP_LIMIT:
        space, load = _sweep(expansion, load)
        sweeps += 1
        before, captured = captured, float(problem.weights @ (load**2).sum(axis=1))
        if captured <= rounding:
            return EnrichmentReport(EnrichmentStatus.EXHAUSTED, 0, sweeps, 0.0, expansion.error)
        change = abs(captured - before) / captured
        if change <= rule.sweep_tolerance:
            status = EnrichmentStatus.CONVERGED
    modes = expansion.append(_above_rounding(space, load, problem.weights, rounding))
    return EnrichmentReport(status, modes, sweeps, change, expansion.error)


def _above_rounding(
    space: np.ndarray, load: np.ndarray, weights: np.ndarray, rounding: float
) -> np.ndarray:
    """Return the combinations of a block's pairs that capture more energy than rounding does.

    A block may ask for more pairs than are left; its other combinations are noise.
    """
    energy, mixing = np.linalg.eigh(load.T @ (weights[:, None] * load))
    if energy[0] > rounding:
        return space
    return space @ mixing[:, energy > min(rounding, 0.5 * energy[-1])]


def _start(expansion: _Expansion, block: int) -> np.ndarray:
    """Return random load functions, larger where more energy is left."""
    rng = np.random.default_rng(expansion.rank)
    left = np.sqrt(np.maximum(expansion.energy, 0.0))
    return left[:, None] * rng.standard_normal((len(left), block))


def _sweep(expansion: _Expansion, load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Alternate directions once: R from S (Eq. 14), K-orthonormal in the block, S from R (Eq. 11).

    K R = sum_s w S r(s) is solved as R = K^-1 sum_s w S f(s) - sum_k X_k (Y_k . w S). Its energy R
    . K R equals (F^T R) . w S, so that no product with K is needed.
    """
    problem = expansion.problem
    weighted = problem.weights[:, None] * load
    weighted /= np.linalg.norm(weighted, axis=0) + 1e-300
    space = problem.solve(weighted)
    space = space - expansion.space @ (expansion.load.T @ weighted)
    work = problem.observe(space)
    value, vector = np.linalg.eigh((work.T @ weighted + weighted.T @ work) / 2.0)
    new = value > 1e-14 * value.max()
    scale = vector[:, new] / np.sqrt(value[new])
    return space @ scale, work @ scale
