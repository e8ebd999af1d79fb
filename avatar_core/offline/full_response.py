"""The response of an organ to every load, at its vertices."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from avatar_core.common.processes import on_all_cores
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_norm
from avatar_core.fem.patch_loads import LoadSurface, triples
from avatar_core.offline.rule import NO_ERROR, Progress
from avatar_core.reduction.block_field import BlockField, Blocks
from avatar_core.reduction.near_field import LocalBlocks, near_pairs, taper
from avatar_core.reduction.separated import SeparatedField

_BATCH = 80  # load positions solved at once: fewer take longer each


@dataclass(frozen=True, eq=False)
class FullResponse:
    """The response to every load, in single precision.

    Attributes
    ----------
    columns : ndarray, shape (3 n_vertices, n_loads)
        Displacement at the vertices [m/N].
    compliance : ndarray, shape (n_loads, n_loads)
        Symmetric compliance between patches [m/N].
    norm : ndarray, shape (n_loads,)
        Mass-weighted L2 norm of each column [m^(5/2)/N].
    """

    columns: np.ndarray
    compliance: np.ndarray
    norm: np.ndarray

    @property
    def energy(self) -> np.ndarray:
        """Patch compliance of each load, shape (n_loads,) [m/N]."""
        return np.diagonal(self.compliance).astype(float)

    def remainder(self, far: SeparatedField, positions: np.ndarray) -> np.ndarray:
        """Return positions' columns minus a field, shape (3 n_vertices, n, 3)."""
        loads = (3 * positions[:, None] + np.arange(3)).ravel()
        smooth = far.space.astype(np.float32) @ far.load[loads].T.astype(np.float32)
        return (self.columns[:, loads] - smooth).reshape(len(smooth), -1, 3)

    def errors(self, blocks: Blocks, field: BlockField, mass: np.ndarray) -> np.ndarray:
        """Return the relative L2 errors of a field under each load, shape (n_loads,).

        mass : ndarray, shape (3 n_vertices,), lumped
        """
        out = np.empty(len(self.norm))
        for r in range(field.n_regions):
            here = triples(np.flatnonzero(field.region == r))
            load = field.load.reshape(len(out), field.rank)[here, : field.count[1 + r]]
            shown = blocks.at_vertices(field.of_part(1 + r, load.T))
            out[here] = l2_norm(shown - self.columns[:, here], mass) / self.norm[here]
        return out


def full_response(elasticity: Elasticity, loads: sp.csr_matrix, progress: Progress) -> FullResponse:
    """Solve for every load position, in single precision where it is accurate enough, on all cores.

    Batches do not depend on the number of cores, nor do the bits of their solutions.

    loads : sparse, shape (3 n_nodes, n_loads), three loads for each position
    """
    average, by_column, n = loads.T.tocsr(), loads.tocsc(), loads.shape[1]
    single = elasticity.single_serves(by_column)
    columns = np.empty((3 * len(elasticity.mesh.vertices), n), np.float32, order="F")
    compliance = np.empty((n, n), np.float32, order="F")
    mass = elasticity.mesh.lumped_mass.astype(np.float32)
    norm = np.empty(n, np.float32)

    def solve(first: int) -> None:
        batch = slice(first, first + 3 * _BATCH)
        solution = elasticity.solve(by_column[:, batch], single)
        columns[:, batch] = elasticity.at_vertices(solution)
        compliance[:, batch] = average @ solution
        norm[batch] = l2_norm(columns[:, batch], mass)

    elasticity.factorize(single)
    first = range(0, n, 3 * _BATCH)
    for start, _ in zip(first, on_all_cores(solve, first), strict=True):
        progress("solve", min(start + 3 * _BATCH, n) / n, NO_ERROR)
    _symmetrize(compliance)
    return FullResponse(columns, compliance, norm)


def _symmetrize(matrix: np.ndarray) -> None:
    """Replace C by (C + C^T) / 2 in place, by strips; only rounding changes (Maxwell-Betti)."""
    for k in range(0, len(matrix), 3 * _BATCH):
        strip = slice(k, k + 3 * _BATCH)
        mean = 0.5 * (matrix[k:, strip] + matrix[strip, k:].T)
        matrix[k:, strip], matrix[strip, k:] = mean, mean.T


def contact_blocks(response: FullResponse, surface: LoadSurface, support: float) -> LocalBlocks:
    """Return the compliance between load positions up to a distance [m] apart."""
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
    """Return C - Y Y^T, tapered up to a distance and exactly symmetric.

    exact : of :func:`contact_blocks`
    load : ndarray, shape (n_loads, rank), Y
    support : distance [m]
    """
    distance = exact.distances(surface.centers)
    return _symmetrized(remainder(exact, load, taper(distance / support)))


def remainder(exact: LocalBlocks, load: np.ndarray, fade: np.ndarray) -> LocalBlocks:
    """Return (C - Y Y^T) of blocks of a compliance, times a factor for each block."""
    load = load.reshape(len(load) // 3, 3, load.shape[1])
    block = np.empty(exact.block.shape, np.float32)
    for j in range(len(exact.start) - 1):
        row = slice(exact.start[j], exact.start[j + 1])
        smooth = np.tensordot(load[exact.target[row]], load[j], ([2], [1]))
        block[row] = fade[row, None, None] * (exact.block[row] - smooth)
    return replace(exact, block=block)


def _symmetrized(blocks: LocalBlocks) -> LocalBlocks:
    """Return (B + B^T) / 2 block by block; only rounding changes (Maxwell-Betti)."""
    order = np.lexsort((blocks.position, blocks.target))  # the transpose, in the same pattern
    mean = 0.5 * (blocks.block + blocks.block[order].transpose(0, 2, 1))
    return replace(blocks, block=mean)
