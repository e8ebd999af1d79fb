"""A fine surface that is displayed in the place of the mesh's own, moved by interpolation.

The mesh is as fine as its mechanics need, some millimetres; eyes want the organ as it was
segmented. A vertex x of the displayed surface is tied to the nearest point of the mesh's boundary,
sum_i w_i x_i in the triangle of the vertices i, and moves with it,

    u(x) = sum_i w_i u(x_i).

Right under a tip, where the displacement is not linear over a triangle,
:mod:`avatar_core.contact.display` interpolates only what is smooth. Modes are held at the mesh's
vertices alone, so that neither the file nor the time of a step grows with modes times displayed
vertices.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.resampling import is_manifold, resampled, unified
from avatar_core.geometry.surface import SurfaceMesh


@dataclass(frozen=True, eq=False)
class DisplaySurface:
    """The displayed surface at rest, and how it hangs on the mesh.

    vertices : ndarray, shape (n, 3) float32 [m]
    faces : ndarray of int32, shape (m, 3), counter-clockwise seen from outside
    corners : ndarray of int32, shape (n, 3), vertices of the mesh that carry each vertex
    weights : ndarray, shape (n, 3) float32, of the corners; they add up to 1
    """

    vertices: np.ndarray
    faces: np.ndarray
    corners: np.ndarray
    weights: np.ndarray


def display_surface(mesh: TetMesh, surface: SurfaceMesh, n: int) -> DisplaySurface:
    """The surface that a mesh was made of, with about n vertices, tied to the mesh.

    Where triangles of the file cross or do not close, the boundary of the mesh is refined instead.

    Parameters
    ----------
    n : wanted vertices
    """
    outline = unified(*surface.skin.boundary)
    if not is_manifold(outline[1]):
        index = mesh.surface_vertices
        outline = mesh.vertices[index], np.searchsorted(index, mesh.boundary_faces)
    return tied(mesh, *resampled(*outline, n))


def tied(mesh: TetMesh, vertices: np.ndarray, faces: np.ndarray) -> DisplaySurface:
    """A surface tied to the nearest points of a mesh's boundary."""
    triangles = np.ascontiguousarray(mesh.boundary_faces, np.int64)
    points = np.ascontiguousarray(mesh.vertices, float)
    _, face, nearest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(vertices, float), points, triangles
    )
    corners = triangles[face]
    weights = igl.barycentric_coordinates(nearest, *(points[corners[:, i]] for i in range(3)))
    weights = np.clip(weights, 0.0, 1.0)
    return DisplaySurface(
        np.asarray(vertices, np.float32),
        np.asarray(faces, np.int32),
        corners.astype(np.int32),
        (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
    )
