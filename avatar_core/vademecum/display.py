"""Displayed geometry of an organ: a surface finer than the mesh, and structures inside it.

The mesh is as fine as its mechanics need, some millimetres. A display needs the organ as it was
segmented, and its tumour in its place. A vertex x of the surface is attached to the nearest point
of the mesh's boundary, a vertex of a structure to the tetrahedron that holds it, sum_i w_i x_i. It
moves with it,

    u(x) = sum_i w_i u(x_i).

Right under a tip, where the displacement is not linear over a triangle,
:mod:`avatar_core.contact.display` interpolates only smooth fields. Modes are stored at the mesh's
vertices alone. Neither the file nor the time of a step therefore grows with modes times displayed
vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.point_location import carriers, closest_points
from avatar_core.geometry.resampling import is_manifold, resampled, unified
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.reduction.block_field import Blocks, blocks_of

ORGAN = "organ"  # the first part
WALLS = "walls of the cut"  # the last part of an organ that is cut
DISPLAYED = 8000  # vertices: of 24 bytes each, two cores carry a thousand clouds a second
# Vertices of a structure. With the fewest, two triangles of a ball meet at 3 degrees on average and
# look smooth. On a lesion of 20 mm by marching cubes they meet at 15 degrees.
FEWEST_OF_STRUCTURE, MOST_OF_STRUCTURE = 2000, 4000
Triangles = tuple[np.ndarray, np.ndarray]  # vertices (n, 3) [m], faces (m, 3)


@dataclass(frozen=True, eq=False)
class Display:
    """Displayed triangles at rest, part by part, and their attachment to the mesh.

    Attributes
    ----------
    vertices : ndarray of float32, shape (n, 3)
        Vertices at rest [m].
    faces : ndarray of int32, shape (m, 3)
        Corners, counter-clockwise seen from outside.
    corners : ndarray of int32, shape (n, 4)
        Vertices of the mesh that carry each vertex.
    weights : ndarray of float32, shape (n, 4)
        Weights of the corners; they add up to 1.
    first_face : ndarray of int64, shape (n_parts + 1,)
        First face of each part; vertices likewise follow each other.
    names : tuple[str, ...]
        Names of the parts; the first is the organ's surface, the last may be ``WALLS``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    first_face: np.ndarray
    names: tuple[str, ...]

    def faces_of(self, part: int) -> np.ndarray:
        """Return the triangles of a part, over all displayed vertices."""
        return self.faces[self.first_face[part] : self.first_face[part + 1]]


def organ_display(
    mesh: TetMesh, surface: SurfaceMesh | None, n: int, inside: Sequence[SurfaceMesh] = ()
) -> Display | None:
    """Return the displayed triangles of an organ; None if they are the boundary of its mesh alone.

    Parameters
    ----------
    surface : SurfaceMesh or None
        Surface that the mesh was made from; None for the mesh's own boundary, refined.
    n : int
        Approximate number of vertices; 0 for those of the mesh.
    inside : Sequence[SurfaceMesh]
        Structures.
    """
    if n == 0 and not inside:
        return None
    organ = boundary(mesh) if n == 0 else outline(mesh, surface, n)
    return display_of(mesh, organ, [(one.name, structure(one)) for one in inside])


