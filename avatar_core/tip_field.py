"""The geometry that a tool tip feels: a smooth distance to the organ, and where it may touch.

phi(p) is the signed distance from p to the closest point of the organ's faces (negative inside),
chi(p) is one where that point is accessible and fades to zero beyond. Both are sampled on a grid
and evaluated with cubic B-splines whose coefficients are the samples (a quasi-interpolant): twice
continuously differentiable, local, exact for planes; it rounds edges over about the spacing.
"""

from __future__ import annotations

from collections import namedtuple

import igl
import numpy as np
from numba import njit

from avatar_core.mesh import Regions, TetMesh

SPACING = 3e-3  # [m]
MARGIN = 30e-3  # [m] around the accessible surface
FAR = 10.0  # [m] value outside the grid

# distance, access (nx, ny, nz) float32; origin (3,) [m]; spacing (1,) [m]
TipField = namedtuple("TipField", ["distance", "access", "origin", "spacing"])


def make_tip_field(
    mesh: TetMesh, regions: Regions, fade: float, spacing: float = SPACING
) -> TipField:
    """Sample phi and chi around the accessible surface.

    Inside the organ, the distance is taken to the accessible faces and those within ``fade`` of
    them, so that a push into a thin lobe does not come out at its back.

    Parameters
    ----------
    mesh, regions : the organ
    fade : distance beyond the accessible surface over which access fades [m]
    spacing : of the grid [m]
    """
    faces = mesh.boundary_faces
    open_faces = faces[regions.accessible]
    corners = mesh.vertices[open_faces].reshape(-1, 3)
    origin = corners.min(axis=0) - MARGIN
    shape = np.ceil((np.ptp(corners, axis=0) + 2 * MARGIN) / spacing).astype(int) + 1
    axes = [origin[d] + spacing * np.arange(shape[d]) for d in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = igl.fast_winding_number(mesh.vertices, faces, points) > 0.5
    center = mesh.vertices[faces].mean(axis=1)
    near = _closest(mesh, open_faces, center)[0] < fade
    distance, closest = _closest(mesh, faces, points)
    distance[inside], closest[inside] = _closest(
        mesh, faces[near | regions.accessible], points[inside]
    )
    distance[inside] *= -1.0
    beyond = np.clip(_closest(mesh, open_faces, closest)[0] / fade, 0.0, 1.0)
    access = 1.0 - beyond**2 * (3.0 - 2.0 * beyond)
    return TipField(
        distance.reshape(shape).astype(np.float32),
        access.reshape(shape).astype(np.float32),
        origin,
        np.array([spacing]),
    )


def _closest(mesh: TetMesh, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance to some faces and the closest points on them."""
    squared, _, closest = igl.point_mesh_squared_distance(points, mesh.vertices, faces)
    return np.sqrt(squared), closest


@njit(cache=True)
def _bspline(t):  # type: ignore[no-untyped-def]
    """The four uniform cubic B-spline weights at t in [0, 1)."""
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    )


@njit(cache=True)
def _bspline_slope(t):  # type: ignore[no-untyped-def]
    """Their derivatives."""
    s = 1.0 - t
    return (-0.5 * s * s, -2.0 * t + 1.5 * t * t, 2.0 * s - 1.5 * s * s, 0.5 * t * t)


@njit(cache=True)
def evaluate(values, origin, spacing, p, gradient, outside):  # type: ignore[no-untyped-def]
    """Value of a sampled field at p, its gradient into ``gradient``; ``outside`` off the grid."""
    x = (p[0] - origin[0]) / spacing
    y = (p[1] - origin[1]) / spacing
    z = (p[2] - origin[2]) / spacing
    cx, cy, cz = np.floor(x), np.floor(y), np.floor(z)
    if not (
        cx >= 1.0
        and cx < values.shape[0] - 2.0
        and cy >= 1.0
        and cy < values.shape[1] - 2.0
        and cz >= 1.0
        and cz < values.shape[2] - 2.0
    ):
        gradient[0] = gradient[1] = gradient[2] = 0.0
        return outside
    wx, wy, wz = _bspline(x - cx), _bspline(y - cy), _bspline(z - cz)
    dx, dy, dz = _bspline_slope(x - cx), _bspline_slope(y - cy), _bspline_slope(z - cz)
    nx, ny, nz = int(cx) - 1, int(cy) - 1, int(cz) - 1
    value = g0 = g1 = g2 = 0.0
    for i in range(4):
        for j in range(4):
            line = slope = 0.0
            for k in range(4):
                v = values[nx + i, ny + j, nz + k]
                line += wz[k] * v
                slope += dz[k] * v
            value += wx[i] * wy[j] * line
            g0 += dx[i] * wy[j] * line
            g1 += wx[i] * dy[j] * line
            g2 += wx[i] * wy[j] * slope
    gradient[0], gradient[1], gradient[2] = g0 / spacing, g1 / spacing, g2 / spacing
    return value
