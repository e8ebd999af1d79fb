"""Tetrahedral meshes of an organ, with the regions where it is held and where a tool may touch it.

``surface -> tetrahedralize -> TetMesh``. The boundary of a ``TetMesh`` carries two regions, the
clamp and the accessible surface. A geometric rule finds them here, or a file of node groups gives
them (:mod:`avatar_core.geometry.groups`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from avatar_core.errors import MeshError
from avatar_core.geometry.surface import SurfaceMesh, winding_number
from avatar_core.geometry.tetwild import fill_box

# Faces of a positively oriented tetrahedron, each with its normal pointing outwards.
_TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])

_COARSE, _FINE, _EDGE = 1100.0, 1750.0, 0.0950  # see _edge; fitted to livers of 2,850 vertices
_LEAST_FINE = 0.05  # fraction of the vertices wanted
_TRIES = 3  # to meet their number
_LOST_VOLUME = 0.03  # largest missing volume of a mesh; 64 livers at 2,850 vertices: below 0.8 %

IN_FACE = (np.ones((3, 3)) + 3.0 * np.eye(3)) / 6.0  # three points, exact for parabolas
POSTERIOR_SUPERIOR = np.array([0.0, -1.0, 1.0]) / np.sqrt(2.0)
ANTERIOR = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class TetMesh:
    """A tetrahedral mesh with positively oriented elements.

    Attributes
    ----------
    vertices : ndarray, shape (n_vertices, 3)
        Vertices [m].
    tets : ndarray of int, shape (n_tets, 4)
        Corners of each element.
    pairs : ndarray of int, shape (n_pairs, 2), or None
        Coinciding vertices of the two sides of a cut; None for a whole organ. Faces between the
        sides do not belong to the boundary.
    """

    vertices: np.ndarray
    tets: np.ndarray
    pairs: np.ndarray | None = None

    @cached_property
    def tet_volumes(self) -> np.ndarray:
        """Volume of each element, shape (n_tets,) [m^3]."""
        a, b, c, d = (self.vertices[self.tets[:, k]] for k in range(4))
        return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0

    @cached_property
    def boundary_faces(self) -> np.ndarray:
        """Outward oriented boundary triangles, shape (n_faces, 3)."""
        return self.tets[:, _TET_FACES].reshape(-1, 3)[self._boundary]

    @property
    def boundary_tets(self) -> np.ndarray:
        """Element of each boundary triangle, shape (n_faces,)."""
        return self._boundary // 4

    @cached_property
    def _boundary(self) -> np.ndarray:
        """Codes 4 element + face of the faces that only one element has, ascending."""
        return _single_faces(self.joined[self.tets])

    @cached_property
    def joined(self) -> np.ndarray:
        """Number of each vertex in the whole organ, where pairs are merged, shape (n_vertices,)."""
        number = np.arange(len(self.vertices))
        if self.pairs is not None:
            number[self.pairs[:, 1]] = self.pairs[:, 0]
        return number

    @cached_property
    def is_second_side(self) -> np.ndarray:
        """Mask of elements on the second side of the cut, shape (n_tets,)."""
        if self.pairs is None:
            return np.zeros(len(self.tets), bool)
        second = np.isin(self.tets, self.pairs[:, 1]).any(axis=1)
        return np.isin(self.pieces, self.pieces[second])

    @cached_property
    def on_second_side(self) -> np.ndarray:
        """Mask of vertices on the second side of the cut, shape (n_vertices,)."""
        found = np.zeros(len(self.vertices), bool)
        found[self.tets[self.is_second_side]] = True
        return found

    @cached_property
    def cut_faces(self) -> np.ndarray:
        """Triangles of the cut's two sides, vertex by vertex in pairs, shape (2, n, 3)."""
        if self.pairs is None:
            return np.empty((2, 0, 3), np.int64)
        single = np.setdiff1d(_single_faces(self.tets), self._boundary)
        first = single[~self.is_second_side[single // 4]]
        faces = self.tets[:, _TET_FACES].reshape(-1, 3)[first]
        other = np.arange(len(self.vertices))
        other[self.pairs[:, 0]] = self.pairs[:, 1]
        return np.stack([faces, other[faces]])

    @cached_property
    def face_area_normals(self) -> np.ndarray:
        """Outward normal of each boundary face times its area, shape (n_faces, 3) [m^2]."""
        a, b, c = (self.vertices[self.boundary_faces[:, k]] for k in range(3))
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def face_areas(self) -> np.ndarray:
        """Area of each boundary face, shape (n_faces,) [m^2]."""
        return np.linalg.norm(self.face_area_normals, axis=1)

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """Area-weighted unit outward normals, zero inside the organ, shape (n_vertices, 3)."""
        normals = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(normals, self.boundary_faces[:, k], self.face_area_normals)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, length, out=normals, where=length > 0)

    @cached_property
    def surface_vertices(self) -> np.ndarray:
        """Indices of the vertices on the boundary, ascending."""
        return np.unique(self.boundary_faces)

    @cached_property
    def vertex_volumes(self) -> np.ndarray:
        """Lumped volume of each vertex, shape (n_vertices,) [m^3]."""
        quarter = np.repeat(self.tet_volumes / 4.0, 4)
        return np.bincount(self.tets.ravel(), weights=quarter, minlength=len(self.vertices))

    @cached_property
    def lumped_mass(self) -> np.ndarray:
        """Vertex volume of each displacement component, shape (3 n_vertices,) [m^3]."""
        return np.repeat(self.vertex_volumes, 3)

    @cached_property
    def pieces(self) -> np.ndarray:
        """Face-connected component of each element, shape (n_tets,)."""
        return components(self.tets)

    @property
    def volume(self) -> float:
        """Volume of the organ [m^3]."""
        return float(self.tet_volumes.sum())

    @cached_property
    def centroid(self) -> np.ndarray:
        """Centroid of the organ, shape (3,) [m]."""
        return np.asarray(self.vertex_volumes @ self.vertices / self.volume)

    @property
    def mean_surface_edge(self) -> float:
        """Mean edge length of the boundary triangles [m]."""
        corners = self.vertices[self.boundary_faces]
        return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())


