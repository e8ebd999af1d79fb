"""A field over the load surface, separated region by region.

    u(x, s_j) ~ sum_k Z_k(x) W_k(s_j),    k over the modes of the region that holds s_j.

Loads near one another move an organ alike: some dozen modes for each of some dozen regions leave
less than hundreds of modes for all loads at once, and a step reads only those of the tip's region.
Each load position belongs to one region. Between positions the response is interpolated as ever, so
that it is as smooth where a tip crosses from one region to the next as it is within one.

The modes of a region are the principal components of its columns (Eckart & Young, Psychometrika 1,
1936), each column divided by its own size: they leave the least relative error that so many can.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.vq import kmeans2

from avatar_core.common.arrays import FloatArray, IntArray

_ITERATIONS = 30  # of k-means


@dataclass(frozen=True, eq=False)
class RegionalField:
    """A field over space and load, in modes of their own for each region of the load surface.

    region : ndarray of int32, shape (n_positions,), region of each load position
    start : ndarray of int64, shape (n_regions + 1,), columns of ``space`` of each region
    space : ndarray of float16, shape (3 n_vertices, start[-1]), Z, each with a peak of 1
    load : ndarray, shape (n_positions, n_loads, most), W of some loads at each position; zero
        beyond the modes of the position's region
    """

    region: IntArray
    start: IntArray
    space: FloatArray
    load: FloatArray

    @property
    def n_regions(self) -> int:
        """Number of regions."""
        return len(self.start) - 1

    @property
    def rank(self) -> int:
        """Modes of the region that has most."""
        return self.load.shape[2]

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        return sum(a.nbytes for a in (self.region, self.start, self.space, self.load))

    def modes(self, region: int) -> FloatArray:
        """Z of one region, shape (3 n_vertices, n), in single precision."""
        return self.space[:, self.start[region] : self.start[region + 1]].astype(np.float32)

    def combined(self, positions: IntArray, weights: FloatArray) -> FloatArray:
        """Weighted sum over some load positions, shape (3 n_vertices, n_loads)."""
        out = np.zeros((len(self.space), self.load.shape[1]), np.float32)
        regions = self.region[positions]
        for region in np.unique(regions):
            at, modes = regions == region, self.modes(region)
            load = np.tensordot(weights[at], self.load[positions[at]], 1)
            out += modes @ load[:, : modes.shape[1]].T.astype(np.float32)
        return out

    def coefficients(self, fields: FloatArray, mass: FloatArray) -> FloatArray:
        """Fields (3 n_vertices, n) in the modes of each region, (n_modes, n); mass-orthogonal."""
        out = np.empty((self.space.shape[1], fields.shape[1]))
        root = np.sqrt(mass)[:, None]
        for r in range(self.n_regions):
            modes = self.modes(r).astype(float) * root
            size = (modes**2).sum(axis=0)[:, None]
            out[self.start[r] : self.start[r + 1]] = modes.T @ (root * fields) / size
        return out

    def truncated(self, most: int) -> RegionalField:
        """The same with the first modes of each region alone."""
        if most >= self.rank:
            return self
        counts = np.minimum(np.diff(self.start), max(most, 0))
        kept = [np.arange(a, a + n) for a, n in zip(self.start, counts, strict=False)]
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        columns = np.concatenate(kept)
        return replace(
            self, start=start, space=self.space[:, columns], load=self.load[:, :, : max(most, 0)]
        )

    def scaled(self, factor: float) -> RegionalField:
        """The field times a number."""
        return replace(self, load=np.float32(factor) * self.load)


@dataclass(frozen=True)
class RegionalRule:
    """How many modes a region gets.

    tolerance : mean relative L2 error over the region's loads; worst : of its worst load
    most : modes of a region at most
    """

    tolerance: float
    worst: float
    most: int


def regions_of(centers: FloatArray, n_regions: int) -> IntArray:
    """Regions of load positions that lie together, by k-means, shape (n_positions,) int32."""
    n_regions = max(1, min(n_regions, len(centers)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a region may come out empty: it is dropped
        _, label = kmeans2(centers, n_regions, iter=_ITERATIONS, minit="++", rng=0)
    return np.unique(label, return_inverse=True)[1].astype(np.int32)


def separate_regions(
    region: IntArray,
    columns: Callable[[IntArray], FloatArray],
    size: FloatArray,
    mass: FloatArray,
    rule: RegionalRule,
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[RegionalField, FloatArray]:
    """The modes of every region.

    Parameters
    ----------
    region : ndarray of int32, shape (n_positions,)
    columns : of some positions, shape (3 n_vertices, n, n_loads)
    size : ndarray, shape (n_positions, n_loads), L2 norm by which an error is relative
    mass : ndarray, shape (3 n_vertices,), lumped

    Returns
    -------
    RegionalField
    errors : ndarray, shape (most + 1, n_positions, n_loads), relative L2 error that so many modes
        of its region leave each load; those beyond the modes kept leave what is left
    """
    parts, n_loads = [], size.shape[1]
    errors = np.empty((rule.most + 1, *size.shape))
    root = np.sqrt(mass).astype(np.float32)[:, None]
    n_regions = int(region.max()) + 1
    for r in range(n_regions):
        here = np.flatnonzero(region == r)
        scaled = columns(here).reshape(len(mass), -1) * (root / size[here].ravel())
        modes, load, left = _principal(scaled.astype(np.float32), rule)
        parts.append((modes / root, load.reshape(len(here), n_loads, -1) * size[here][..., None]))
        errors[:, here] = left.reshape(-1, len(here), n_loads)
        progress((r + 1) / n_regions)
    return _assembled(region, parts), errors


def _principal(
    columns: FloatArray, rule: RegionalRule
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Modes (n_dofs, k), their amounts in each column (n, k), and the errors (most + 1, n)."""
    gram = (columns.T @ columns).astype(float)
    value, vector = np.linalg.eigh(gram)
    value, vector = np.maximum(value[::-1], 0.0), vector[:, ::-1]
    most = min(rule.most, len(value))
    captured = np.cumsum(value[:most] * vector[:, :most] ** 2, axis=1)
    left = np.sqrt(np.maximum(np.diagonal(gram)[:, None] - captured, 0.0)).T
    left = np.vstack([np.sqrt(np.diagonal(gram)), left])
    met = (left.mean(axis=1) <= rule.tolerance) & (left.max(axis=1) <= rule.worst)
    rank = int(np.argmax(met)) if met.any() else most
    left[rank + 1 :] = left[rank]
    left = np.vstack([left, np.repeat(left[-1:], rule.most - most, axis=0)])
    kept = vector[:, :rank]
    return columns @ kept.astype(np.float32), kept, left


def _assembled(region: IntArray, parts: Sequence[tuple[FloatArray, FloatArray]]) -> RegionalField:
    """One field of the regions' modes, each scaled to a peak of 1, and their loads."""
    ranks = [modes.shape[1] for modes, _ in parts]
    start = np.concatenate([[0], np.cumsum(ranks)]).astype(np.int64)
    n_loads = parts[0][1].shape[1]
    space = np.empty((len(parts[0][0]), start[-1]), np.float16)
    load = np.zeros((len(region), n_loads, max(ranks)), np.float32)
    for r, (modes, amounts) in enumerate(parts):
        peak = np.maximum(np.abs(modes).max(axis=0, initial=0.0), 1e-30)
        space[:, start[r] : start[r + 1]] = modes / peak
        load[region == r, :, : ranks[r]] = amounts * peak
    return RegionalField(region, start, space, load)
