"""The response of an organ to every load, at its vertices."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import IntArray
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_norm
from avatar_core.fem.patch_loads import LoadSurface, triples
from avatar_core.offline.rule import NO_ERROR, Progress
from avatar_core.reduction.near_field import LocalBlocks, near_pairs, taper
from avatar_core.reduction.separated import SeparatedField

_BATCH = 80  # load positions solved at once: fewer take longer each


@dataclass(frozen=True, eq=False)
class FullResponse:
    """The response to every load, in single precision.

    columns : ndarray, shape (3 n_vertices, n_loads), displacement at the vertices [m/N]
    compliance : ndarray, shape (n_loads, n_loads), of patch under patch, symmetric [m/N]
    norm : ndarray, shape (n_loads,), mass-weighted L2 norm of each column [m^(5/2)/N]
    """

    columns: np.ndarray
    compliance: np.ndarray
    norm: np.ndarray

    @property
    def energy(self) -> np.ndarray:
        """Patch compliance of each load, shape (n_loads,) [m/N]."""
        return np.diagonal(self.compliance).astype(float)

    def remainder(self, far: SeparatedField, positions: np.ndarray) -> np.ndarray:
        """What a field leaves of some positions' columns, shape (3 n_vertices, n, 3)."""
        loads = (3 * positions[:, None] + np.arange(3)).ravel()
        smooth = far.space.astype(np.float32) @ far.load[loads].T.astype(np.float32)
        return (self.columns[:, loads] - smooth).reshape(len(smooth), -1, 3)


class Solving:
    """The arrays of a response, filled load position by load position.

    Parameters
    ----------
    loads : sparse, shape (3 n_nodes, n_loads), three for each position
    single : solve in single precision where that does, in half the time

    Attributes
    ----------
    columns, compliance : of :class:`FullResponse`; columns of other loads are not set yet
    """

    def __init__(self, elasticity: Elasticity, loads: sp.csr_matrix, single: bool) -> None:
        self._elasticity, self._average = elasticity, loads.T.tocsr()
        self._by_column, n = loads.tocsc(), loads.shape[1]
        self._single = single and elasticity.single_serves(self._by_column)
        self.columns = np.empty((3 * len(elasticity.mesh.vertices), n), np.float32, order="F")
        self.compliance = np.empty((n, n), np.float32, order="F")

    def solve(self, positions: IntArray) -> Iterator[int]:
        """Solve for some positions, batch by batch; yields how many of them are done."""
        for first in range(0, len(positions), _BATCH):
            chosen = triples(positions[first : first + _BATCH])
            solution = self._elasticity.solve(self._by_column[:, chosen], self._single)
            self.columns[:, chosen] = self._elasticity.at_vertices(solution)
            self.compliance[:, chosen] = self._average @ solution
            yield min(first + _BATCH, len(positions))

    def response(self) -> FullResponse:
        """The response, once every column is set."""
        _symmetrize(self.compliance)
        columns, mass = self.columns, self._elasticity.mesh.lumped_mass.astype(np.float32)
        batches = range(0, columns.shape[1], 3 * _BATCH)
        norm = np.concatenate([l2_norm(columns[:, k : k + 3 * _BATCH], mass) for k in batches])
        return FullResponse(columns, self.compliance, norm)


def full_response(
    elasticity: Elasticity, loads: sp.csr_matrix, progress: Progress, single: bool = False
) -> FullResponse:
    """Solve for every load position.

    single : solve in single precision where that does, in half the time
    """
    solving, n = Solving(elasticity, loads, single), loads.shape[1] // 3
    for done in solving.solve(np.arange(n)):
        progress("solve", done / n, NO_ERROR)
    return solving.response()


def _symmetrize(matrix: np.ndarray) -> None:
    """(C + C^T) / 2 in place, by strips: rounding is all it removes (Maxwell-Betti)."""
    for k in range(0, len(matrix), 3 * _BATCH):
        strip = slice(k, k + 3 * _BATCH)
        mean = 0.5 * (matrix[k:, strip] + matrix[strip, k:].T)
        matrix[k:, strip], matrix[strip, k:] = mean, mean.T


def contact_blocks(response: FullResponse, surface: LoadSurface, support: float) -> LocalBlocks:
    """The compliance between load positions up to a distance [m] apart."""
    pairs = near_pairs(surface.centers, surface.centers, support)
    exact = response.compliance.reshape(surface.n_positions, 3, surface.n_positions, 3)
    blocks = np.empty((len(pairs.target), 3, 3), np.float32)
    for j in range(surface.n_positions):
        row = slice(pairs.start[j], pairs.start[j + 1])
        blocks[row] = exact[pairs.target[row], :, j]
    return LocalBlocks(pairs.start, pairs.target, blocks)


def contact_near(
    exact: LocalBlocks, load: np.ndarray, surface: LoadSurface, support: float
) -> LocalBlocks:
    """(C - Y Y^T), tapered up to a distance and exactly symmetric.

    exact : of :func:`contact_blocks`
    load : ndarray, shape (n_loads, rank), Y
    support : [m]
    """
    distance = exact.distances(surface.centers)
    return _symmetrized(remainder(exact, load, taper(distance / support)))


def remainder(exact: LocalBlocks, load: np.ndarray, fade: np.ndarray) -> LocalBlocks:
    """(C - Y Y^T) of blocks of a compliance, times a factor of each block."""
    load = load.reshape(len(load) // 3, 3, load.shape[1])
    block = np.empty(exact.block.shape, np.float32)
    for j in range(len(exact.start) - 1):
        row = slice(exact.start[j], exact.start[j + 1])
        smooth = np.tensordot(load[exact.target[row]], load[j], ([2], [1]))
        block[row] = fade[row, None, None] * (exact.block[row] - smooth)
    return replace(exact, block=block)


def _symmetrized(blocks: LocalBlocks) -> LocalBlocks:
    """(B + B^T) / 2 block by block: rounding is all it removes (Maxwell-Betti)."""
    order = np.lexsort((blocks.position, blocks.target))  # the transpose, in the same pattern
    mean = 0.5 * (blocks.block + blocks.block[order].transpose(0, 2, 1))
    return replace(blocks, block=mean)