@dataclass(frozen=True)
class Regions:
    """Masks of the boundary faces where the organ is held and where a tool may touch it.

    Attributes
    ----------
    clamped : ndarray of bool, shape (n_faces,)
        Clamped faces among ``TetMesh.boundary_faces``.
    accessible : ndarray of bool, shape (n_faces,)
        Accessible faces, disjoint from the clamp's neighborhood.
    """

    clamped: np.ndarray
    accessible: np.ndarray


@dataclass(frozen=True)
class MeshQuality:
    """Shape of the worst elements.

    Attributes
    ----------
    min_dihedral : float
        Smallest dihedral angle [deg].
    max_dihedral : float
        Largest dihedral angle [deg].
    min_volume : float
        Smallest element volume over the mean one.
    """

    min_dihedral: float
    max_dihedral: float
    min_volume: float


def make_mesh(vertices: np.ndarray, tets: np.ndarray) -> TetMesh:
    """Check and orient a tetrahedral mesh; unused vertices are dropped.

    Raises
    ------
    MeshError
        If there are no elements, coordinates are not finite, or an element has no volume.
    """
    vertices, tets = np.asarray(vertices, float), np.asarray(tets, np.int64)
    if len(tets) == 0:
        raise MeshError("the mesh has no tetrahedra; give a closed surface of an organ")
    if not np.isfinite(vertices).all():
        raise MeshError("the mesh has vertices that are not finite; repair the input file")
    used, tets = np.unique(tets, return_inverse=True)
    mesh = TetMesh(vertices[used], tets.reshape(-1, 4))
    negative = mesh.tet_volumes < 0
    if negative.any() and not negative.all():
        raise MeshError(
            f"{negative.sum()} of {len(tets)} tetrahedra are inverted; "
            "remesh the surface instead of passing these elements"
        )
    if negative.all():
        mesh = TetMesh(mesh.vertices, mesh.tets[:, [0, 2, 1, 3]])
    scale = np.ptp(mesh.vertices, axis=0).max() ** 3
    flat = mesh.tet_volumes < 1e-12 * scale
    if flat.any():
        raise MeshError(f"{flat.sum()} tetrahedra have no volume; remesh the surface")
    return mesh


