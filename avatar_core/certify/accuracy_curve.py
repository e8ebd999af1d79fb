"""The errors of an accuracy curve: the displayed displacement on unseen loads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.contact.cloud import BLOCK, CloudArrays, cloud_arrays, rounded
from avatar_core.contact.cloud_kernels import add_to_field, soft_threshold
from avatar_core.fem.norms import l2_norm
from avatar_core.vademecum.accuracy import (
    AccuracyCurve,
    Cloud,
    CurvePoint,
    Detail,
    mode_levels,
    upper_quantile,
)

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum

SHOWN: tuple[Cloud, ...] = ("surface", "volume")


def details_of(n_modes: int) -> tuple[Detail, ...]:
    """The details that a curve is measured at: all combinations, and no cloud at all."""
    shown = tuple(Detail(modes, cloud) for cloud in SHOWN for modes in mode_levels(n_modes))
    return (*shown, Detail(n_modes, "off"))


class DisplayErrors:
    """Relative errors of the displacement as it would be shown, for every detail.

    sizes : bytes that are held to show each
    """

    def __init__(self, vademecum: Vademecum) -> None:
        self._vademecum = vademecum
        self._levels = mode_levels(vademecum.n_modes)
        self._shown = [rounded(cloud_arrays(vademecum, cloud)) for cloud in SHOWN]
        self.sizes = [_size(arrays, n) for arrays in self._shown for n in self._levels] + [0]

    def __call__(self, positions: np.ndarray, weights: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """Of one load, shape (n_details, 3): unit forces in x, y, z.

        Parameters
        ----------
        positions, weights : the load; see :meth:`Vademecum.displacement`
        truth : ndarray, shape (3 n_vertices, 3)
        """
        rows: list[np.ndarray] = []
        for arrays in self._shown:
            mass = np.repeat(self._vademecum.mesh.vertex_volumes[arrays.points], 3)
            wanted = truth.reshape(-1, 3, 3)[arrays.points].reshape(-1, 3)
            size = l2_norm(wanted, mass)
            for level in self._levels:
                left = wanted - self._field(arrays, positions, weights, level)
                rows.append(l2_norm(left, mass) / size)
        return np.array(rows)

    def _field(
        self, arrays: CloudArrays, positions: np.ndarray, weights: np.ndarray, level: int
    ) -> np.ndarray:
        """What a step shows under unit forces in x, y, z, shape (3 n_points, 3)."""
        field = np.zeros((3, (arrays.block_start.shape[1] - 1) * BLOCK), np.float32)
        region = self._vademecum.regional.region[positions]
        whole = np.bincount(region, weights, arrays.region_start.size - 1)
        kept = np.array([soft_threshold(w) for w in whole])
        part = kept / kept.sum() / np.where(whole == 0.0, 1.0, whole)
        for r in np.flatnonzero(kept):
            n, at = np.diff(arrays.region_start[r : r + 2])[0], region == r
            load = np.tensordot(part[r] * weights[at], arrays.regional_load[positions[at]], 1)
            for u, amplitude in zip(field, load[:, :n].astype(np.float32), strict=True):
                modes = (arrays.space, arrays.core, arrays.level, arrays.block_start[1 + r])
                add_to_field(*modes, amplitude, level, u)
        return field[:, : 3 * len(arrays.points)].T


def _size(arrays: CloudArrays, level: int) -> int:
    """Bytes of the modes up to a level, of their core and of the loads."""
    share = float(np.mean(arrays.level <= level)) if len(arrays.level) else 0.0
    modes = arrays.space.nbytes + arrays.core.nbytes + arrays.level.nbytes
    return round(share * modes) + arrays.regional_load.nbytes


def curve_of(
    vademecum: Vademecum, shown: np.ndarray, force: np.ndarray, sizes: Sequence[int]
) -> AccuracyCurve:
    """The curve of measured errors, not yet timed.

    Parameters
    ----------
    shown : ndarray, shape (n_details - 1, 3 n_loads), relative errors of the displacement, the
        directions of a load together
    force : ndarray, shape (m,), of the normal force
    sizes : of each detail [bytes]
    """
    details = details_of(vademecum.n_modes)
    force_error = upper_quantile(force)
    n_loads = shown.shape[1] // 3
    errors = [*(upper_quantile(row, n_independent=n_loads) for row in shown), float("nan")]
    points = (
        CurvePoint(detail, error, force_error, size)
        for detail, error, size in zip(details, errors, sizes, strict=True)
    )
    return AccuracyCurve(tuple(points), shown.shape[1])
