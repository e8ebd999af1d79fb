"""The errors of an accuracy curve: the displayed displacement on unseen loads."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, get_args

import numpy as np

from avatar_core.contact.cloud import CloudArrays, cloud_arrays, out_of_blocks, shown_vertices
from avatar_core.fem.norms import l2_norm
from avatar_core.vademecum.accuracy import (
    AccuracyCurve,
    Cloud,
    CurvePoint,
    Detail,
    Precision,
    upper_quantile,
)

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum

MODE_FRACTIONS = (0.04, 0.08, 0.16, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0)  # of the modes at a place
SHOWN: tuple[Cloud, ...] = ("surface", "volume")


def details_of(n_modes: int) -> tuple[Detail, ...]:
    """The details that a curve is measured at: all combinations, and no cloud at all."""
    shown = tuple(
        Detail(modes, cloud, precision)
        for cloud in SHOWN
        for precision in get_args(Precision)
        for modes in mode_levels(n_modes)
    )
    return (*shown, Detail(n_modes, "off"))


def mode_levels(n_modes: int) -> tuple[int, ...]:
    """Numbers of modes at a place, ascending, all at the end."""
    return tuple(sorted({max(1, round(fraction * n_modes)) for fraction in MODE_FRACTIONS}))


class DisplayErrors:
    """Relative errors of the displacement as it would be shown, for every detail."""

    def __init__(self, vademecum: Vademecum) -> None:
        self._vademecum = vademecum
        self._levels = mode_levels(vademecum.n_modes)
        self._shown = [
            (cloud, [self._modes(cloud, precision) for precision in get_args(Precision)])
            for cloud in SHOWN
        ]

    def _modes(self, cloud: Cloud, precision: Precision) -> tuple[np.ndarray, CloudArrays]:
        """The modes in a precision, shape (3 n_points, n), and where each region's begin."""
        arrays = cloud_arrays(self._vademecum, self._vademecum.n_modes, cloud, precision)
        return out_of_blocks(arrays.space, arrays.space_scale, len(arrays.points)), arrays

    def __call__(self, positions: np.ndarray, weights: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """Of one load, shape (n_details, 3): unit forces in x, y, z.

        Parameters
        ----------
        positions, weights : the load; see :meth:`Vademecum.displacement`
        truth : ndarray, shape (3 n_vertices, 3)
        """
        far = self._vademecum.far
        load = np.einsum("i,idk->kd", weights, far.load.reshape(-1, 3, far.rank)[positions])
        load = load.astype(np.float32)
        rows: list[np.ndarray] = []
        for cloud, precisions in self._shown:
            points = shown_vertices(self._vademecum, cloud)
            mass = np.repeat(self._vademecum.mesh.vertex_volumes[points], 3)
            wanted = truth.reshape(-1, 3, 3)[points].reshape(-1, 3)
            size = l2_norm(wanted, mass)
            for space, arrays in precisions:
                left = wanted
                for first, end in pairwise((0, *self._levels)):
                    left = left - space[:, first : min(end, far.rank)] @ load[first:end]
                    left = left - self._regional(space, arrays, positions, weights, first, end)
                    rows.append(l2_norm(left, mass) / size)
        return np.array(rows)

    def _regional(
        self,
        space: np.ndarray,
        arrays: CloudArrays,
        positions: np.ndarray,
        weights: np.ndarray,
        first: int,
        end: int,
    ) -> np.ndarray:
        """The part of regional modes, of the modes from ``first`` to ``end`` at a place."""
        out = np.zeros((len(space), 3), np.float32)
        n_global, region = self._vademecum.far.rank, self._vademecum.regional.region[positions]
        first, end = max(first - n_global, 0), end - n_global
        for r in np.unique(region) if end > 0 else ():
            start, stop = arrays.region_start[r : r + 2]
            some = space[:, min(start + first, stop) : min(start + end, stop)]
            at = region == r
            load = np.tensordot(weights[at], arrays.regional_load[positions[at]], 1)
            out += some @ load[:, first : first + some.shape[1]].T.astype(np.float32)
        return out


def curve_of(vademecum: Vademecum, shown: np.ndarray, force: np.ndarray) -> AccuracyCurve:
    """The curve of measured errors, not yet timed.

    Parameters
    ----------
    shown : ndarray, shape (n_details - 1, 3 n_loads), relative errors of the displacement, the
        directions of a load together
    force : ndarray, shape (m,), of the normal force
    """
    details = details_of(vademecum.n_modes)
    force_error = upper_quantile(force)
    n_loads = shown.shape[1] // 3
    errors = [*(upper_quantile(row, n_independent=n_loads) for row in shown), float("nan")]
    sizes = _sizes(vademecum, details)
    points = (
        CurvePoint(detail, error, force_error, size)
        for detail, error, size in zip(details, errors, sizes, strict=True)
    )
    return AccuracyCurve(tuple(points), shown.shape[1])


def _sizes(vademecum: Vademecum, details: Sequence[Detail]) -> list[int]:
    """Bytes of the modes and their loads that are held for each detail."""
    far, regional = vademecum.far, vademecum.regional
    ranks = np.diff(regional.start)
    out = []
    for detail in details:
        own = np.minimum(ranks, max(detail.modes - far.rank, 0))
        n_modes = min(detail.modes, far.rank) + int(own.sum())
        n_points = len(shown_vertices(vademecum, detail.cloud))
        loads = 4 * 3 * vademecum.surface.n_positions * int(own.max())
        out.append(3 * n_points * n_modes * np.dtype(detail.precision).itemsize + loads)
    return out
