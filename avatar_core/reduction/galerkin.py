"""A Galerkin basis on the patient's own mesh, grown from the neighbors' load functions.

The combined response of the neighbors, mapped to the patient, gives load functions w_k(s). On the
patient's own mesh each gives one solution, and these span the first space,

    K X_k = sum_s w_k(s) f(s),      Y(s) = X^T f(s),      u(x, s) ~ X(x) Y(s)^T,

the Galerkin projection for K-orthonormal X. (Displacement modes of the neighbors would have to be
smoothed by K first: 20 sweeps of smoothing cost more than ten direct solutions.) The space grows by
the solutions for the loads whose residual r = f - K X Y^T is largest in the norm of the diagonal D,

    eta(s)^2 = r(s) . D^-1 r(s).

The norm is relative to the compliance under the patch or to the same norm of the load, whichever
gives more. Where a thin lobe gives way, the compliance is large and hides a large error. A few
*probes* are loads solved exactly that never enter the space. They calibrate eta as an estimate of
the error of every load, and give the residual compliance under a patch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ConvergenceError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_norm, require_orthonormal
from avatar_core.fem.patch_loads import LoadSurface, scaled_gram, triples
from avatar_core.reduction.compact_response import CompactResponse, positive_part
from avatar_core.reduction.near_field import LocalBlocks, near_pairs, taper
from avatar_core.reduction.operator import Operator, operator_of
from avatar_core.reduction.separated import SeparatedField

# In double and in single precision: fraction of the energy below which a direction is rounding,
# and the allowed error of the Gram matrix of orthonormal functions.
_DEPENDENT = {False: 1e-10, True: 1e-6}
_ORTHONORMAL = {False: 1e-6, True: 0.05}
WORST_OVER_MEAN = 2.0  # estimated, of the mean asked for; the true worst may be half as much again


@dataclass(frozen=True)
class ReductionRule:
    """Limits of the space's size.

    Attributes
    ----------
    n_start : int
        Number of load functions taken from the neighbors.
    n_block : int
        Number of load positions solved in one enrichment, three directions each.
    n_probes : int
        Number of load positions solved exactly to calibrate the estimate.
    max_solution_fraction : float
        Largest number of fine solutions, probes included, over those of the full problem.
    supports : tuple[float, ...]
        Candidates for the reach of the residual compliance, in patch radii.
    """

    n_start: int = 80
    n_block: int = 26
    n_probes: int = 16
    max_solution_fraction: float = 0.25
    supports: tuple[float, ...] = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0)


@dataclass(frozen=True)
class GalerkinErrorEstimate:
    """Estimated relative L2 errors of displacement over all loads, and their cost.

    Attributes
    ----------
    mean, worst : float
        Errors over the load positions, three directions together.
    rank : int
        Rank of the space.
    solutions : int
        Number of fine solutions so far, probes included.
    """

    mean: float
    worst: float
    rank: int
    solutions: int


def solve_galerkin(
    operator: Operator | sp.spmatrix, loads: FloatArray | sp.spmatrix, basis: FloatArray
) -> SeparatedField:
    """Solve K u(s) = f(s) for all loads in the space of a given basis V.

    X = V A with X^T K X = I, Y(s) = X^T f(s). No field of the space is nearer in the energy norm.

    Parameters
    ----------
    operator : Operator or sparse matrix, shape (n_dofs, n_dofs)
        K, symmetric positive definite.
    loads : ndarray or sparse matrix, shape (n_dofs, n_loads)
        F, one load a column.
    basis : ndarray, shape (n_dofs, n)
        V, zero at the clamp, such as modes of another organ or material.

    Returns
    -------
    SeparatedField
        X, shape (n_dofs, r), and Y, shape (n_loads, r), r the dimension of the space. Y Y^T is the
        compliance between the loads.

    Raises
    ------
    ConvergenceError
        If a column of the basis is zero or not finite.

    Examples
    --------
    >>> U = np.linalg.solve(K.toarray(), F)
    >>> there = av.mor.solve_galerkin(K, F, U[:, ::2])
    >>> np.allclose(there.evaluate()[:, ::2], U[:, ::2])
    True
    """
    work = basis.T @ operator_of(operator).apply(basis)
    size = np.sqrt(np.diagonal(work))
    if not ((size > 0.0) & (size < np.inf)).all():
        raise ConvergenceError("a column of the basis is zero or not finite; leave it out")
    value, vector = np.linalg.eigh(work / np.outer(size, size))
    new = value > _DEPENDENT[False]
    space = (basis / size) @ (vector[:, new] / np.sqrt(value[new]))
    return SeparatedField(space, np.asarray(loads.T @ space))


class GalerkinBasis:
    """K-orthonormal space functions X of forces F A, at the vertices, and their load functions Y.

    Everything but X itself is computed with load functions, K X = F A and Y = F^T X. Products of
    two functions are Y^T A, and no product by K is needed.

    Parameters
    ----------
    elasticity : Elasticity
        Problem on the patient's own mesh.
    loads : sparse, shape (3 n_nodes, n_loads)
        F.
    single : bool
        Solve in single precision.

    Attributes
    ----------
    space : ndarray, shape (3 n_vertices, rank)
        X.
    applied, load : ndarray, shape (n_loads, rank)
        A and Y.
    load_norm : ndarray, shape (n_positions,)
        Root of the trace of f . D^-1 f.
    """

    def __init__(self, elasticity: Elasticity, loads: sp.csr_matrix, single: bool = False) -> None:
        self.elasticity, self.loads, self.single = elasticity, loads, single
        self.space = np.zeros((3 * len(elasticity.mesh.vertices), 0))
        self.applied = np.zeros((loads.shape[1], 0))
        self.load = np.zeros((loads.shape[1], 0))
        self.solutions = 0
        self._gram = scaled_gram(elasticity, loads)
        self._own = _blocks_of_triples(self._gram)
        self.load_norm = np.sqrt(np.trace(self._own, axis1=1, axis2=2))

    @property
    def rank(self) -> int:
        """Number of basis functions."""
        return self.space.shape[1]

    def enrich(self, functions: FloatArray) -> None:
        """Add the solutions for forces F A with some load functions A, shape (n_loads, n).

        Raises
        ------
        ConvergenceError
            If the functions do not come out K-orthonormal.
        """
        self.solutions += functions.shape[1]
        applied = np.asarray(functions, float)
        solution = self.elasticity.solve(self.loads @ applied, self.single)
        space, load = self.elasticity.at_vertices(solution).astype(float), self.loads.T @ solution
        size = np.einsum("si,si->i", load, applied).max()
        for _ in range(2):  # once more for rounding
            known = self.load.T @ applied
            space, load = space - self.space @ known, load - self.load @ known
            applied = applied - self.applied @ known
        work = load.T @ applied
        value, vector = np.linalg.eigh((work + work.T) / 2.0)
        new = value > _DEPENDENT[self.single] * size
        scale = vector[:, new] / np.sqrt(value[new])
        space, load, applied = space @ scale, load @ scale, applied @ scale
        self.space = np.hstack([self.space, space])
        self.load = np.hstack([self.load, load])
        require_orthonormal(self.load, applied, "basis functions", _ORTHONORMAL[self.single])
        self.applied = np.hstack([self.applied, applied])

    def residual_blocks(self) -> NDArray[np.float64]:
        """Return r(s) . D^-1 r(s) of each position, by directions, shape (n_positions, 3, 3) [m/N].

        With G = F^T D^-1 F and r = F (1 - A Y^T), the blocks lie on the diagonal of

            G - G A Y^T - Y A^T G + Y A^T G A Y^T.
        """
        mixed = self._gram @ self.applied
        load, change = (
            part.reshape(-1, 3, self.rank)
            for part in (self.load, self.load @ (self.applied.T @ mixed) - mixed)
        )
        cross = mixed.reshape(-1, 3, self.rank) @ load.transpose(0, 2, 1)
        blocks = positive_part(self._own - cross + load @ change.transpose(0, 2, 1))
        return np.asarray(blocks, float)  # for loads in the space, rounding would be left

    def compliance_trace(self) -> FloatArray:
        """Return the trace of the Galerkin compliance Y Y^T of each patch, (n_positions,) [m/N]."""
        return np.asarray((self.load**2).sum(axis=1).reshape(-1, 3).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Probes:
    """Loads that are solved exactly and kept out of the space.

    Attributes
    ----------
    positions : ndarray of int, shape (n,)
        Load positions.
    columns : ndarray, shape (3 n_vertices, 3 n)
        Exact displacement [m/N].
    compliance : ndarray, shape (3 n_positions, 3 n)
        Exact displacement of all patches [m/N].
    """

    positions: NDArray[np.int64]
    columns: FloatArray
    compliance: FloatArray

    def errors(self, basis: GalerkinBasis) -> FloatArray:
        """Return the relative mass-weighted L2 error of displacement at each probe, shape (n,)."""
        elasticity = basis.elasticity
        estimate = basis.space @ basis.load[triples(self.positions)].T
        error, size = (
            np.linalg.norm(l2_norm(field, elasticity.mesh.lumped_mass).reshape(-1, 3), axis=1)
            for field in (estimate - self.columns, self.columns)
        )
        return np.asarray(error / size)


@dataclass(frozen=True, eq=False)
class ReducedResponse:
    """The response in the space that was found.

    Attributes
    ----------
    response : CompactResponse
        Response at the patient's vertices and load positions.
    support : float
        Reach of the residual compliance [m].
    history : tuple[GalerkinErrorEstimate, ...]
        Estimates for the first space and after each enrichment.
    converged : bool
        Whether the last estimate is below the tolerance.
    """

    response: CompactResponse
    support: float
    history: tuple[GalerkinErrorEstimate, ...]
    converged: bool


def reduce(
    elasticity: Elasticity,
    loads: sp.csr_matrix,
    surface: LoadSurface,
    load_functions: FloatArray,
    tolerance: float,
    rule: ReductionRule | None = None,
    progress: Callable[[float, GalerkinErrorEstimate], None] = lambda fraction, estimate: None,
) -> ReducedResponse:
    """Return the Galerkin response from the neighbors' load functions, enriched to a tolerance.

    Enrichment stops at the tolerance (mean, and twice that for the worst load), or with
    ``converged`` False after ``max_solution_fraction`` of the fine solutions.

    Parameters
    ----------
    elasticity : Elasticity
        Problem on the patient's own mesh.
    loads : sparse, shape (3 n_nodes, n_loads)
    load_functions : ndarray, shape (n_loads, n)
        Load functions of the neighbors, most important first.
    tolerance : float
        Mean relative L2 error of displacement.
    progress : Callable[[float, GalerkinErrorEstimate], None]
        Called with the spent fraction of the allowed solutions, and the estimate.
    """
    rule = rule or ReductionRule()
    limit = max(int(rule.max_solution_fraction * loads.shape[1]), 3 * (rule.n_probes + 1))
    n_probes = min(rule.n_probes, limit // 6, surface.n_positions)
    single = elasticity.single_serves(loads)
    probes = solve_probes(elasticity, loads, n_probes, single)
    basis = GalerkinBasis(elasticity, loads, single)
    basis.solutions = 3 * n_probes
    basis.enrich(load_functions[:, : min(rule.n_start, limit - basis.solutions)])
    history: list[GalerkinErrorEstimate] = []
    while True:
        blocks = basis.residual_blocks()
        history.append(estimate_errors(basis, probes, blocks))
        progress(basis.solutions / limit, history[-1])
        converged = is_met(history[-1], tolerance)
        count = min(rule.n_block, (limit - basis.solutions) // 3)
        if converged or count == 0:
            break
        chosen = worst_positions(basis, surface, blocks, count, probes.positions)
        basis.enrich(_unit_functions(triples(chosen), loads.shape[1]))
    residual, support = residual_compliance(basis, probes, surface, blocks, rule)
    response = CompactResponse(basis.space, basis.load, residual)
    return ReducedResponse(response, support, tuple(history), converged)


def solve_probes(
    elasticity: Elasticity, loads: sp.csr_matrix, n: int, single: bool = False, seed: int = 0
) -> Probes:
    """Return the exact solutions for random load positions."""
    chosen = np.random.default_rng(seed).permutation(loads.shape[1] // 3)[:n]
    solution = elasticity.solve(loads[:, triples(chosen)], single)
    return Probes(chosen, elasticity.at_vertices(solution), loads.T @ solution)


def estimate_errors(
    basis: GalerkinBasis, probes: Probes, blocks: NDArray[np.float64]
) -> GalerkinErrorEstimate:
    """Return the errors of all loads from their residuals, calibrated on the probes.

    The estimate is e(s) ~ c :func:`relative_residual`, with c the ratio of the means over the
    probes. The worst error is the largest e(s) times the largest ratio of true to estimated error
    among the probes.
    """
    relative, exact = relative_residual(basis, blocks), probes.errors(basis)
    estimate = exact.mean() / relative[probes.positions].mean() * relative
    missed = max(1.0, float((exact / estimate[probes.positions]).max()))
    return GalerkinErrorEstimate(
        float(estimate.mean()), missed * float(estimate.max()), basis.rank, basis.solutions
    )


def is_met(estimate: GalerkinErrorEstimate, tolerance: float) -> bool:
    """Return whether mean and worst error are as small as asked for."""
    return estimate.mean <= tolerance and estimate.worst <= WORST_OVER_MEAN * tolerance


def relative_residual(basis: GalerkinBasis, blocks: NDArray[np.float64]) -> FloatArray:
    """Return the larger of eta / sqrt(tr C) and eta / sqrt(f D^-1 f), shape (n_positions,).

    Each is divided by its mean. The first is the error in energy if K were D. It is too small where
    the organ gives way more than D says. The second is free of that, but does not know how far a
    load reaches.
    """
    residual = np.sqrt(np.trace(blocks, axis1=1, axis2=2))
    measures = residual / np.sqrt(basis.compliance_trace()), residual / basis.load_norm
    return np.maximum(*(measure / measure.mean() for measure in measures))


def worst_positions(
    basis: GalerkinBasis,
    surface: LoadSurface,
    blocks: NDArray[np.float64],
    n: int,
    excluded: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return the positions of the largest relative residuals, at least 1.5 patch radii apart."""
    left = relative_residual(basis, blocks)
    left[excluded] = 0.0  # a probe in the space would make the estimate too small
    return surface.largest_apart(left, n, 1.5 * surface.patch_radius)


