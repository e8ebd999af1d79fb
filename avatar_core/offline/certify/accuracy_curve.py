"""The errors of an accuracy curve: the displayed displacement on unseen loads."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
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

MODE_FRACTIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0)  # of all modes
NEAR = (0.0, 0.5, 1.0)
SHOWN: tuple[Cloud, ...] = ("surface", "volume")


def details_of(rank: int) -> tuple[Detail, ...]:
    """The details that a curve is measured at: all combinations, and no cloud at all."""
    shown = tuple(
        Detail(modes, cloud, precision, near)
        for cloud in SHOWN
        for precision in get_args(Precision)
        for near in NEAR
        for modes in mode_levels(rank)
    )
    return (*shown, Detail(rank, "off"))


def mode_levels(rank: int) -> tuple[int, ...]:
    """Numbers of modes, ascending, all at the end."""
    return tuple(sorted({max(1, round(fraction * rank)) for fraction in MODE_FRACTIONS}))


class DisplayErrors:
    """Relative errors of the displacement as it would be shown, for every detail."""

    def __init__(self, vademecum: Vademecum) -> None:
        self._vademecum = vademecum
        self._levels = mode_levels(vademecum.far.rank)
        self._shown = [
            (cloud, [self._arrays(cloud, precision) for precision in get_args(Precision)])
            for cloud in SHOWN
        ]

    def _arrays(self, cloud: Cloud, precision: Precision) -> tuple[np.ndarray, list[CloudArrays]]:
        """The modes in a precision, and the near fields up to each radius."""
        near = [cloud_arrays(self._vademecum, None, cloud, precision, part) for part in NEAR]
        points = near[0].points
        return out_of_blocks(near[0].space, near[0].space_scale, len(points)), near

    def __call__(self, positions: np.ndarray, weights: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """Of one load, shape (n_details, 3): unit forces in x, y, z.

        Parameters
        ----------
        positions, weights : the load; see :meth:`Vademecum.displacement`
        truth : ndarray, shape (3 n_vertices, 3)
        """
        far = self._vademecum.far
        load = np.einsum("i,idk->kd", weights, far.load.reshape(-1, 3, far.rank)[positions])
        rows: list[np.ndarray] = []
        for cloud, precisions in self._shown:
            points = shown_vertices(self._vademecum, cloud)
            mass = np.repeat(self._vademecum.mesh.vertex_volumes[points], 3)
            wanted = truth.reshape(-1, 3, 3)[points].reshape(-1, 3)
            size = l2_norm(wanted, mass)
            for space, fields in precisions:
                outside = [
                    wanted - arrays.near.combined(positions, weights, len(points))
                    for arrays in fields
                ]
                sums = self._partial_sums(space, load)
                rows += [l2_norm(left - part, mass) / size for left in outside for part in sums]
        return np.array(rows)

    def _partial_sums(self, space: np.ndarray, load: np.ndarray) -> list[np.ndarray]:
        """The far field with the modes of each level."""
        pieces = pairwise((0, *self._levels))
        return list(accumulate(space[:, a:b] @ load[a:b] for a, b in pieces))


def curve_of(vademecum: Vademecum, shown: np.ndarray, force: np.ndarray) -> AccuracyCurve:
    """The curve of measured errors, not yet timed.

    Parameters
    ----------
    shown : ndarray, shape (n_details - 1, 3 n_loads), relative errors of the displacement, the
        directions of a load together
    force : ndarray, shape (m,), of the normal force
    """
    details = details_of(vademecum.far.rank)
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
    """Bytes of modes and near field that a step reads."""
    near: dict[tuple[Cloud, float], int] = {}
    out = []
    for detail in details:
        key = (detail.cloud, detail.near)
        if key not in near:
            near[key] = cloud_arrays(vademecum, 1, detail.cloud, "int8", detail.near).near.nbytes
        n_points = len(shown_vertices(vademecum, detail.cloud))
        out.append(near[key] + 3 * n_points * detail.modes * np.dtype(detail.precision).itemsize)
    return out
