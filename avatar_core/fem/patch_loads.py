"""Load positions, patch tractions and their conjugate displacements.

A tool tip presses through a *patch*: a traction of unit total force, spread over the surface around
its centre s by the compact profile

    psi_s(x) = c (1 - |x - s|^2 / R^2)^2 max(0, n(x) . n_s),   |x - s| < R,   int psi_s da = 1.

Here n_s is the mean normal of the surface within R. R is a physical length, so that refining the
mesh does not change the load. The conjugate displacement is the average u_bar(s) = int psi_s u da:
force times u_bar is work.

Positions s are the vertices of the accessible faces and, where these are coarse against R, their
edge midpoints. Between positions, everything that depends on s is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from avatar_core.errors import LoadError, MeshError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.triangles import subdivided_rule, triangle_shape
from avatar_core.geometry.mesh import Regions, TetMesh

LEAST_PATCH_RADIUS = 12e-3  # [m]
FARTHEST = 5e-3  # largest distance of a point from the accessible surface [m]
LEAST_OPENNESS = 0.2  # length of the mean unit normal within R, below which a face carries no load
# Mean edge, in patch radii, from which edges get a midpoint. Linear interpolation between corners
# misses 9 % of the contact compliance at 0.6 (a small liver, Amos-052), and grows with its square.
MIDPOINTS_FROM = 0.3
MOST_POSITIONS = 6000  # with midpoints; the contact near field grows with their square


@dataclass(frozen=True, eq=False)
class SurfacePoint:
    """A point of the accessible surface.

    Attributes
    ----------
    positions, weights : ndarray, shape (n,)
        Load positions that interpolate the point, and their weights.
    point : ndarray, shape (3,)
        Point [m].
    normal : ndarray, shape (3,)
        Unit outward normal of its patch.
    """

    positions: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class LoadSurface:
    """The load positions of the accessible surface.

    Attributes
    ----------
    centers : ndarray, shape (n_positions, 3)
        Patch centres [m].
    normals : ndarray, shape (n_positions, 3)
        Normals of the patches, :func:`patch_normals`.
    corners : ndarray of int, shape (n_triangles, 3)
        Positions at the corners of each face.
    vertices : ndarray of int, shape (n_corners,)
        Mesh vertex of the first positions; the others are edge midpoints.
    patch_radius : float
        R [m].
    """

    centers: np.ndarray
    normals: np.ndarray
    corners: np.ndarray
    vertices: np.ndarray
    patch_radius: float

    @property
    def n_positions(self) -> int:
        """Number of load positions."""
        return len(self.centers)

    @property
    def centroids(self) -> np.ndarray:
        """Centroids of the accessible faces, shape (n_triangles, 3) [m]."""
        return self.centers[self.corners].mean(axis=1)

    def largest_apart(self, values: np.ndarray, n: int, distance: float) -> np.ndarray:
        """Return positions of the largest positive values that lie at least a distance apart.

        Parameters
        ----------
        values : ndarray, shape (n_positions,)
        n : int
            Largest number of positions.
        distance : float
            Least distance between two positions [m].

        Returns
        -------
        ndarray of int
            Positions, the largest value first.
        """
        left = values.copy()
        chosen: list[int] = []
        while len(chosen) < n and left.max() > 0.0:
            chosen.append(int(left.argmax()))
            left[np.linalg.norm(self.centers - self.centers[chosen[-1]], axis=1) < distance] = 0.0
        return np.array(chosen, np.int64)

    @property
    def area(self) -> float:
        """Area of the accessible faces [m^2]."""
        a, b, c = (self.centers[self.corners[:, i]] for i in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)

    @property
    def face_normals(self) -> np.ndarray:
        """Unit outward normals of the accessible faces, shape (n_triangles, 3)."""
        a, b, c = (self.centers[self.corners[:, i]] for i in range(3))
        return _unit(np.cross(b - a, c - a))

    @cached_property
    def face_positions(self) -> np.ndarray:
        """Load positions of each face: corners, then midpoints of edges 01, 12, 20, if any."""
        n_corners = len(self.vertices)
        if self.n_positions == n_corners:
            return self.corners
        edges = np.sort(self.corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        _, number = np.unique(edges, axis=0, return_inverse=True)
        return np.concatenate([self.corners, n_corners + number.reshape(-1, 3)], axis=1)

    def weights(self, faces: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return load positions and interpolation weights at points of faces, (n, 3 or 6) each.

        Interpolation is quadratic where the edges have midpoints, else linear. A position has
        weight one at itself and zero at the others.

        Parameters
        ----------
        faces : ndarray of int, shape (n,)
        barycentric : ndarray, shape (n, 3)
        """
        positions = self.face_positions[faces]
        return positions, barycentric if positions.shape[1] == 3 else triangle_shape(barycentric)

    def nearest(self, point: ArrayLike) -> SurfacePoint:
        """Return the point of the accessible surface nearest to a point in space.

        Parameters
        ----------
        point : array_like, shape (3,)
            Point [m].

        Raises
        ------
        LoadError
            If the point is not finite, or farther than 5 mm from the accessible surface.
        """
        asked = np.array(point, float).reshape(-1)
        if asked.shape != (3,):
            raise LoadError("a point is three finite numbers; give x, y, z in metres")
        return self.nearest_each(asked[None])[0]

    def nearest_each(self, points: np.ndarray) -> list[SurfacePoint]:
        """Return the nearest points of the accessible surface to several points, shape (k, 3) [m].

        Raises
        ------
        LoadError
            As :meth:`nearest`, for the first point that is refused.
        """
        if not np.isfinite(points).all():
            raise LoadError("a point is three finite numbers; give x, y, z in metres")
        square, face, found = igl.point_mesh_squared_distance(
            points, self.centers, self.corners.astype(np.int64)
        )
        distance, faces = np.sqrt(np.ravel(square)), np.ravel(face).astype(int)
        for off in distance[distance > FARTHEST]:
            raise LoadError(
                f"the load is {1e3 * off:.1f} mm off the accessible surface; give a point "
                f"within {1e3 * FARTHEST:g} mm of it, in metres"
            )
        on_surface = np.reshape(found, (-1, 3))
        corners = self.centers[self.corners[faces]]
        barycentric = [
            np.linalg.lstsq(np.vstack([c.T, np.ones(3)]), np.append(p, 1.0), rcond=None)[0]
            for c, p in zip(corners, on_surface, strict=True)
        ]
        positions, weights = self.weights(faces, np.array(barycentric).reshape(-1, 3))
        normals = np.einsum("kn,knd->kd", weights, self.normals[positions])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return [
            SurfacePoint(*each)
            for each in zip(positions, weights, on_surface, normals, strict=True)
        ]