def tetrahedralize(surface: SurfaceMesh, n_vertices: int = 2850) -> TetMesh:
    """Fill a surface with tetrahedra by fTetWild, to about the number of vertices asked for.

    The same surface gives the same mesh, bit for bit, and the mesh holds its volume.

    fTetWild accepts cracked, doubled and self-intersecting faces (Hu et al., "Fast Tetrahedral
    Meshing in the Wild", 2020). It fills a box. Tetrahedra are kept if the winding number of the
    surface at their centroid says inside. fTetWild's own filter sometimes loses a lobe of a folded
    liver.

    Parameters
    ----------
    n_vertices : int
        Number of mesh vertices aimed at, met to about 10 %. The least that a surface allows is 600
        to 2,000.

    Raises
    ------
    MeshError
        If no mesh comes out, or none that fills the surface.
    """
    if n_vertices < 50:
        raise MeshError(f"{n_vertices} vertices are too few for an organ; ask for at least 50")
    coarse = min(_COARSE, 0.85 * n_vertices)
    edge = _edge(surface.volume, n_vertices, coarse)
    for _ in range(_TRIES):
        mesh = _fill(surface, edge)
        n_found, before = len(mesh.vertices), edge
        if 0.88 < n_found / n_vertices < 1.12:
            break
        coarse = n_found - _FINE * surface.volume * (_EDGE / edge) ** 3
        edge = _edge(surface.volume, n_vertices, coarse)
        if 0.95 < edge / before < 1.05:
            break  # no mesh of this surface is coarser
    lost = 1.0 - mesh.volume / surface.volume
    if abs(lost) > _LOST_VOLUME:
        raise MeshError(
            f"the mesh holds {1.0 - lost:.0%} of the volume of the surface; close its gaps and "
            "remove faces inside the organ, or ask for more vertices"
        )
    return _filled_out(mesh, surface)


def _filled_out(mesh: TetMesh, surface: SurfaceMesh) -> TetMesh:
    """Return the mesh with its boundary moved along its normals by the mean gap to the surface.

    Facets between points of a round surface cut corners: for a liver they lack half a per cent.
    """
    faces, area = mesh.boundary_faces, mesh.face_areas
    points = np.einsum("qk,fkd->fqd", IN_FACE, mesh.vertices[faces]).reshape(-1, 3)
    closest = igl.point_mesh_squared_distance(points, *surface.skin.boundary)[2]
    gap = (closest - points).reshape(len(faces), -1, 3).mean(axis=1)
    outward = (gap * mesh.face_area_normals).sum() / area.sum()
    moved = TetMesh(mesh.vertices + outward * mesh.vertex_normals, mesh.tets)
    return moved if (moved.tet_volumes > 0.0).all() else mesh


def _edge(volume: float, n_vertices: int, coarse: float) -> float:
    """Return the edge h [m] for about n vertices: n = n_0 + ``_FINE`` V (``_EDGE`` / h)^3.

    The envelope takes n_0 = ``coarse`` vertices, however long the edge is. Over seven surfaces with
    600 to 25,000 vertices, the formula is off by 15 % at most; n_0 is known after one try.
    """
    fine = max(n_vertices - coarse, _LEAST_FINE * n_vertices)
    return float(_EDGE * (volume * _FINE / fine) ** (1.0 / 3.0))


def _fill(surface: SurfaceMesh, edge: float) -> TetMesh:
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    vertices, tets = fill_box(
        surface.vertices * 1e3,  # millimetres, for which fTetWild's thresholds are made
        surface.faces.astype(np.int32),
        edge=edge / diagonal,
        envelope=4e-3,  # a smaller one forbids coarse meshes
    )
    vertices = vertices * 1e-3
    volumes = TetMesh(vertices, tets).tet_volumes
    if np.median(volumes) < 0:
        tets, volumes = tets[:, [0, 2, 1, 3]], -volumes
    inside = np.abs(winding_number(surface, vertices[tets].mean(axis=1))) > 0.5
    solid = tets[inside & (volumes > 1e-9 * np.abs(volumes).mean())]
    if len(solid) == 0:
        raise MeshError("no tetrahedra fit into the surface; check that it encloses a volume")
    return make_mesh(vertices, _largest_component(solid))


def _single_faces(tets: np.ndarray) -> np.ndarray:
    """Return codes 4 element + face of the faces that only one element has, ascending."""
    faces = np.sort(tets[:, _TET_FACES].reshape(-1, 3), axis=1)
    _, first, count = np.unique(faces, axis=0, return_index=True, return_counts=True)
    return np.sort(first[count == 1])


def _largest_component(tets: np.ndarray) -> np.ndarray:
    """Return the elements of the largest face-connected component."""
    label = components(tets)
    return tets[label == np.bincount(label).argmax()]


def components(tets: np.ndarray) -> np.ndarray:
    """Return the face-connected component of each element, shape (n_tets,)."""
    return _components(tets[:, _TET_FACES])