def residual_compliance(
    basis: GalerkinBasis,
    probes: Probes,
    surface: LoadSurface,
    blocks: NDArray[np.float64],
    rule: ReductionRule,
) -> tuple[FloatArray, float]:
    """Return the residual compliance of each patch, C - Y Y^T, and its reach.

    M(s) = alpha eta-blocks(s). The factor alpha makes the traces at the probes agree. The reach is
    the candidate for which :func:`residual_compliance_blocks` fits the probes' columns best.

    Returns
    -------
    compliance : ndarray, shape (n_positions, 3, 3)
        M [m/N].
    support : float
        Reach [m].
    """
    exact = probes.compliance - basis.load @ basis.load[triples(probes.positions)].T
    exact = exact.reshape(surface.n_positions, 3, len(probes.positions), 3)
    own = sum(np.trace(exact[j, :, k]) for k, j in enumerate(probes.positions))
    scale = max(own, 0.0) / np.trace(blocks[probes.positions], axis1=1, axis2=2).sum()
    compliance = positive_part(scale * blocks)
    root = _root(compliance)
    centers, radius = surface.centers, surface.patch_radius
    distance = np.linalg.norm(centers[:, None] - centers[probes.positions][None], axis=2)
    full = np.einsum("iab,kbc->iakc", root, root[probes.positions], optimize=True)

    def misfit_nearby(support: float) -> float:
        model = taper(distance / (support * radius))[:, None, :, None] * full
        off = ((model - exact) ** 2).sum(axis=(1, 3))
        return float(off[distance < 2.0 * radius].sum())

    return compliance, radius * min(rule.supports, key=misfit_nearby)


