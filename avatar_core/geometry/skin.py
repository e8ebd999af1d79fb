"""Skin of a surface: the triangles that separate inside from outside, and nothing else.

A surface from a file may have holes, overlap itself or exist twice. Its triangles then leave parts
of the solid's boundary open, or lie inside it. Distances are measured to the skin, so that they
vanish where the sign changes and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from avatar_core.common.arrays import FloatArray, IntArray, Soup
from avatar_core.errors import SurfaceError

CRACK = 0.05  # gaps narrower than this are cracks, no holes [mean edges]
OFF = 0.01  # a cover farther than this from the surface does not lie on it [mean edges]
UNDECIDED = (0.25, 0.75)  # winding numbers of a hole's cover, over the layers of the surface
LARGEST_HOLE = 0.1  # [area of all]; a flat cover loses 3 % of a ball's volume there
HALVINGS = 3  # halvings of triangles that an intersection cuts: to an eighth of their size
BESIDE = 1e-4  # offset of the points tested on the two sides of a triangle [edges]


@dataclass(frozen=True, eq=False)
class Skin:
    """Boundary of the solid that a surface encloses.

    Attributes
    ----------
    covered : Soup
        The surface and the cones over its holes; the winding number on it decides what is inside.
    boundary : Soup
        Triangles of ``covered`` with inside on one side and outside on the other.
    holes : ndarray, shape (n_holes, 4)
        Area of each cone over the area of ``covered``, and middle of its rim [m].
    """

    covered: Soup
    boundary: Soup
    holes: FloatArray

    def contains(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return whether points lie inside, |w| > 1/2 whichever way the faces turn, shape (k,)."""
        return _inside(self.covered, points)

    def signed_distance(self, points: FloatArray) -> FloatArray:
        """Return the distance to the boundary, negative inside, shape (k,) [m].

        Distance (AABB tree) and sign (winding number) are computed separately: pseudo-normals and
        rays give wrong signs on cracked surfaces.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        squared = igl.point_mesh_squared_distance(points, *self.boundary)[0]
        return np.where(self.contains(points), -1.0, 1.0) * np.sqrt(squared)


def skin_of(vertices: FloatArray, faces: NDArray[Any], name: str = "surface") -> Skin:
    """Cover the holes, then drop every triangle with the same on both sides.

    Raises SurfaceError if a hole takes more than a tenth of the surface, or if no triangle is left.
    """
    surface = (np.array(vertices), np.array(faces, dtype=np.int64))
    cones = _covers(*surface)
    covered = (np.vstack([surface[0], cones[0]]), np.vstack([surface[1], cones[1]]))
    holes = _holes(covered, len(surface[0]), len(surface[1]))
    _require_small(holes, name)
    boundary = _boundary(covered)
    if len(boundary[1]) == 0:
        raise SurfaceError(
            f"{name}: the surface encloses no volume; "
            "give the whole closed surface with consistently oriented faces"
        )
    return Skin(covered, boundary, holes)


def weld(vertices: FloatArray, tolerance: float = 1e-7) -> IntArray:
    """Return the index of each vertex after merging, shape (n,).

    tolerance : largest distance of merged vertices over the bounding box's diagonal
    """
    cell = tolerance * float(np.linalg.norm(np.ptp(vertices, axis=0))) or 1.0
    key = np.round((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    return np.unique(key, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def directed_edges(triangles: NDArray[Any]) -> IntArray:
    """Return the edges (from, to) of all faces without those of zero length, shape (<= 3 m, 2)."""
    edges = np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return edges[edges[:, 0] != edges[:, 1]].astype(np.int64)


def components(links: IntArray, n: int) -> IntArray:
    """Return the number of the component of each of n vertices, shape (n,)."""
    graph = coo_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int64)


# --- holes ------------------------------------------------------------------------------------


def _covers(vertices: FloatArray, faces: IntArray) -> Soup:
    """Return cones over the rims of all holes: apices, and triangles.

    Triangles number the apices after the vertices. A cone over the unpaired edges of a surface
    makes it a closed chain, whatever its shape. The cone covers a hole if the winding number on it,
    off the surface, is neither that of inside nor of outside. Cracks and flipped faces have
    unpaired edges too and are left alone.
    """
    none = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    edge = float(igl.avg_edge_length(vertices, faces))
    pairs = cKDTree(vertices).query_pairs(CRACK * edge, output_type="ndarray")
    merged = components(pairs, len(vertices))
    rim, layers = _unpaired(merged[faces])
    if len(rim) == 0:
        return none
    place = np.empty((merged.max() + 1, 3))
    vertex = np.empty(len(place), dtype=np.int64)
    place[merged], vertex[merged] = vertices, np.arange(len(vertices))
    label = np.unique(components(rim, len(place))[rim[:, 0]], return_inverse=True)[1].reshape(-1)
    count = np.bincount(label)
    middles = place[rim].mean(axis=1)
    apices = np.stack([np.bincount(label, middles[:, k]) / count for k in range(3)], axis=1)
    points = (middles + 2 * apices[label]) / 3  # points of each triangle, away from the rim
    squared = igl.point_mesh_squared_distance(points, vertices, faces)[0]
    winding = np.abs(igl.fast_winding_number(vertices, faces, points)) / layers
    open_there = (winding > UNDECIDED[0]) & (winding < UNDECIDED[1])
    is_hole = np.bincount(label, open_there & (squared > (OFF * edge) ** 2)) > 0
    chosen = np.repeat(np.flatnonzero(is_hole[label]), layers[is_hole[label]])
    corners = vertex[rim[chosen]]
    return apices, np.column_stack([corners[:, ::-1], len(vertices) + label[chosen]])


def _holes(covered: Soup, n_vertices: int, n_faces: int) -> FloatArray:
    """Return the part of the area and the apex of each cone, after that many vertices and faces."""
    areas, apices = igl.doublearea(*covered) / 2, covered[0][n_vertices:]
    cone = covered[1][n_faces:, 2] - n_vertices
    own = np.bincount(cone, areas[n_faces:], minlength=len(apices)) / areas.sum()
    return np.column_stack([own, apices])[own > 0.0]


def _require_small(holes: FloatArray, name: str) -> None:
    """Raise SurfaceError if a cone covers too much."""
    fraction = holes[:, 0].max(initial=0.0)
    if fraction > LARGEST_HOLE:
        raise SurfaceError(
            f"{name}: the surface is open (a hole takes {fraction:.0%} of it); "
            "close it or segment the whole organ"
        )


def _unpaired(triangles: IntArray) -> tuple[IntArray, IntArray]:
    """Return directed edges that more faces run along one way than the other, and how many more."""
    directed = directed_edges(triangles)
    forth = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    edges, number = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    excess = np.bincount(number.reshape(-1), forth, minlength=len(edges)).astype(np.int64)
    edges[excess < 0] = edges[excess < 0][:, ::-1]
    return edges[excess != 0], np.abs(excess[excess != 0])


# --- what lies inside -------------------------------------------------------------------------


def _boundary(soup: Soup) -> Soup:
    """Return triangles with inside on one side only, resolved to an eighth of an edge at cuts.

    Triangles at an intersection are quartered and tested again. The smallest triangles on either
    side of an intersection are kept. The skin then has no gaps, which a narrow band would jump
    through.
    """
    merged, vertices = weld(soup[0]), soup[0]
    representative = np.empty(len(vertices), dtype=np.int64)
    representative[merged] = np.arange(len(vertices))
    faces: IntArray = representative[merged[soup[1]]]
    kept: list[FloatArray] = []
    for halving in range(HALVINGS + 1):
        separates = _separates(soup, vertices[faces])
        used = np.zeros((2, len(vertices)), dtype=bool)
        for side in (0, 1):
            used[side, faces[separates == bool(side)]] = True
        cut = np.logical_and(*used)[faces].any(axis=1)
        done = separates & ~cut if halving < HALVINGS else separates | cut
        kept.append(vertices[faces[done]])
        if halving == HALVINGS or not cut.any():
            break
        vertices, faces = _quartered(vertices, faces[cut])
    corners = np.concatenate(kept).reshape(-1, 3)
    return corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3)


def _quartered(vertices: FloatArray, faces: IntArray) -> Soup:
    """Return every triangle split at the middles of its edges, which are shared by neighbors.

    Own code because igl.upsample aborts the process where many faces meet at one edge.
    """
    sides = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    edges, number = np.unique(sides, axis=0, return_inverse=True)
    a, b, c = faces.T
    u, v, w = len(vertices) + number.reshape(-1, 3).T  # opposite to a, b, c
    quarters = np.concatenate([np.column_stack(t) for t in ((a, w, v), (w, b, u), (v, u, c))])
    return (
        np.vstack([vertices, vertices[edges].mean(axis=1)]),
        np.vstack([quarters, np.column_stack([u, v, w])]),
    )


def _separates(soup: Soup, corners: FloatArray) -> NDArray[np.bool_]:
    """Return whether each triangle's middle has inside on one side and outside on the other."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    step = BESIDE * normal / np.sqrt(np.where(length > 0, length, 1.0))  # |normal| ~ edge^2
    middle = corners.mean(axis=1)
    return np.not_equal(_inside(soup, middle + step), _inside(soup, middle - step))


def _inside(soup: Soup, points: FloatArray) -> NDArray[np.bool_]:
    points = np.ascontiguousarray(points, dtype=np.float64)
    return np.greater(np.abs(igl.fast_winding_number(*soup, points)), 0.5)


def signed_volume(vertices: FloatArray, faces: NDArray[Any]) -> float:
    """Return V = 1/6 sum a . (b x c) about the mean vertex, in the vertices' unit cubed."""
    corners = vertices[faces] - vertices[faces].mean(axis=(0, 1))
    return float(np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) / 6)
