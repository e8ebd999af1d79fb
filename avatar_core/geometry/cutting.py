"""An organ's mesh, cut along a surface into two sides whose faces lie on one another.

The nearer end of every edge that crosses the surface is moved onto it, if the elements around stay
good. Vertices of the organ's boundary move along the boundary. An element then belongs to the side
on which most of it lies. Vertices between the sides are moved on as far as they can, and are
doubled: the first side keeps their numbers.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import MeshError
from avatar_core.geometry.cut_surface import CutSurface
from avatar_core.geometry.mesh import TetMesh, components

_LEAST_PART = 0.01  # of the organ's volume; less is no part but a rim that the surface grazes
_WAYS = (1.0, 0.5, 0.25)  # of a vertex to the surface, that are tried
_SWEEPS = 3
_LEAST_SHAPE = 0.25  # least shape of an element over its original one; below, its vertices stay
_STEEP = 0.5  # sine between normal of the organ and of the cut, below which a vertex stays


def snapped(mesh: TetMesh, surface: CutSurface) -> tuple[TetMesh, np.ndarray]:
    """Move the vertices between both sides onto the surface; return the mesh and its sides.

    Returns
    -------
    mesh : TetMesh
    second : ndarray of bool, shape (n_tets,)
        Elements on the side of the surface's normal.

    Raises
    ------
    MeshError
        For a surface that misses the organ.
    """
    moving = _Moving(mesh, surface)
    height = surface.heights(mesh.vertices)
    nearer = _nearer_ends(mesh, height)
    moving.move(nearer[np.argsort(np.abs(height[nearer]), kind="stable")], _WAYS[:1])
    height = surface.heights(moving.points)
    second = _without_islands(mesh, height[mesh.tets].sum(axis=1) > 0.0)
    volumes = [float(mesh.tet_volumes[side].sum()) for side in (~second, second)]
    if min(volumes) < _LEAST_PART * mesh.volume:
        raise MeshError(
            f"the resection cuts off {1e6 * min(volumes):.1f} ml of {1e6 * mesh.volume:.0f} ml; "
            "give a surface in metres through the organ, whose centroid is at "
            f"{_text(mesh.centroid)} m (RAS)"
        )
    between = np.intersect1d(mesh.tets[second], mesh.tets[~second])
    for _ in range(_SWEEPS):
        moving.move(between, _WAYS)
    return TetMesh(moving.points, mesh.tets), second


def cut(mesh: TetMesh, second: np.ndarray) -> TetMesh:
    """Return the mesh with doubled vertices between its sides.

    second : ndarray of bool, shape (n_tets,), see :func:`snapped`
    """
    between = np.intersect1d(mesh.tets[second], mesh.tets[~second])
    number = np.arange(len(mesh.vertices))
    number[between] = len(number) + np.arange(len(between))
    tets = mesh.tets.copy()
    tets[second] = number[tets[second]]
    pairs = np.stack([between, number[between]], axis=1)
    return TetMesh(np.concatenate([mesh.vertices, mesh.vertices[between]]), tets, pairs)


def _nearer_ends(mesh: TetMesh, height: FloatArray) -> np.ndarray:
    """Return the nearer end of each edge that crosses the surface."""
    first, second = np.triu_indices(4, 1)
    ends = mesh.tets[:, np.stack([first, second], axis=1)].reshape(-1, 2)
    ends = ends[height[ends[:, 0]] * height[ends[:, 1]] < 0.0]
    nearer = np.abs(height[ends]).argmin(axis=1)
    return np.unique(ends[np.arange(len(ends)), nearer])


class _Moving:
    """Vertices of a mesh that move onto a surface, one after the other.

    points : ndarray, shape (n_vertices, 3), their present places [m]
    """

    def __init__(self, mesh: TetMesh, surface: CutSurface) -> None:
        self._mesh, self._surface = mesh, surface
        self.points = mesh.vertices.copy()
        self._least = _LEAST_SHAPE * _shapes(mesh.vertices, mesh.tets)
        around = np.argsort(mesh.tets.ravel(), kind="stable")
        self._start = np.searchsorted(mesh.tets.ravel()[around], np.arange(len(self.points) + 1))
        self._tets = around // 4

    def move(self, vertices: np.ndarray, ways: tuple[float, ...]) -> None:
        """Move each vertex by the first fraction of its way that keeps its elements good."""
        offset = self._surface.offsets(self.points[vertices])
        offset = _along_boundary(offset, self._mesh.vertex_normals[vertices])
        for vertex, way in zip(vertices, offset, strict=True):
            own = self._tets[self._start[vertex] : self._start[vertex + 1]]
            before = self.points[vertex].copy()
            for part in ways:
                self.points[vertex] = before + part * way
                if (_shapes(self.points, self._mesh.tets[own]) >= self._least[own]).all():
                    break
                self.points[vertex] = before


def _along_boundary(offset: FloatArray, outward: FloatArray) -> FloatArray:
    """Return offsets of boundary vertices to a surface, turned into the tangent plane, (n, 3)."""
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    way = np.divide(offset, length, out=np.zeros_like(offset), where=length > 0.0)
    tangent = way - np.einsum("nd,nd->n", way, outward)[:, None] * outward
    square = (tangent**2).sum(axis=1, keepdims=True)
    steep = square > _STEEP**2
    return np.where(steep, length * tangent / np.maximum(square, _STEEP**2), 0.0)


def _shapes(points: FloatArray, tets: np.ndarray) -> FloatArray:
    """Return volume over the cube of the root mean square edge of elements, shape (n_tets,)."""
    corners = points[tets]
    first, second = np.triu_indices(4, 1)
    square = ((corners[:, first] - corners[:, second]) ** 2).sum(axis=2).mean(axis=1)
    return np.asarray(TetMesh(points, tets).tet_volumes / square**1.5)


def _text(point: FloatArray) -> str:
    return "[" + ", ".join(f"{one:.3f}" for one in point) + "]"


def _without_islands(mesh: TetMesh, second: np.ndarray) -> np.ndarray:
    """Return the sides; pieces below a hundredth of the organ change to the other side."""
    out = second.copy()
    for side in (second, ~second):
        own = np.flatnonzero(side)
        if len(own) == 0:
            continue
        label = components(mesh.tets[own])
        volume = np.bincount(label, weights=mesh.tet_volumes[own])
        small = (volume < _LEAST_PART * mesh.volume) & (volume < volume.max())
        turned = own[small[label]]
        out[turned] = ~out[turned]
    return out
