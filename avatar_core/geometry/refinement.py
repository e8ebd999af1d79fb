"""Tetrahedral meshes refined around points, and fitted there to the surface they came from.

A contact is some millimetres wide, the elements of an organ some ten. A reference solution needs
small elements around the contact alone, on the surface itself and not on its facets.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import igl
import numpy as np
import rslab
import scipy.sparse as sp
from skfem import Basis, BilinearForm, ElementTetP1, MeshTet
from skfem.helpers import dot, grad

from avatar_core.errors import MeshError
from avatar_core.geometry.mesh import Regions, TetMesh, make_mesh
from avatar_core.geometry.surface import SurfaceMesh

_SKFEM_LOG = logging.getLogger("skfem.mesh.mesh")
_FADE = 1.5  # radii within which fitting to the surface ends
_LEFT = 0.2e-3  # distance from the surface that may be left where elements would turn [m]
_ROUNDS, _LESS, _AROUND = 15, 0.7, 2.0  # rounds that take back motion: number, factor, reach


@dataclass(frozen=True, eq=False)
class Grading:
    """Longest edges of a mesh around a round contact, over its axis.

    h = max(core, inner min(rho, a)) + outer d, with rho the distance from the axis and d the
    distance from the disc of radius a. The contact is resolved at every radius, and the volume
    below it less.

    Attributes
    ----------
    point : ndarray, shape (3,)
        Centre of the contact [m].
    axis : ndarray, shape (3,)
        Unit vector along the axis.
    core : float
        h at the centre [m].
    radius : float
        a, the radius of the largest contact [m].
    inner : float
        Growth of h over rho inside the disc.
    outer : float
        Growth of h over the distance from it.
    """

    point: np.ndarray
    axis: np.ndarray
    core: float
    radius: float
    inner: float = 0.15
    outer: float = 0.35

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return h [m] at points x, shape (n, 3) [m]."""
        offset = x - self.point
        z = offset @ self.axis
        rho = np.sqrt(np.maximum((offset**2).sum(axis=1) - z**2, 0.0))
        inside = np.maximum(self.core, self.inner * np.minimum(rho, self.radius))
        return inside + self.outer * np.hypot(np.maximum(rho - self.radius, 0.0), z)


def refine(
    mesh: TetMesh, regions: Regions, gradings: Sequence[Grading], most_vertices: int = 100_000
) -> tuple[TetMesh, Regions]:
    """Bisect the longest edges of tetrahedra until none is longer than h at its centroid.

    The mesh stays conforming (Rivara, Int. J. Numer. Meth. Eng. 20:745, 1984; scikit-fem's
    implementation). Its shape and regions do not change.

    Parameters
    ----------
    regions : Regions
        Regions of ``mesh``.
    gradings : Sequence[Grading]
        Gradings of each contact; the least h counts.
    most_vertices : int
        Number of vertices above which refinement fails.

    Raises
    ------
    MeshError
        If the gradings ask for more vertices than ``most_vertices``.
    """
    fine = _skfem_mesh(mesh)
    while fine.p.shape[1] <= most_vertices:
        corners = fine.p.T[fine.t.T]
        wanted = np.min([h(corners.mean(axis=1)) for h in gradings], axis=0)
        marked = np.flatnonzero(_longest_edges(corners) > wanted)
        if len(marked) == 0:
            refined = _oriented(fine)
            return refined, _inherited(mesh, regions, refined)
        fine = _bisected(fine, marked)
    raise MeshError(
        f"the elements asked for need {fine.p.shape[1]} vertices and more; ask for larger ones"
    )


def _skfem_mesh(mesh: TetMesh) -> MeshTet:
    return MeshTet(np.ascontiguousarray(mesh.vertices.T), np.ascontiguousarray(mesh.tets.T))


def _longest_edges(corners: np.ndarray) -> np.ndarray:
    pairs = np.array([(i, j) for i in range(4) for j in range(i)])
    edges = corners[:, pairs[:, 0]] - corners[:, pairs[:, 1]]
    return np.asarray(np.linalg.norm(edges, axis=2).max(axis=1))


def _bisected(mesh: MeshTet, marked: np.ndarray) -> MeshTet:
    """Bisect once, without a seed of the global generator and without notes on memory layout."""
    state, level = np.random.get_state(), _SKFEM_LOG.level  # noqa: NPY002
    _SKFEM_LOG.setLevel(logging.ERROR)
    try:
        return mesh.refined(marked.astype(np.int32))
    finally:
        np.random.set_state(state)  # noqa: NPY002
        _SKFEM_LOG.setLevel(level)


