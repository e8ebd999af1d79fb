"""Triangles cut along the level lines of a field."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Banded(NamedTuple):
    """Triangles that no line crosses.

    points : ndarray, shape (n', d), the given ones first
    faces : ndarray of int, shape (m', 3); band : (m',), number of each face's band, from 0
    parent : (m',), the given face that each is a part of
    """

    points: np.ndarray
    faces: np.ndarray
    band: np.ndarray
    parent: np.ndarray


def cut(
    points: np.ndarray, values: np.ndarray, faces: np.ndarray, step: float, n_bands: int
) -> Banded:
    """Cut a surface along the values ``step``, 2 ``step``, ..., (n_bands - 1) ``step``.

    The field is linear on each triangle; its part between two levels is a polygon of at most five
    corners. Two lie on the side from the lowest corner to the highest, and two on the way over the
    middle corner. The fifth is the middle corner, if it lies between the levels.

    Parameters
    ----------
    points : ndarray, shape (n, d); values : ndarray, shape (n,); faces : ndarray, shape (m, 3)
    step : between two values; n_bands : number of bands, the last without an end
    """
    values = np.clip(values / step, 0.0, float(n_bands))
    of_corner = values[faces]
    band = np.minimum(of_corner, n_bands - 1.0).astype(int)
    low, high = band.min(axis=1), band.max(axis=1)
    whole, crossed = np.flatnonzero(low == high), np.flatnonzero(low < high)
    order = np.argsort(of_corner[crossed], axis=1)
    corner = np.take_along_axis(faces[crossed], order, axis=1)
    is_even = (order[:, 1] - order[:, 0]) % 3 == 1
    count = high[crossed] - low[crossed] + 1
    face = np.repeat(np.arange(len(crossed)), count)
    first = np.cumsum(count) - count
    piece_band = low[crossed][face] + np.arange(len(face)) - first[face]
    pieces, kept = _pieces(points, values, corner[face], piece_band, n_bands)
    n = len(face)
    pieces = pieces.reshape(5 * n, points.shape[1])
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    new = len(points) + 5 * np.arange(n)[:, None, None] + fan
    turned = is_even[face]  # the fan goes from the lowest corner to the highest, and back
    new[turned] = new[turned][:, :, ::-1]
    return Banded(
        np.concatenate([points, pieces]),
        np.concatenate([faces[whole], new[kept]]),
        np.concatenate([low[whole], np.repeat(piece_band, 3).reshape(n, 3)[kept]]),
        np.concatenate([whole, np.repeat(crossed[face], 3).reshape(n, 3)[kept]]),
    )


def _pieces(
    points: np.ndarray, values: np.ndarray, corner: np.ndarray, band: np.ndarray, n_bands: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return corners of the polygons, shape (n, 5, d), and which triangles of their fans exist.

    corner : ndarray, shape (n, 3), corners of the parent triangle, ascending by value
    """
    v, x = values[corner], points[corner]
    begin = np.maximum(band, v[:, 0])
    end = np.where(band == n_bands - 1, v[:, 2], np.minimum(band + 1.0, v[:, 2]))

    def on_side(i: int, k: int, level: np.ndarray) -> np.ndarray:
        length = v[:, k] - v[:, i]  # may be as small as rounding, and still counts
        part = (level - v[:, i]) / np.where(length > 0.0, length, np.inf)
        return np.asarray(x[:, i] + np.clip(part, 0.0, 1.0)[:, None] * (x[:, k] - x[:, i]))

    def over_middle(level: np.ndarray) -> np.ndarray:
        before = (level < v[:, 1])[:, None]
        return np.where(before, on_side(0, 1, level), on_side(1, 2, level))

    has_middle = (begin < v[:, 1]) & (v[:, 1] < end)
    last = over_middle(begin)
    middle = np.where(has_middle[:, None], x[:, 1], last)
    polygon = np.stack(
        [on_side(0, 2, begin), on_side(0, 2, end), over_middle(end), middle, last], axis=1
    )
    to_top = (end >= v[:, 2]) & (v[:, 1] < v[:, 2])
    from_bottom = (begin <= v[:, 0]) & (v[:, 0] < v[:, 1])
    kept = [~to_top, ~(from_bottom & (end <= v[:, 1])), has_middle & ~from_bottom]
    return polygon, np.column_stack(kept) & (end > begin)[:, None]