def _components(sides: np.ndarray) -> np.ndarray:
    """Return the component of each element, shape (n,), by the sides that elements share.

    sides : ndarray of int, shape (n, n_sides, n_corners)
    """
    n, n_sides, n_corners = sides.shape
    corners = np.sort(sides.reshape(-1, n_corners), axis=1)
    _, side = np.unique(corners, axis=0, return_inverse=True)
    owner = np.repeat(np.arange(n), n_sides)
    incidence = sp.csr_matrix((np.ones(len(owner)), (owner, side.ravel())))
    return np.asarray(connected_components(incidence @ incidence.T, directed=False)[1])


def regions_by_rule(
    mesh: TetMesh, clamp_fraction: float = 0.13, anterior_cosine: float = 0.2
) -> Regions:
    """Clamp the posterior-superior cap and open the anterior surface to the tool.

    The bare area and the caval groove hold a liver from behind and above. The boundary faces
    farthest in the direction (0, -1, 1)/sqrt(2) (RAS axes) are clamped until they hold
    ``clamp_fraction`` of the area. Faces whose normal has at least ``anterior_cosine`` along +y are
    accessible. Faces that touch the clamp, and islands below 5 % of the area, are left out.
    """
    faces, area = mesh.boundary_faces, mesh.face_areas
    height = mesh.vertices[faces].mean(axis=1) @ POSTERIOR_SUPERIOR
    order = np.argsort(-height, kind="stable")
    clamped = np.zeros(len(faces), bool)
    clamped[order[np.cumsum(area[order]) <= clamp_fraction * area.sum()]] = True
    if not clamped.any():
        clamped[order[0]] = True
    accessible = accessible_by_rule(mesh, touching(mesh, clamped), anterior_cosine)
    return checked(Regions(clamped, accessible))


def accessible_by_rule(
    mesh: TetMesh, covered: np.ndarray, anterior_cosine: float = 0.2
) -> np.ndarray:
    """Return the faces that look forward and are not covered, without islands, shape (n_faces,)."""
    anterior = mesh.face_area_normals @ ANTERIOR > anterior_cosine * mesh.face_areas
    return without_islands(mesh.boundary_faces, mesh.face_areas, anterior & ~covered, least=0.05)


def touching(mesh: TetMesh, chosen: np.ndarray) -> np.ndarray:
    """Return boundary faces with a vertex on the chosen ones, these included, shape (n_faces,)."""
    faces = mesh.boundary_faces
    return np.asarray(np.isin(faces, faces[chosen]).any(axis=1))


def without_islands(
    faces: np.ndarray, area: np.ndarray, chosen: np.ndarray, least: float
) -> np.ndarray:
    """Drop edge-connected islands that hold less than ``least`` of the chosen area."""
    ids = np.flatnonzero(chosen)
    if len(ids) == 0:
        return chosen
    label = _components(faces[ids][:, [[0, 1], [1, 2], [2, 0]]])
    fraction = np.bincount(label, weights=area[ids]) / area[ids].sum()
    kept = np.zeros_like(chosen)
    kept[ids[fraction[label] >= least]] = True
    return kept


def checked(regions: Regions, on_supports: bool = False) -> Regions:
    """Return the regions of an organ that is held, by a clamp unless it is on supports.

    Raises
    ------
    MeshError
        If the organ is not held, or no tool reaches it.
    """
    if not (regions.clamped.any() or on_supports):
        raise MeshError("no face is clamped, so the organ could float away; widen the clamp")
    if not regions.accessible.any():
        raise MeshError("no face is accessible to the tool; check the axes (--axes) or the groups")
    return regions


def quality(mesh: TetMesh) -> MeshQuality:
    """Return the extreme dihedral angles and the smallest relative volume of a mesh."""
    corners = mesh.vertices[mesh.tets]
    normals = []
    for face in _TET_FACES:
        a, b, c = (corners[:, k] for k in face)
        n = np.cross(b - a, c - a)
        normals.append(n / np.linalg.norm(n, axis=1, keepdims=True))
    pairs = [(i, j) for i in range(4) for j in range(i)]
    cosine = np.array([-np.einsum("ij,ij->i", normals[i], normals[j]) for i, j in pairs])
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    volumes = mesh.tet_volumes
    return MeshQuality(
        float(angle.min()), float(angle.max()), float(volumes.min() / volumes.mean())
    )