def _oriented(mesh: MeshTet) -> TetMesh:
    tets = np.array(mesh.t.T, np.int64, order="C")
    turned = TetMesh(mesh.p.T, tets).tet_volumes < 0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    return make_mesh(np.ascontiguousarray(mesh.p.T), tets)


def _inherited(coarse: TetMesh, regions: Regions, fine: TetMesh) -> Regions:
    """Return the regions of the coarse boundary faces, in which the fine ones lie."""
    centroids = fine.vertices[fine.boundary_faces].mean(axis=1)
    faces = coarse.boundary_faces.astype(np.int64)
    parent = np.ravel(igl.point_mesh_squared_distance(centroids, coarse.vertices, faces)[1])
    return Regions(regions.clamped[parent], regions.accessible[parent])


def onto_surface(mesh: TetMesh, surface: SurfaceMesh, point: np.ndarray, radius: float) -> TetMesh:
    """Move the boundary within a radius of a point onto a surface, and the inside with it.

    A boundary vertex at the distance r moves by w(r) (closest(x) - x). The weight w is 1 below
    ``radius`` and fades to 0 at 1.5 ``radius``. Vertices inside move by the harmonic extension. At
    sharp edges, where elements would turn, vertices move less, by up to ``_LEFT`` within the
    radius.

    Parameters
    ----------
    mesh : TetMesh
        Mesh whose elements near the point are small against ``radius``.
    surface : SurfaceMesh
        Surface near the mesh's boundary.
    point : ndarray, shape (3,)
        Point [m].
    radius : float
        Radius [m].

    Raises
    ------
    MeshError
        If a tetrahedron would be turned inside out.
    """
    boundary = mesh.surface_vertices
    r = np.linalg.norm(mesh.vertices[boundary] - point, axis=1)
    moved, within = boundary[r < _FADE * radius], boundary[r < radius]
    start = mesh.vertices[moved]
    shift = np.zeros_like(mesh.vertices)
    shift[moved] = _fading(r[r < _FADE * radius] / radius)[:, None] * (
        _closest(surface, start) - start
    )
    extended = _harmonic(mesh)
    for _ in range(_ROUNDS):
        fitted = TetMesh(mesh.vertices + extended(shift), mesh.tets)
        turned = mesh.tets[fitted.tet_volumes <= 0]
        left = np.linalg.norm(
            _closest(surface, fitted.vertices[within]) - fitted.vertices[within], axis=1
        )
        if left.max(initial=0.0) > _LEFT:
            break
        if not len(turned):
            return fitted
        shift[_beside(mesh, moved, turned)] *= _LESS
    raise MeshError(
        "tetrahedra turn inside out on the way to the surface, "
        f"{1e3 * np.linalg.norm(start - _closest(surface, start), axis=1).max():.1f} mm off; mesh "
        "the organ with more vertices or fit it in a smaller radius"
    )


def _closest(surface: SurfaceMesh, points: np.ndarray) -> np.ndarray:
    return np.asarray(igl.point_mesh_squared_distance(points, *surface.skin.boundary)[2])


def _beside(mesh: TetMesh, moved: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Return the moved vertices within a tetrahedron's size of one that turned."""
    corners = mesh.vertices[turned]
    center = corners.mean(axis=1)
    size = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
    distance = np.linalg.norm(mesh.vertices[moved][:, None] - center, axis=2)
    return moved[(distance < _AROUND * size).any(axis=1)]


def _fading(x: np.ndarray) -> np.ndarray:
    """Return a weight that is 1 below x = 1 and fades to 0 at ``_FADE`` with continuous slope."""
    s = np.clip((_FADE - x) / (_FADE - 1.0), 0.0, 1.0)
    return np.asarray(s * s * (3.0 - 2.0 * s))


@BilinearForm
def _laplace(u, v, w):  # type: ignore[no-untyped-def]
    """Return a Laplacian that is stiffer where elements are small, which keeps their shape."""
    return dot(grad(u), grad(v)) / w.h


def _harmonic(mesh: TetMesh) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that extends boundary vectors to all vertices, shape (n_vertices, 3)."""
    matrix = _laplace.assemble(Basis(_skfem_mesh(mesh), ElementTetP1(), intorder=1)).tocsr()
    inside = np.setdiff1d(np.arange(len(mesh.vertices)), mesh.surface_vertices)
    factor = rslab.ldlt(sp.csc_matrix(matrix[inside][:, inside]), threads=1)

    def extended(shift: np.ndarray) -> np.ndarray:
        out = shift.copy()
        out[inside] = factor.solve_many(np.asfortranarray(-(matrix[inside] @ shift)))
        return out

    return extended
