"""Array types, rounding of values, and a choice of well-spread points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
IntArray = NDArray[np.integer]
Soup = tuple[FloatArray, IntArray]  # points and triangles


def short(values: FloatArray) -> NDArray[np.float32]:
    """Return values with 12 significant bits, which compress well.

    Relative error 1.2e-4 at most.
    """
    bits = np.asarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << 11)) & np.uint32(0xFFFFF000)).view(np.float32)


def farthest_points(points: FloatArray, n: int, first: int = 0) -> IntArray:
    """Return points far from one another: each is the farthest from all before it.

    Parameters
    ----------
    points : ndarray, shape (n_points, 3)
        Points [m].
    n : int
        Number of points to choose; all points at most.
    first : int
        Index of the first point.

    Returns
    -------
    ndarray of int, shape (n,)
        Indices, in the order of choice.
    """
    chosen, distance = [first], np.full(len(points), np.inf)
    while len(chosen) < min(n, len(points)):
        from_last = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distance = np.minimum(distance, from_last)
        chosen.append(int(distance.argmax()))
    return np.array(chosen)
