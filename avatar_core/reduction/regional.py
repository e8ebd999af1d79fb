"""Fields over the load surface, separated region by region.

    u(x, s_j) ~ sum_m Z_m(x) W_m(s_j),    m over the modes of the region that holds s_j.

Loads near one another move an organ alike. Some dozen modes for each of some dozen regions leave a
smaller error than hundreds of modes for all loads at once. A step reads only the modes of the tip's
region. Each load position belongs to one region. Between positions the response is interpolated. It
is therefore as smooth where a tip crosses between regions as within one.
:mod:`avatar_core.reduction.block_field` separates these modes once more, in space.

The modes of a region are the principal components of its columns (Eckart & Young, Psychometrika 1,
1936). Each column is divided by its own size, so that the relative error is the least for that
number of modes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.cluster.vq import kmeans2

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.common.processes import on_all_cores

_ITERATIONS = 30  # iterations of k-means


class RegionModes(NamedTuple):
    """The modes of one region of the load surface.

    Attributes
    ----------
    space : ndarray, shape (3 n_vertices, n)
        Z, each with a peak of 1.
    load : ndarray, shape (n positions of the region, n_loads, n)
        W.

    Examples
    --------
    >>> region = av.mor.regions_of(np.arange(12.0)[:, None] * np.eye(3)[0], 2)
    >>> modes, _ = av.mor.separate_regions(region, F[:, :, None], av.mor.RegionalRule(0.0, 0.0, 3))
    >>> [one.space.shape[1] for one in modes]
    [3, 3]
    """

    space: FloatArray
    load: FloatArray


@dataclass(frozen=True)
class RegionalRule:
    """Accuracy and size of a region's modes.

    Attributes
    ----------
    tolerance : float
        Mean relative L2 error over the region's loads.
    worst : float
        Relative L2 error of the region's worst load.
    most : int
        Largest number of modes of a region.

    Examples
    --------
    >>> av.mor.RegionalRule(tolerance=0.01, worst=0.05, most=20).most
    20
    """

    tolerance: float
    worst: float
    most: int


def regions_of(centers: FloatArray, n_regions: int) -> IntArray:
    """Return compact regions of load positions, by k-means, shape (n_positions,) int32.

    Examples
    --------
    >>> av.mor.regions_of(v.surface.centers, 4).max()
    3
    """
    n_regions = max(1, min(n_regions, len(centers)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a region may come out empty: it is dropped
        _, label = kmeans2(centers, n_regions, iter=_ITERATIONS, minit="++", rng=0)
    return np.unique(label, return_inverse=True)[1].astype(np.int32)


def separate_regions(
    region: IntArray,
    columns: FloatArray | Callable[[IntArray], FloatArray],
    rule: RegionalRule,
    size: FloatArray | None = None,
    mass: FloatArray | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[list[RegionModes], FloatArray]:
    """Return the modes of every region.

    Parameters
    ----------
    region : ndarray of int32, shape (n_positions,)
        Region of each load position, as of :func:`regions_of`.
    columns : ndarray, shape (n_dofs, n_positions, n_loads), or callable
        Displacement under each load. A callable gives the columns of some positions, for those
        that do not fit into memory at once.
    rule : RegionalRule
        Tolerance, and modes of a region at most.
    size : ndarray, shape (n_positions, n_loads), optional
        L2 norm by which an error is relative. The default is the norm of each column.
    mass : ndarray, shape (n_dofs,), optional
        Lumped mass of that norm. The default is 1.
    progress : callable
        Called with the finished fraction.

    Returns
    -------
    modes : list[RegionModes]
        Modes of each region.
    errors : ndarray, shape (most + 1, n_positions, n_loads)
        Relative L2 error of each load by number of its region's modes; constant beyond the modes
        kept.

    Examples
    --------
    >>> region = av.mor.regions_of(np.arange(12.0)[:, None] * np.eye(3)[0], 2)
    >>> rule = av.mor.RegionalRule(tolerance=0.0, worst=0.0, most=3)
    >>> modes, errors = av.mor.separate_regions(region, F[:, :, None], rule)
    >>> errors.shape, errors[3].max() < errors[1].max()
    ((4, 12, 1), True)
    """
    parts = []
    at: Callable[[IntArray], FloatArray] = (
        columns if callable(columns) else lambda here: np.asarray(columns)[:, here]
    )
    if mass is None:
        mass = np.ones(len(at(np.zeros(1, np.int64))))
    root = np.sqrt(mass).astype(np.float32)[:, None]
    if size is None:
        size = np.stack(
            [np.linalg.norm(root * at(np.array([j]))[:, 0], axis=0) for j in range(len(region))]
        )
        size = np.maximum(size, 1e-300)
    errors = np.empty((rule.most + 1, *size.shape))
    n_regions = int(region.max()) + 1

    def separate(r: int) -> RegionModes:
        here = np.flatnonzero(region == r)
        scaled = at(here).reshape(len(mass), -1) * (root / size[here].ravel())
        modes, load, left = _principal(scaled.astype(np.float32), rule)
        errors[:, here] = left.reshape(-1, *size[here].shape)
        return _with_peaks_of_one(modes / root, load, size[here])

    for part in on_all_cores(separate, range(n_regions)):
        parts.append(part)
        progress(len(parts) / n_regions)
    return parts, errors


def _principal(
    columns: FloatArray, rule: RegionalRule
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return modes (n_dofs, k), their amounts in each column (n, k), and errors (most + 1, n)."""
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


def _with_peaks_of_one(modes: FloatArray, amounts: FloatArray, size: FloatArray) -> RegionModes:
    """Return the region's modes from modes (n_dofs, k) and their amounts (n, k) in scaled columns.

    size : size by which each column was divided
    """
    peak = np.maximum(np.abs(modes).max(axis=0, initial=0.0), 1e-30)
    load = amounts.reshape(*size.shape, -1) * size[..., None] * peak
    return RegionModes(modes / peak, load.astype(np.float32))