def default_patch_radius(mesh: TetMesh, regions: Regions) -> float:
    """Return R = max(12 mm, 1.2 x mean edge of the accessible surface) [m]."""
    corners = mesh.vertices[mesh.boundary_faces[regions.accessible]]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean()
    return max(LEAST_PATCH_RADIUS, 1.2 * float(edge))


def load_surface(mesh: TetMesh, regions: Regions, patch_radius: float | None = None) -> LoadSurface:
    """Return the load positions of the accessible region.

    Raises
    ------
    MeshError
        If the surface cannot resolve the patch radius, or no face has room for a patch.
    """
    if patch_radius is None:
        patch_radius = default_patch_radius(mesh, regions)
    faces = _open_faces(mesh, mesh.boundary_faces[regions.accessible], patch_radius)
    if len(faces) == 0:
        raise MeshError(
            f"a patch of radius {patch_radius:g} m reaches around the organ, wherever it presses; "
            "take a smaller radius (12e-3: 12 mm)"
        )
    # both sides of a cut have the same load positions
    vertices, corner = np.unique(mesh.joined[faces], return_inverse=True)
    corner = corner.reshape(-1, 3)
    a, b = np.unique(np.sort(corner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0).T
    point = mesh.vertices[vertices]
    fine = np.linalg.norm(point[a] - point[b], axis=1).mean() < MIDPOINTS_FROM * patch_radius
    if fine or len(point) + len(a) > MOST_POSITIONS:
        a = b = np.empty(0, np.int64)
    centers = np.concatenate([point, (point[a] + point[b]) / 2.0])
    return LoadSurface(
        centers=centers,
        normals=patch_normals(mesh, centers, patch_radius),
        corners=corner,
        vertices=vertices,
        patch_radius=float(patch_radius),
    )


def _open_faces(mesh: TetMesh, faces: np.ndarray, radius: float) -> np.ndarray:
    """Return the faces where a patch has room: no walls of fissures, no flaps much thinner than R.

    There the surface looks every way within R, so that no patch has a normal.
    """
    points = _surface_points(mesh, radius)
    around = _bump(points, mesh.vertices[faces].mean(axis=1), radius)
    mean = (around @ points.normals) / np.asarray(around.sum(axis=1)).reshape(-1, 1)
    return faces[np.linalg.norm(mean, axis=1) > LEAST_OPENNESS]


def patch_normals(mesh: TetMesh, centers: np.ndarray, radius: float) -> np.ndarray:
    """Return the normals of patches: the mean surface normal within R, weighted like the traction.

    n_s ~ int (1 - |x - s|^2 / R^2)^2 n da. It turns smoothly with s, unlike the faces. Everything
    that depends on s is then smooth enough to be interpolated.

    Parameters
    ----------
    centers : ndarray, shape (n, 3)
        Patch centres [m].
    radius : float
        R [m].

    Returns
    -------
    ndarray, shape (n, 3)
        Unit vectors.
    """
    points = _surface_points(mesh, radius)
    return _unit(_bump(points, centers, radius) @ points.normals)


def patch_loads(elasticity: Elasticity, centers: np.ndarray, radius: float) -> sp.csr_matrix:
    """Return the nodal forces of unit patch tractions in the three coordinate directions.

    Column ``3 i + d`` integrates psi_{s_i} e_d against the element's shape functions; its transpose
    averages: ``loads.T @ u`` is u_bar. The profile is normalized by its own quadrature, so the
    total force of a column is one to rounding.

    Parameters
    ----------
    centers : ndarray, shape (n, 3)
        Patch centres [m].
    radius : float
        R [m].

    Returns
    -------
    sparse, shape (3 n_nodes, 3 n)
        Nodal forces [N per N].

    Raises
    ------
    MeshError
        If the surface cannot resolve the radius, or a patch meets no point of it.
    """
    points = _surface_points(elasticity.mesh, radius)
    profile = _bump(points, centers, radius).tocoo()
    normals = _unit(profile @ points.normals)
    facing = np.einsum("ij,ij->i", points.normals[profile.col], normals[profile.row])
    profile.data = profile.data * np.maximum(facing, 0.0)
    total = np.asarray(profile.sum(axis=1)).ravel()
    if not (total > 0).all():
        raise MeshError(f"a patch of radius {radius:g} m holds no surface; enlarge it")
    scalar = sp.diags(1.0 / total) @ profile @ _trace(elasticity, points)
    return sp.kron(scalar, sp.identity(3), format="csr").T.tocsr()


def _require_resolved(mesh: TetMesh, radius: float) -> None:
    """Raise MeshError unless a patch is larger than the faces' edges and smaller than the organ."""
    if not 0.2 * mesh.mean_surface_edge <= radius < np.inf:
        raise MeshError(
            f"a patch of radius {radius:g} m cannot be resolved by surface edges of "
            f"{mesh.mean_surface_edge:.2g} m; refine the mesh or take a radius above 12 mm"
        )
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    if radius >= diagonal:  # all of the surface, whose mean normal is zero
        raise MeshError(
            f"a patch of radius {radius:g} m is larger than the organ of {diagonal:.2g} m; "
            "take a smaller radius (12e-3: 12 mm)"
        )


@dataclass(frozen=True)
class _SurfacePoints:
    """Quadrature on the boundary, face by face.

    barycentric (n_per_face, 3), points (n, 3) [m], weights (n,) [m2], normals (n, 3)
    """

    barycentric: np.ndarray
    points: np.ndarray
    weights: np.ndarray
    normals: np.ndarray


def _surface_points(mesh: TetMesh, radius: float) -> _SurfacePoints:
    _require_resolved(mesh, radius)
    pieces = max(1, int(np.ceil(1.5 * mesh.mean_surface_edge / radius)))
    barycentric, weight = subdivided_rule(pieces)
    corners = mesh.vertices[mesh.boundary_faces]
    unit = mesh.face_area_normals / mesh.face_areas[:, None]
    return _SurfacePoints(
        barycentric,
        np.einsum("qk,fkd->fqd", barycentric, corners).reshape(-1, 3),
        np.outer(mesh.face_areas, weight).ravel(),
        np.repeat(unit, len(weight), axis=0),
    )


def _bump(points: _SurfacePoints, centers: np.ndarray, radius: float) -> sp.csr_matrix:
    """Return quadrature weights times (1 - |x - s|^2 / R^2)^2, sparse, (n_centers, n_points)."""
    near = cKDTree(points.points).query_ball_point(centers, radius)
    size = np.array([len(hit) for hit in near])
    center = np.repeat(np.arange(len(centers)), size)
    point = np.concatenate([np.asarray(hit, np.int64) for hit in near])
    squared = ((points.points[point] - centers[center]) ** 2).sum(axis=1) / radius**2
    value = points.weights[point] * (1.0 - squared) ** 2
    return sp.csr_matrix((value, (center, point)), shape=(len(centers), len(points.points)))


def _trace(elasticity: Elasticity, points: _SurfacePoints) -> sp.csr_matrix:
    """Return shape functions of the boundary's nodes at the quadrature points."""
    barycentric, n_faces = points.barycentric, len(elasticity.face_nodes)
    shape = barycentric if elasticity.element == "P1" else triangle_shape(barycentric)
    nodes = np.repeat(elasticity.face_nodes, len(barycentric), axis=0)
    rows = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    return sp.csr_matrix(
        (np.tile(shape, (n_faces, 1)).ravel(), (rows, nodes.ravel())),
        shape=(len(nodes), elasticity.n_nodes),
    )


def scaled_gram(elasticity: Elasticity, loads: sp.spmatrix) -> sp.csr_matrix:
    """Return F^T D^-1 F of loads F, (n_loads, n_loads), which measures residuals; D = diag K."""
    return (loads.T @ sp.diags(1.0 / elasticity.diagonal) @ loads).tocsr()


def triples(positions: np.ndarray) -> np.ndarray:
    """Return the numbers of the three loads of each position, shape (3 n,)."""
    return np.asarray((3 * np.asarray(positions)[:, None] + np.arange(3)).ravel())


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
