"""The paper's own form of PGD, with vectors over the load: a faithful baseline.

    u(x, s) ~ sum_k X_k(x) o S_k(s)      (paper Eq. 6, o the entry-wise product of two 3-vectors)

Alternating directions of an enrichment R o S (paper Eqs. 7-14): with S known, the stiffness
couples the components of R by m_cc' = sum_s S^c(s) S^c'(s); with R known, every load is a 3 x 3
system.
Where all loads have one direction this says no more than a scalar S, and costs a different
stiffness in every sweep: it serves as a baseline for comparison only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, cg

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ConvergenceError
from avatar_core.fem.elasticity import Elasticity

# An enrichment with less energy than this, of the largest one's, is made of rounding errors.
_ROUNDING = 1e-26


@dataclass(frozen=True, eq=False)
class HadamardField:
    """u(x, s) = sum_k X_k(x) o S_k(s).

    space : ndarray, shape (n_nodes, 3, rank) [m]; load : ndarray, shape (n_loads, 3, rank)
    sweeps : of each enrichment, shape (rank,)
    converged : whether they met their tolerance, or ended at the limit; shape (rank,)
    """

    space: FloatArray
    load: FloatArray
    sweeps: tuple[int, ...]
    converged: tuple[bool, ...]

    def evaluate(self, rank: int | None = None) -> FloatArray:
        """The field with the first modes, shape (3 n_nodes, n_loads)."""
        space, load = self.space[..., :rank], self.load[..., :rank]
        return np.einsum("xck,sck->xcs", space, load).reshape(-1, len(load))


def solve_hadamard(
    elasticity: Elasticity,
    loads: sp.csr_matrix,
    n_modes: int,
    max_sweeps: int = 10,
    sweep_tolerance: float = 1e-2,
    progress: Callable[[int], None] = lambda rank: None,
) -> HadamardField:
    """Greedy enrichment with alternating directions, as in the paper.

    Parameters
    ----------
    loads : sparse, shape (3 n_nodes, n_loads)
    n_modes : at most, as it stops where only rounding is left

    Raises
    ------
    ConvergenceError
        If the right-hand side is zero, or a linear system is not solved.
    """
    state = _State(elasticity, loads)
    ends: list[tuple[int, bool]] = []
    largest = 0.0
    for _ in range(n_modes):
        space, load, n_sweeps, enough = _enrich(state, max_sweeps, sweep_tolerance)
        energy = state.energy(space, load)
        if energy <= _ROUNDING * largest:
            break
        largest = max(largest, energy)
        state.append(space, load)
        ends.append((n_sweeps, enough))
        progress(len(ends))
    sweeps, converged = zip(*ends, strict=True)
    return HadamardField(
        np.stack(state.space, axis=2), np.stack(state.load, axis=2), sweeps, converged
    )


def _enrich(
    state: _State, max_sweeps: int, tolerance: float
) -> tuple[FloatArray, FloatArray, int, bool]:
    """One R o S, the number of sweeps it took, and whether that was enough."""
    rng = np.random.default_rng(len(state.space))
    load: FloatArray = rng.standard_normal((state.n_loads, 3))
    before: FloatArray | None = None
    sweep = 0
    while sweep < max_sweeps:
        sweep += 1
        space = state.space_step(load, before)
        load = state.load_step(space)
        if before is not None:
            change = np.linalg.norm(space - before) / np.linalg.norm(space)
            if change < tolerance:
                return space, load, sweep, True
        size = np.linalg.norm(load, axis=0)
        size[size == 0.0] = 1.0
        load = load / size
        before = space * size
    return space, load, sweep, False


class _State:
    def __init__(self, elasticity: Elasticity, loads: sp.csr_matrix) -> None:
        self._elasticity = elasticity
        self._free = np.ones((elasticity.n_nodes, 3), bool)
        self._free[elasticity.clamped_nodes] = False
        stiffness = elasticity.stiffness
        self._blocks = [[stiffness[c::3, d::3].tocsr() for d in range(3)] for c in range(3)]
        self._force = loads.toarray().reshape(elasticity.n_nodes, 3, -1)
        if not self._force[self._free].any():
            raise ConvergenceError("all loads are zero: there is nothing to separate")
        self.n_loads = loads.shape[1]
        self.space: list[FloatArray] = []
        self.load: list[FloatArray] = []
        self._images: list[list[list[FloatArray]]] = []  # K_cd X_k^d

    def space_step(self, load: FloatArray, start: FloatArray | None) -> FloatArray:
        """R, shape (n_nodes, 3)."""
        mixing = load.T @ load
        right = np.einsum("xcs,sc->xc", self._force, load)
        for images, known in zip(self._images, self.load, strict=True):
            coupled = load.T @ known
            for c in range(3):
                for d in range(3):
                    right[:, c] -= coupled[c, d] * images[c][d]
        right[~self._free] = 0.0
        shape = right.shape

        def apply(vector: FloatArray) -> FloatArray:
            r = np.where(self._free, vector.reshape(shape), 0.0)
            out = np.stack(
                [
                    sum(mixing[c, d] * (self._blocks[c][d] @ r[:, d]) for d in range(3))
                    for c in range(3)
                ],
                axis=1,
            )
            return np.where(self._free, out, 0.0).ravel()

        root = np.sqrt(np.diagonal(mixing)) + 1e-6 * np.sqrt(np.trace(mixing))

        def precondition(vector: FloatArray) -> FloatArray:
            scaled = (vector.reshape(shape) / root).reshape(-1, 1)
            return np.asarray(self._elasticity.solve(scaled).reshape(shape) / root).ravel()

        n = right.size
        found, failed = cg(
            LinearOperator((n, n), matvec=apply),
            right.ravel(),
            x0=None if start is None else start.ravel(),
            rtol=1e-3,
            maxiter=300,
            M=LinearOperator((n, n), matvec=precondition),
        )
        if failed:
            raise ConvergenceError("a space function was not found in 300 iterations")
        return np.asarray(found).reshape(shape)

    def load_step(self, space: FloatArray) -> FloatArray:
        """S, a 3 x 3 system at each load, shape (n_loads, 3)."""
        matrix = self._own(space)
        right = np.einsum("xc,xcs->sc", space, self._force)
        for images, known in zip(self._images, self.load, strict=True):
            coupled = np.array([[space[:, c] @ images[c][d] for d in range(3)] for c in range(3)])
            right -= known @ coupled.T
        return np.asarray(np.linalg.lstsq(matrix, right.T, rcond=1e-10)[0].T)

    def energy(self, space: FloatArray, load: FloatArray) -> float:
        """Of R o S, summed over the loads."""
        return float(np.einsum("sc,cd,sd->", load, self._own(space), load))

    def _own(self, space: FloatArray) -> FloatArray:
        """R^c . K_cd R^d, shape (3, 3)."""
        blocks = self._blocks
        return np.array(
            [[space[:, c] @ (blocks[c][d] @ space[:, d]) for d in range(3)] for c in range(3)]
        )

    def append(self, space: FloatArray, load: FloatArray) -> None:
        """Keep R o S."""
        self.space.append(space)
        self.load.append(load)
        images = [[self._blocks[c][d] @ space[:, d] for d in range(3)] for c in range(3)]
        self._images.append(images)
