"""Shape functions and quadrature of triangles, the faces of the elements."""

from __future__ import annotations

import numpy as np
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTri


def triangle_shape(barycentric: np.ndarray) -> np.ndarray:
    """Return the shape functions of the six-node triangle, the trace of a P2 element.

    barycentric : ndarray, shape (..., 3), coordinates (l0, l1, l2) that sum to one

    Returns
    -------
    ndarray, shape (..., 6)
        l(2l - 1) at the corners, 4 l l' at edges 01, 12, 20.
    """
    corner = barycentric * (2.0 * barycentric - 1.0)
    return np.concatenate([corner, 4.0 * barycentric * np.roll(barycentric, -1, axis=-1)], axis=-1)


def subdivided_rule(pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a rule of degree 5 on each of pieces^2 equal sub-triangles; weights sum to one."""
    local, weight = get_quadrature(RefTri, 5)
    bary = np.stack([1.0 - local[0] - local[1], local[0], local[1]], axis=1)
    corners = []
    for i in range(pieces):
        for j in range(pieces - i):
            corners.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < pieces - 1:
                corners.append([(i + 1, j + 1), (i, j + 1), (i + 1, j)])
    tri = np.array(corners, float) / pieces
    tri = np.concatenate([1.0 - tri.sum(axis=2, keepdims=True), tri], axis=2)
    points = np.einsum("qk,tkd->tqd", bary, tri).reshape(-1, 3)
    return points, np.tile(weight / weight.sum() / len(tri), len(tri))
