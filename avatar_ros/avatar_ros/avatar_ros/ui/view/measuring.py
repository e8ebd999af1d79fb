"""Lengths, depths and margins on an organ, at rest and deformed: geometry alone."""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np

_PARALLEL = 1e-12
_AROUND = 0.05  # distance from a tool of the faces that its depth is measured from [m]
_EDGE = 1e-9  # barycentric coordinates down to minus this count as inside


class Place(NamedTuple):
    """A point of the tissue's surface, which moves with it.

    corners : ndarray of int, shape (3,), points of the cloud; weights : their weights
    """

    corners: np.ndarray
    weights: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the weighted sum of values at the cloud's points, e.g. of their positions."""
        return np.asarray(self.weights @ np.asarray(points)[self.corners], float)


def hit(
    origin: np.ndarray, direction: np.ndarray, points: np.ndarray, faces: np.ndarray
) -> Place | None:
    """Return where a ray first meets a surface (Moeller and Trumbore, J. Graphics Tools 2, 1997).

    origin, direction : ndarray, shape (3,); points : (n, 3) [m]; faces : (m, 3)
    """
    a, b, c = (points[faces[:, k]].astype(float) for k in range(3))
    one, two = b - a, c - a
    across = np.cross(direction, two)
    volume = (one * across).sum(axis=1)
    scale = 1.0 / np.where(np.abs(volume) > _PARALLEL**2, volume, np.inf)
    way = origin - a
    u = scale * (way * across).sum(axis=1)
    turned = np.cross(way, one)
    v = scale * (turned @ direction)
    t = scale * (two * turned).sum(axis=1)
    inside = (u >= -_EDGE) & (v >= -_EDGE) & (u + v <= 1.0 + _EDGE) & (t > 0.0) & (scale != 0.0)
    if not inside.any():
        return None
    k = int(np.argmin(np.where(inside, t, np.inf)))
    return Place(np.asarray(faces[k], int), np.array([1.0 - u[k] - v[k], u[k], v[k]]))


def is_within(place: Place, direction: np.ndarray, points: np.ndarray) -> bool:
    """Return whether a ray comes from within a closed surface to where it first meets it."""
    a, b, c = points[place.corners]
    return bool(np.cross(b - a, c - a) @ direction > 0.0)


class Gap(NamedTuple):
    """Shortest gap: length [m]; begin, end : its ends, each shape (3,) [m]."""

    length: float
    begin: np.ndarray
    end: np.ndarray


def gap(body: np.ndarray, points: np.ndarray, faces: np.ndarray) -> Gap:
    """Return the shortest gap from points of a tool to a surface.

    body : ndarray, shape (k, 3); points : (n, 3) [m]; faces : (m, 3)
    """
    square, _, closest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(body, float),
        np.ascontiguousarray(points, float),
        np.ascontiguousarray(faces, np.int64),
    )
    k = int(np.argmin(square))
    return Gap(float(np.sqrt(square[k])), body[k], closest[k])


def depth(body: np.ndarray, points: np.ndarray, faces: np.ndarray) -> float:
    """Return the depth of a tool's deepest point below a closed surface [m]; negative: above it.

    It refers to the surface as drawn and exported. The contact surface is smoother: on a coarse
    mesh
    it lies some tenths of a millimetre beside it.

    Far from the surface it is minus infinity: only faces around the tool are used.

    body : ndarray, shape (k, 3); points : (n, 3) [m]; faces : (m, 3)
    """
    middle = body.mean(axis=0)
    reach = float(np.linalg.norm(body - middle, axis=1).max()) + _AROUND
    is_near = np.linalg.norm(points - middle, axis=1) < reach
    near = faces[is_near[faces].any(axis=1)]
    if len(near) == 0:
        return -np.inf
    signed, *_ = igl.signed_distance(
        np.ascontiguousarray(body, float),
        np.ascontiguousarray(points, float),
        np.ascontiguousarray(near, np.int64),
        igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )
    return -float(signed.min())


def margin(plane: np.ndarray, points: np.ndarray) -> float:
    """Return the distance of a plane from a structure [m]; negative: depth of its cut into it.

    plane : ndarray, shape (3, 3), three points; points : (n, 3), of the structure's surface
    """
    normal = normal_of(plane)
    heights = (points - plane[0]) @ normal
    low, high = float(heights.min()), float(heights.max())
    return max(low, -high)


def normal_of(plane: np.ndarray) -> np.ndarray:
    """Return the unit normal of the plane through three points (3, 3)."""
    normal = np.cross(plane[1] - plane[0], plane[2] - plane[0])
    return np.asarray(normal / max(float(np.linalg.norm(normal)), 1e-12))


def is_plane(plane: np.ndarray) -> bool:
    """Return whether three points (3, 3) [m] are far enough from one line."""
    sides = plane[1] - plane[0], plane[2] - plane[0]
    area = float(np.linalg.norm(np.cross(*sides)))
    return area > 1e-2 * max(float(side @ side) for side in sides) > 0.0