def residual_compliance_blocks(
    compliance: FloatArray, support: float, surface: LoadSurface, reach: float
) -> LocalBlocks:
    """Return the residual compliance between neighboring patches, positive definite.

        dC(s, s') = phi(|s - s'| / support) M(s)^(1/2) M(s')^(1/2)

    phi is the taper. The result is the entry-wise product of a positive definite kernel and a Gram
    matrix, therefore positive definite (Schur). Blocks beyond the support, up to ``reach``, are
    kept as zeros.

    Parameters
    ----------
    compliance : ndarray, shape (n_positions, 3, 3)
        M [m/N].
    support : float
        Distance at which phi vanishes [m].
    reach : float
        Largest distance of two patches with a block [m].
    """
    pairs = near_pairs(surface.centers, surface.centers, reach)
    root = _root(compliance)
    position = np.repeat(np.arange(len(compliance)), np.diff(pairs.start))
    fade = taper(pairs.distance / support)[:, None, None]
    block = fade * (root[pairs.target] @ root[position])
    return LocalBlocks(pairs.start, pairs.target, block.astype(np.float32))


def _blocks_of_triples(matrix: sp.csr_matrix) -> NDArray[np.float64]:
    """Return the 3 x 3 blocks on the diagonal of a sparse matrix, shape (n, 3, 3)."""
    entries, blocks = matrix.tocoo(), np.zeros((matrix.shape[0] // 3, 3, 3))
    own = entries.row // 3 == entries.col // 3
    row, column = entries.row[own], entries.col[own]
    blocks[row // 3, row % 3, column % 3] = entries.data[own]
    return blocks


def _unit_functions(loads: NDArray[np.int64], n_loads: int) -> FloatArray:
    """Return load functions of single loads, shape (n_loads, n)."""
    functions = np.zeros((n_loads, len(loads)))
    functions[loads, np.arange(len(loads))] = 1.0
    return functions


def _root(blocks: FloatArray) -> FloatArray:
    """Return the symmetric square roots of positive semi-definite 3 x 3 blocks."""
    value, vector = np.linalg.eigh(blocks)
    return np.asarray(
        (vector * np.sqrt(np.maximum(value, 0.0))[:, None]) @ vector.transpose(0, 2, 1)
    )


def compact_response(
    elasticity: Elasticity, loads: sp.csr_matrix, rank: int = 120, n_probes: int = 8
) -> CompactResponse:
    """Return the response of one anatomy in few modes, by two sweeps of a subspace iteration.

    Parameters
    ----------
    elasticity : Elasticity
        Problem on the registered template.
    loads : sparse, shape (3 n_nodes, n_loads)
        Patches at the registered positions.
    rank : int
        Number of modes, two solutions each.
    n_probes : int
        Number of load positions solved exactly.
    """
    rank = min(rank, loads.shape[1])
    functions = np.random.default_rng(0).standard_normal((loads.shape[1], rank))
    functions = np.linalg.qr(loads.T @ elasticity.solve(loads @ functions))[0]
    basis = GalerkinBasis(elasticity, loads)
    basis.enrich(functions)
    blocks = basis.residual_blocks()
    probes = solve_probes(elasticity, loads, n_probes)
    exact = probes.compliance - basis.load @ basis.load[triples(probes.positions)].T
    exact = exact.reshape(-1, 3, len(probes.positions), 3)
    own = sum(np.trace(exact[j, :, k]) for k, j in enumerate(probes.positions))
    scale = max(own, 0.0) / np.trace(blocks[probes.positions], axis1=1, axis2=2).sum()
    return CompactResponse(
        basis.space.astype(np.float32),
        basis.load.astype(np.float32),
        (scale * blocks).astype(np.float32),
    )