def display_of(
    mesh: TetMesh, organ: Triangles, structures: Sequence[tuple[str, Triangles]] = ()
) -> Display:
    """Return the organ's surface, structures inside and the walls of a cut, tied to a mesh."""
    inside = [triangles for _, triangles in structures]
    tied = [_on_boundary(mesh, organ[0]), *(carriers(mesh, points) for points, _ in inside)]
    names, parts = [ORGAN, *(name for name, _ in structures)], [organ, *inside]
    if mesh.pairs is not None:
        parts[0], tied[0] = _split(mesh, organ, tied[0])
        used, number = np.unique(np.concatenate(mesh.cut_faces), return_inverse=True)
        names.append(WALLS)
        parts.append((mesh.vertices[used], number.reshape(-1, 3)))
        tied.append((np.tile(used[:, None], 4), np.tile([1.0, 0.0, 0.0, 0.0], (len(used), 1))))
    before = np.cumsum([0, *(len(points) for points, _ in parts)])
    faces = [triangles + n for (_, triangles), n in zip(parts, before[:-1], strict=True)]
    weights = np.maximum(np.concatenate([part for _, part in tied]), 0.0)
    return Display(
        np.concatenate([points for points, _ in parts]).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([part for part, _ in tied]).astype(np.int32),
        (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        np.cumsum([0, *(len(part) for part in faces)]),
        tuple(names),
    )


def _on_boundary(mesh: TetMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the result of :func:`carriers` for the nearest points of the boundary."""
    faces = mesh.boundary_faces
    _, face, weights = closest_points(mesh.vertices, faces, np.asarray(points, float))
    return faces[face][:, [0, 1, 2, 0]], np.pad(weights, ((0, 0), (0, 1)))


def _split(
    mesh: TetMesh, organ: Triangles, tied: tuple[np.ndarray, np.ndarray]
) -> tuple[Triangles, tuple[np.ndarray, np.ndarray]]:
    """Part a surface where a cut crosses it: each triangle hangs on the tissue of one side.

    Triangles with corners on both sides are divided at the cut, and the points there are doubled.
    """
    (points, faces), (corners, weights) = organ, tied
    second = mesh.on_second_side
    side = second[corners[:, 0]].astype(int)
    crossed = np.ptp(side[faces], axis=1) > 0
    across = faces[crossed]
    count = side[across].sum(axis=1, keepdims=True)
    alone = np.argmax(side[across] == (count == 1), axis=1)  # the corner that has no other beside
    a, b, c = np.take_along_axis(across, (alone[:, None] + np.arange(3)) % 3, axis=1).T
    edges = np.concatenate([np.stack([a, b], axis=1), np.stack([a, c], axis=1)])
    edges, number = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    nearest, _, _ = closest_points(mesh.vertices, mesh.cut_faces[0], points[edges.ravel()])
    off = np.linalg.norm(points[edges.ravel()] - nearest, axis=1).reshape(-1, 2) + 1e-9
    met = np.einsum("ek,ekd->ed", off[:, ::-1] / off.sum(axis=1, keepdims=True), points[edges])
    own, other = (len(points) + len(met) * k for k in (side[a], 1 - side[a]))
    p, q = number.reshape(2, -1)
    faces = np.concatenate(
        [
            faces[~crossed],
            np.stack([a, p + own, q + own], axis=1),
            np.stack([p + other, b, c], axis=1),
            np.stack([p + other, c, q + other], axis=1),
        ]
    )
    for is_second in (False, True):
        beside = mesh.boundary_faces[second[mesh.boundary_faces[:, 0]] == is_second]
        _, face, on_face = closest_points(mesh.vertices, beside, met)
        corners = np.concatenate([corners, beside[face][:, [0, 1, 2, 0]]])
        weights = np.concatenate([weights, np.pad(on_face, ((0, 0), (0, 1)))])
    return (np.concatenate([points, met, met]), faces), (corners, weights)


def blocks_to_display(mesh: TetMesh, display: Display | None) -> Blocks:
    """Return the vertices of a mesh in blocks; the first blocks hold those of the display."""
    return blocks_of(mesh.vertices, displayed_vertices(mesh, display))


def displayed_vertices(mesh: TetMesh, display: Display | None) -> np.ndarray:
    """Return mesh vertices that are displayed, or that carry displayed ones, shape (n,)."""
    if display is None:
        return mesh.surface_vertices
    return np.union1d(mesh.surface_vertices, display.corners)


def boundary(mesh: TetMesh) -> Triangles:
    """Return the mesh's own surface."""
    index = mesh.surface_vertices
    return mesh.vertices[index], np.searchsorted(index, mesh.boundary_faces)


def outline(mesh: TetMesh, surface: SurfaceMesh | None, n: int) -> Triangles:
    """Return the surface that a mesh was made from, with about n vertices.

    Without a surface, and where triangles of the file cross or do not close, the boundary of the
    mesh is refined instead.
    """
    vertices, faces = boundary(mesh) if surface is None else unified(*surface.skin.boundary)
    if not is_manifold(faces):
        vertices, faces = boundary(mesh)
    return resampled(vertices, faces, n)


def structure(surface: SurfaceMesh) -> Triangles:
    """Return a smooth surface inside an organ, e.g. a tumour's, of the same volume.

    A label map gives a lesion some hundred triangles, whose edges would be visible.
    """
    vertices, faces = unified(*surface.skin.boundary)
    n = min(max(len(vertices), FEWEST_OF_STRUCTURE), MOST_OF_STRUCTURE)
    return resampled(vertices, faces, n)
