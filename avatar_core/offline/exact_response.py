"""The full solutions of a build, each computed once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_norm
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.offline.rule import NO_ERROR, Progress
from avatar_core.reduction.near_field import LocalBlocks, near_pairs, taper
from avatar_core.reduction.separated import SeparatedField

_BATCH = 80  # load positions solved at once: fewer take longer each
_TRIED = 2  # load positions on which single precision is tried,
SINGLE_ERROR = 1e-3  # and the relative error up to which it does: modes leave six times it


@dataclass(frozen=True, eq=False)
class ExactResponse:
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


def exact_response(
    elasticity: Elasticity,
    surface: LoadSurface,
    loads: sp.csr_matrix,
    progress: Progress,
    single: bool = False,
) -> ExactResponse:
    """Solve for every load position.

    single : solve in single precision where that does, in half the time
    """
    n, n_rows = surface.n_positions, 3 * len(elasticity.mesh.vertices)
    columns = np.empty((n_rows, 3 * n), np.float32, order="F")
    compliance = np.empty((3 * n, 3 * n), np.float32, order="F")
    by_column, average = loads.tocsc(), loads.T.tocsr()
    single = single and single_serves(elasticity, by_column[:, : 3 * _TRIED])
    for first in range(0, 3 * n, 3 * _BATCH):
        batch = slice(first, min(first + 3 * _BATCH, 3 * n))
        solution = elasticity.solve(by_column[:, batch], single)
        columns[:, batch] = elasticity.at_vertices(solution)
        compliance[:, batch] = average @ solution
        progress("solve", batch.stop / (3 * n), NO_ERROR)
    _symmetrize(compliance)
    mass = elasticity.mesh.lumped_mass.astype(np.float32)
    batches = range(0, 3 * n, 3 * _BATCH)
    norm = np.concatenate([l2_norm(columns[:, k : k + 3 * _BATCH], mass) for k in batches])
    return ExactResponse(columns, compliance, norm)


def single_serves(elasticity: Elasticity, loads: sp.csc_matrix) -> bool:
    """Whether solutions in single precision are good enough, by trying it on these loads."""
    return elasticity.single_error(loads) < SINGLE_ERROR


def _symmetrize(matrix: np.ndarray) -> None:
    """(C + C^T) / 2 in place, by strips: rounding is all it removes (Maxwell-Betti)."""
    for k in range(0, len(matrix), 3 * _BATCH):
        strip = slice(k, k + 3 * _BATCH)
        mean = 0.5 * (matrix[k:, strip] + matrix[strip, k:].T)
        matrix[k:, strip], matrix[strip, k:] = mean, mean.T


def contact_blocks(response: ExactResponse, surface: LoadSurface, support: float) -> LocalBlocks:
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
