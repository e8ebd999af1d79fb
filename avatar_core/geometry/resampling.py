"""Resampling of a closed triangulated surface to a wanted number of vertices, for display."""

from __future__ import annotations

import igl
import numpy as np

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import SurfaceError
from avatar_core.geometry.skin import signed_volume, weld

MOST_VERTICES = 1_000_000

_LIMITS = (100, MOST_VERTICES)


def require_displayable(n: int) -> None:
    """Raise SurfaceError unless a surface of n vertices can be displayed."""
    if not _LIMITS[0] <= n <= _LIMITS[1]:
        raise SurfaceError(
            f"{n} displayed vertices; ask for {_LIMITS[0]} to {_LIMITS[1]:,}, e.g. 20000, or "
            "0 for the mesh's own"
        )


def resampled(vertices: FloatArray, faces: IntArray, n: int) -> tuple[FloatArray, IntArray]:
    """Return a surface with about n vertices: subdivided by Loop's scheme, then edges collapsed.

    Loop's limit surface is smooth (Loop, 1987). Edges collapse in the order of the quadric error
    (Garland & Heckbert, 1997). Both shrink a convex surface. Therefore its vertices are then moved
    along their normals by (V_before - V) / A, with volume V and area A. A surface that is no
    manifold has flat triangles split in four instead, and gets n vertices at least.

    Parameters
    ----------
    vertices, faces : ndarray
        Vertices and faces of a closed surface, shapes (m, 3).
    n : int
        Vertices wanted, fewer or more than the surface has.
    """
    vertices, faces = np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int64)
    manifold = is_manifold(faces)
    split = igl.loop if manifold else igl.upsample
    volume = signed_volume(vertices, faces)
    while len(vertices) < n:
        vertices, faces = split(vertices, faces)
    n_faces = len(faces) - 2 * (len(vertices) - n)  # a collapse takes a vertex and two triangles
    if manifold and n_faces < len(faces):
        fortran = np.asfortranarray(vertices), np.asfortranarray(faces, dtype=np.int32)
        vertices, faces, _, _ = igl.qslim(*fortran, n_faces)
    vertices, faces = np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64)
    if manifold:
        lost = volume - signed_volume(vertices, faces)
        area = 0.5 * igl.doublearea(vertices, faces).sum()
        vertices = vertices + lost / area * igl.per_vertex_normals(vertices, faces)
    return vertices, faces


def unified(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Return the triangles with coinciding corners merged."""
    index = weld(vertices)
    _, first = np.unique(index, return_index=True)
    shared = index[faces]
    flat = (shared == np.roll(shared, 1, axis=1)).any(axis=1)
    return vertices[first], shared[~flat]


def is_manifold(faces: IntArray) -> bool:
    """Return whether two triangles meet on every edge, and one fan of triangles at every vertex."""
    faces = np.ascontiguousarray(faces, np.int64)
    closed = len(igl.boundary_facets(faces)[0]) == 0
    return bool(closed and igl.is_edge_manifold(faces)[0] and igl.is_vertex_manifold(faces).all())
