"""The exact part of the response close to a load, and the tapers that let it fade out.

A truncated separated field is smooth and too stiff under the tool. Its error near the patch is
stored exactly: 3 x 3 blocks for the pairs of (load position, target) closer than a radius,
faded out so that no jump remains. Targets are mesh vertices (displacement field) or load
positions (contact compliance).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from avatar_core.common.jit import compiled, inlined


@dataclass(frozen=True)
class LocalBlocks:
    """Sparse 3 x 3 blocks by load position (compressed rows).

    start : ndarray of int64, shape (n_positions + 1,)
    target : ndarray of int32, shape (n_blocks,), ascending within a row
    block : ndarray, shape (n_blocks, 3, 3), displacement component by load direction [m/N]
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

    def kept(self, mask: np.ndarray) -> LocalBlocks:
        """The blocks for which a mask holds, shape (n_blocks,)."""
        count = np.bincount(self.position[mask], minlength=len(self.start) - 1)
        start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        return LocalBlocks(
            start, np.ascontiguousarray(self.target[mask]), np.ascontiguousarray(self.block[mask])
        )

    def with_whole_rows(self, rows: dict[int, np.ndarray]) -> LocalBlocks:
        """The same with some rows replaced by blocks for all targets, each (n_targets, 3, 3)."""
        if not rows:
            return self
        targets, blocks = [], []
        for j in range(len(self.start) - 1):
            row = slice(self.start[j], self.start[j + 1])
            whole = rows.get(j)
            targets.append(self.target[row] if whole is None else np.arange(len(whole)))
            blocks.append(self.block[row] if whole is None else whole)
        start = np.concatenate([[0], np.cumsum([len(t) for t in targets])]).astype(np.int64)
        target = np.concatenate(targets).astype(np.int32)
        return LocalBlocks(start, target, np.concatenate(blocks).astype(self.block.dtype))

    def combined(self, positions: np.ndarray, weights: np.ndarray, n_targets: int) -> np.ndarray:
        """Weighted sum of some rows, dense, shape (3 n_targets, 3)."""
        out = np.zeros((n_targets, 3, 3))
        for j, weight in zip(positions, weights, strict=True):
            row = slice(self.start[j], self.start[j + 1])
            out[self.target[row]] += weight * self.block[row]
        return out.reshape(-1, 3)


@dataclass(frozen=True)
class Pairs:
    """Which (position, target) pairs are near, in compressed rows, and how far apart [m]."""

    start: np.ndarray
    target: np.ndarray
    distance: np.ndarray


def near_pairs(positions: np.ndarray, targets: np.ndarray, radius: float) -> Pairs:
    """All pairs closer than ``radius``; rows by position, targets ascending."""
    hits = cKDTree(targets).query_ball_point(positions, radius, return_sorted=True)
    start = np.concatenate([[0], np.cumsum([len(hit) for hit in hits])]).astype(np.int64)
    target = np.concatenate([np.asarray(hit, np.int32) for hit in hits])
    position = np.repeat(np.arange(len(positions)), np.diff(start))
    distance = np.linalg.norm(positions[position] - targets[target], axis=1)
    return Pairs(start, target, distance)


def plateau(distance: np.ndarray, inner: float, outer: float) -> np.ndarray:
    """One up to ``inner``, zero from ``outer``, once continuously differentiable between."""
    t = np.clip((distance - inner) / (outer - inner), 0.0, 1.0)
    return 1.0 - t * t * (3.0 - 2.0 * t)


def wendland(distance: np.ndarray, support: float) -> np.ndarray:
    """Wendland's function (1 - r)^4 (4 r + 1), positive definite in space (Wendland 1995).

    The entry-wise product of two positive semi-definite matrices is positive semi-definite
    (Schur), so tapering a residual compliance with it keeps every contact problem well posed;
    in geostatistics this is covariance tapering (Furrer, Genton & Nychka 2006).
    """
    r = np.minimum(distance / support, 1.0)
    return (1.0 - r) ** 4 * (4.0 * r + 1.0)


_HASH = 2654435761  # Knuth's multiplicative hashing, The Art of Computer Programming 3, Sec. 6.4


def hash_rows(near: LocalBlocks) -> tuple[np.ndarray, np.ndarray]:
    """Open-addressing tables by which a compiled loop finds one block of a row at once.

    Returns
    -------
    start : ndarray of int64, shape (n_rows + 1,), slots of each row, a power of two
    slot : ndarray of int32, shape (n_slots, 2), target (-1: empty) and index of its block
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
    """Index of the block of a row and target in the tables of :func:`hash_rows`, or -1."""
    mask = start[row + 1] - start[row] - 1
    k = (np.int64(target) * _HASH >> 16) & mask
    while True:
        found = slot[start[row] + k, 0]
        if found == target:
            return slot[start[row] + k, 1]
        if found < 0:
            return -1
        k = (k + 1) & mask
