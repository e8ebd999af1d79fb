"""Near field: the exact contact compliance close to a load, and the taper that fades it out.

The Gram matrix of a truncated basis is too stiff under the tool. Its error near the patch is stored
exactly, in 3 x 3 blocks for the pairs of load positions closer than a radius. The blocks fade out
with distance so that no jump remains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar_core.common.jit import compiled, inlined


@dataclass(frozen=True)
class LocalBlocks:
    """Sparse 3 x 3 blocks by load position (compressed rows).

    Attributes
    ----------
    start : ndarray of int64, shape (n_positions + 1,)
        First block of each row.
    target : ndarray of int32, shape (n_blocks,)
        Load positions, ascending within a row.
    block : ndarray, shape (n_blocks, 3, 3)
        Displacement component by load direction [m/N].
    """

    start: np.ndarray
    target: np.ndarray
    block: np.ndarray

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        return self.start.nbytes + self.target.nbytes + self.block.nbytes

    @property
    def position(self) -> np.ndarray:
        """Row of every block, shape (n_blocks,)."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def distances(self, centers: np.ndarray) -> np.ndarray:
        """Return the distance between the two positions of every block, shape (n_blocks,) [m].

        centers : positions (n, 3) [m]
        """
        return np.asarray(np.linalg.norm(centers[self.position] - centers[self.target], axis=1))

    @property
    def is_upper(self) -> np.ndarray:
        """Whether a block's target is its position or after it, shape (n_blocks,)."""
        return np.asarray(self.target >= self.position)

    def combined(self, positions: np.ndarray, weights: np.ndarray, n_targets: int) -> np.ndarray:
        """Return the weighted sum of some rows, dense, shape (3 n_targets, 3)."""
        out = np.zeros((n_targets, 3, 3))
        for j, weight in zip(positions, weights, strict=True):
            row = slice(self.start[j], self.start[j + 1])
            out[self.target[row]] += weight * self.block[row]
        return out.reshape(-1, 3)


@dataclass(frozen=True)
class Mirror:
    """Map from the upper half of symmetric blocks to all of them.

    Attributes
    ----------
    start, target : ndarray
        Compressed rows of all blocks.
    source : ndarray, shape (n_blocks,)
        Number of the upper-half block that each block equals, or is the transpose of.
    turned : ndarray of bool, shape (n_blocks,)
        Whether it is the transpose.
    """

    start: np.ndarray
    target: np.ndarray
    source: np.ndarray
    turned: np.ndarray

    @classmethod
    def of(cls, start: np.ndarray, target: np.ndarray) -> Mirror:
        """Return the map for the compressed rows of the upper half."""
        n_rows = len(start) - 1
        position = np.repeat(np.arange(n_rows), np.diff(start))
        below = np.flatnonzero(target > position)
        row = np.concatenate([position, target[below]])
        column = np.concatenate([target, position[below]])
        order = np.lexsort((column, row))
        count = np.bincount(row, minlength=n_rows)
        return cls(
            np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
            column[order].astype(np.int32),
            np.concatenate([np.arange(len(target)), below])[order],
            order >= len(target),
        )

    def whole(self, block: np.ndarray) -> np.ndarray:
        """Return all blocks from the upper half's blocks (..., n_upper, 3, 3)."""
        out = block[..., self.source, :, :]
        out[..., self.turned, :, :] = out[..., self.turned, :, :].swapaxes(-1, -2)
        return np.ascontiguousarray(out)


@dataclass(frozen=True)
class Pairs:
    """Pairs of near positions and targets, in compressed rows, with their distance [m]."""

    start: np.ndarray
    target: np.ndarray
    distance: np.ndarray


def near_pairs(positions: np.ndarray, targets: np.ndarray, radius: float) -> Pairs:
    """Return all pairs closer than ``radius``; rows by position, targets ascending."""
    # Here, because the contact node needs none of it.
    from scipy.spatial import cKDTree

    hits = cKDTree(targets).query_ball_point(positions, radius, return_sorted=True)
    start = np.concatenate([[0], np.cumsum([len(hit) for hit in hits])]).astype(np.int64)
    target = np.concatenate([np.asarray(hit, np.int32) for hit in hits])
    position = np.repeat(np.arange(len(positions)), np.diff(start))
    distance = np.linalg.norm(positions[position] - targets[target], axis=1)
    return Pairs(start, target, distance)


def taper(distance: np.ndarray) -> np.ndarray:
    """Return a taper: one at distance 0, zero from 1 on, and positive definite in space.

    The entry-wise product of two positive semi-definite matrices is positive semi-definite (Schur).
    Tapering a residual compliance therefore keeps every contact problem well posed. Geostatistics
    calls it covariance tapering (Furrer, Genton & Nychka 2006). This taper falls off least at first
    of all such functions (Gneiting, J. Multivariate Analysis 83, 2002):

        (1 - r) sin(2 pi r) / (2 pi r) + (1 - cos(2 pi r)) / (2 pi^2 r)
    """
    r = np.minimum(distance, 1.0)
    # sinc x = sin(pi x) / (pi x); 1 - cos(2 pi r) = 2 sin^2(pi r)
    return np.asarray((1.0 - r) * np.sinc(2.0 * r) + r * np.sinc(r) ** 2)


_HASH = 2654435761  # Knuth's multiplicative hashing, The Art of Computer Programming 3, Sec. 6.4


def hash_rows(near: LocalBlocks) -> tuple[np.ndarray, np.ndarray]:
    """Return open-addressing tables by which a compiled loop finds one block of a row at once.

    Returns
    -------
    start : ndarray of int64, shape (n_rows + 1,)
        First slot of each row; a row has a power of two slots.
    slot : ndarray of int32, shape (n_slots, 2)
        Target (-1: empty) and index of its block.
    """
    length = np.diff(near.start)
    size = 2 ** np.ceil(np.log2(np.maximum(2 * length, 2))).astype(np.int64)
    start = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    slot = np.full((start[-1], 2), -1, np.int32)
    _fill_slots(near.start, near.target, start, slot)
    return start, slot


@compiled()
def _fill_slots(row_start, target, start, slot):  # type: ignore[no-untyped-def]
    for j in range(len(row_start) - 1):
        mask = start[j + 1] - start[j] - 1
        for e in range(row_start[j], row_start[j + 1]):
            k = (np.int64(target[e]) * _HASH >> 16) & mask
            while slot[start[j] + k, 0] >= 0:
                k = (k + 1) & mask
            slot[start[j] + k, 0] = target[e]
            slot[start[j] + k, 1] = e


@inlined
def find_block(start, slot, row, target):  # type: ignore[no-untyped-def]
    """Return the block of a row and target in the tables of :func:`hash_rows`, or -1."""
    mask = start[row + 1] - start[row] - 1
    k = (np.int64(target) * _HASH >> 16) & mask
    while True:
        found = slot[start[row] + k, 0]
        if found == target:
            return slot[start[row] + k, 1]
        if found < 0:
            return -1
        k = (k + 1) & mask
