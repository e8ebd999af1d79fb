"""Types of arrays, and points that are chosen from many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
IntArray = NDArray[np.integer]
Soup = tuple[FloatArray, IntArray]  # points and triangles


def short(values: FloatArray) -> NDArray[np.float32]:
    """Return the values of 12 significant bits, which compress: off by 1.2e-4 of each at most."""
    bits = np.asarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << 11)) & np.uint32(0xFFFFF000)).view(np.float32)


def farthest_points(points: FloatArray, n: int, first: int = 0) -> IntArray:
    """Some points far from one another: each the farthest from all before it.

    Parameters
    ----------
    points : ndarray, shape (n_points, 3)
        Points [m].
    n : int
        How many, all of them at most.
    first : int
        The one to begin with.

    Returns
    -------
    ndarray of int, shape (n,), in the order in which they are chosen
    """
    chosen, distance = [first], np.full(len(points), np.inf)
    while len(chosen) < min(n, len(points)):
        from_last = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distance = np.minimum(distance, from_last)
        chosen.append(int(distance.argmax()))
    return np.array(chosen)
