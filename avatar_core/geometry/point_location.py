"""Location of points in a mesh: their tetrahedron, or the nearest triangle."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import AvatarError
from avatar_core.geometry.mesh import TetMesh

_SLACK = 1e-9  # barycentric coordinates down to minus this count as inside
_FARTHEST_OUTSIDE = 5e-3  # largest distance of a target from the organ [m]


def carriers(mesh: TetMesh, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the vertices of a mesh between which a field is interpolated linearly at points.

    A point in a tetrahedron takes its barycentric coordinates. A point outside takes the
    coordinates of the closest surface point, which has three corners: the last corner has weight
    zero.

    Returns
    -------
    corners : ndarray of int, shape (n, 4)
    weights : ndarray, shape (n, 4)
        Rows sum to one.
    """
    tet, weights = locate(mesh, points)
    corners, outside = mesh.tets[tet].astype(np.int64), np.flatnonzero(tet < 0)
    faces = mesh.boundary_faces
    _, face, on_face = closest_points(mesh.vertices, faces, points[outside])
    corners[outside] = faces[face][:, [0, 1, 2, 0]]
    weights[outside] = np.pad(on_face, ((0, 0), (0, 1)))
    return corners, weights


def target_carriers(
    mesh: TetMesh, point: ArrayLike, refusal: type[AvatarError]
) -> tuple[IntArray, FloatArray]:
    """Return the vertices of a mesh that carry a point of the organ, and their weights, each (4,).

    Raises ``refusal`` if the point is not finite or lies more than 5 mm outside the organ.
    """
    asked = np.asarray(point, float)
    if asked.shape != (3,) or not np.isfinite(asked).all():
        raise refusal(f"the target is {asked.tolist()}; give three finite numbers, in metres")
    corners, weights = carriers(mesh, asked[None])
    off = float(np.linalg.norm(weights[0] @ mesh.vertices[corners[0]] - asked))
    if off > _FARTHEST_OUTSIDE:
        raise refusal(
            f"the target lies {1e3 * off:.0f} mm outside the organ; give a point in it, in metres"
        )
    return corners[0], weights[0]


def locate(mesh: TetMesh, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the tetrahedra that hold points, and barycentric coordinates in them.

    Returns
    -------
    tet : ndarray of int, shape (n,)
        Tetrahedron of each point, -1 outside.
    barycentric : ndarray, shape (n, 4)
        Coordinates, whose rows sum to one; zero outside.
    """
    corners = mesh.vertices[mesh.tets]
    center = corners.mean(axis=1)
    reach = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
    near = cKDTree(points).query_ball_point(center, reach * (1.0 + 1e-9))
    size = np.array([len(hits) for hits in near])
    tet = np.repeat(np.arange(len(near)), size)
    point = np.fromiter((i for hits in near for i in hits), np.int64, size.sum())
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    local = np.linalg.inv(edges)[tet] @ (points[point] - corners[tet, 0])[:, :, None]
    candidate = np.concatenate([1.0 - local.sum(axis=1), local[:, :, 0]], axis=1)
    depth = candidate.min(axis=1)
    order = np.argsort(depth, kind="stable")  # the deepest of several tetrahedra is written last
    order = order[depth[order] >= -_SLACK]
    found, barycentric = np.full(len(points), -1), np.zeros((len(points), 4))
    found[point[order]], barycentric[point[order]] = tet[order], candidate[order]
    return found, barycentric


def closest_points(
    vertices: FloatArray, faces: IntArray, points: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return the closest points of a triangulation.

    Returns
    -------
    nearest : ndarray, shape (n, 3)
        Closest points [m].
    face : ndarray of int, shape (n,)
        Faces of the closest points.
    barycentric : ndarray, shape (n, 3)
        Barycentric coordinates in these faces, rows sum to one.
    """
    faces = faces.astype(np.int64)
    if len(points) == 0:
        return np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros((0, 3))
    _, face, nearest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), vertices, faces
    )
    a, b, c = (np.ascontiguousarray(vertices[faces[face, k]]) for k in range(3))
    barycentric = np.clip(igl.barycentric_coordinates(nearest, a, b, c), 0.0, 1.0)
    return nearest, face, barycentric / barycentric.sum(axis=1, keepdims=True)


def barycentric_centroids(n: int) -> FloatArray:
    """Return barycentric centroids of n^2 equal pieces of a triangle, shape (n^2, 3)."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(n) for j in range(n - 1 - i)]
    second = np.array(up + down) / n
    return np.column_stack([1.0 - second.sum(axis=1), second])
