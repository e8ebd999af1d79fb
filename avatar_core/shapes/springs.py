"""Springs between the surfaces of a template and a target, from each point to the nearest.

The nearest point minimises |x - y|^2 + length^2 |n_x - n_y|^2 over position and normal. The
normal's term keeps the two faces of a thin lobe apart. Without a length, it is the closest point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import RegistrationError
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.point_location import barycentric_centroids
from avatar_core.geometry.surface import SurfaceMesh, winding_number

RETURN_NORMAL_LENGTH = 0.03  # for springs from samples, if those from vertices use none [m]
_NEAR = 0.5e-3  # distance from a face at which its two sides are distinguished [m]
_PIECES = 3  # a template face is sampled at the centroids of this number squared of triangles


@dataclass(frozen=True, eq=False)
class Target:
    """A surface with evenly distributed samples.

    points : ndarray, shape (n, 3), samples [m]
    normals : ndarray, shape (n, 3), unit normals, outward by the winding number
    volume : enclosed volume [m^3]
    center : ndarray, shape (3,), its centroid [m]
    """

    surface: SurfaceMesh
    points: FloatArray
    normals: FloatArray
    volume: float
    center: FloatArray

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distances to the surface and closest points of it, shapes (k,) and (k, 3) [m]."""
        squared, _, nearest = igl.point_mesh_squared_distance(
            np.ascontiguousarray(points), self.surface.vertices, self.surface.faces.astype(np.int64)
        )
        return np.sqrt(squared), nearest

    def distance_to(self, vertices: FloatArray, faces: IntArray) -> FloatArray:
        """Return the distances of the samples from another triangulation, shape (n,) [m]."""
        squared, _, _ = igl.point_mesh_squared_distance(
            self.points, vertices, faces.astype(np.int64)
        )
        return np.sqrt(squared)


def sample_target(surface: SurfaceMesh, n: int) -> Target:
    """Distribute about n samples over a surface by area, in a low-discrepancy sequence.

    Sheets inside the organ get no samples; normals of flipped faces are turned outward.

    Raises
    ------
    RegistrationError
        If the surface encloses nothing.
    """
    vertices, faces = surface.vertices, surface.faces
    normals = _area_normals(vertices, faces)
    area = np.cumsum(np.linalg.norm(normals, axis=1))
    steps = np.arange(n)
    chosen = np.searchsorted(area[:-1], (steps + 0.5) / n * area[-1])
    # R2 sequence (Roberts 2018): fractional multiples of the plastic number's inverse powers
    plastic = 1.324717957244746
    u, v = (0.5 + steps / plastic) % 1.0, (0.5 + steps / plastic**2) % 1.0
    u, v = np.where(u + v > 1.0, (1.0 - u, 1.0 - v), (u, v))
    weight = np.stack([1.0 - u - v, u, v], axis=1)
    points = np.einsum("ik,ikd->id", weight, vertices[faces[chosen]])
    outward, bounding = _facing(surface, points, _unit(normals[chosen]))
    points, outward = points[bounding], outward[bounding]
    # divergence theorem over the samples: V = 1/3 int x.n da, c = 1/(2 V) int x^2 n da
    origin = points.mean(axis=0) if len(points) else np.zeros(3)
    arm, sample_area = points - origin, area[-1] / n
    volume = sample_area * float(np.sum(arm * outward)) / 3.0
    if not volume > 0:
        raise RegistrationError(f"{surface.name}: the surface encloses nothing; give a closed one")
    center = origin + sample_area * np.sum(arm**2 * outward, axis=0) / (2.0 * volume)
    return Target(surface, points, outward, volume, center)


def _facing(
    surface: SurfaceMesh, points: FloatArray, normals: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the outward normals of samples, and which samples separate inside from outside.

    At a face, the winding number jumps according to the orientation of that face; half an edge
    away, its neighbors outweigh a flipped face.
    """

    def inside(offset: float) -> NDArray[np.bool_]:
        return winding_number(surface, points + offset * normals) > 0.5

    half_edge = 0.5 * surface.mean_edge
    flipped = inside(half_edge) & ~inside(-half_edge)
    bounding = inside(_NEAR) != inside(-_NEAR)
    return np.where(flipped[:, None], -normals, normals), bounding


@dataclass(frozen=True, eq=False)
class Springs:
    """Pairs of a point on the template, sum_k barycentric_k x_node_k, and its anchor on the target.

    nodes : ndarray of int, shape (m, 3), vertices of the template's face
    barycentric : ndarray, shape (m, 3), coordinates of the point in the face
    anchors : ndarray, shape (m, 3), anchors on the target [m]
    normals : ndarray, shape (m, 3), unit normals at the anchors
    weights : ndarray, shape (m,), stiffness of each spring; the springs from each surface sum to
        one
    """

    nodes: IntArray
    barycentric: FloatArray
    anchors: FloatArray
    normals: FloatArray
    weights: FloatArray

    def points(self, positions: FloatArray) -> FloatArray:
        """Return the ends of the springs on the template, shape (m, 3) [m]."""
        return np.einsum("ik,ikd->id", self.barycentric, positions[self.nodes])

    def straightened(self, positions: FloatArray, reach: float) -> Springs:
        """Return the same springs, where those longer than ``reach`` [m] pull along their gap."""
        gap = self.anchors - self.points(positions)
        length = np.linalg.norm(gap, axis=1)
        far = length > reach
        normals = self.normals.copy()
        normals[far] = gap[far] / length[far, None]
        return replace(self, normals=normals)

    def system(self, n_vertices: int, tangential: float) -> tuple[sp.csr_matrix, FloatArray]:
        """Return A, b with |A x - b|^2 = sum w (gap . n)^2 + tangential w |gap - (gap . n) n|^2."""
        across = self.normals[:, :, None] * self.normals[:, None, :]
        pull = across + np.sqrt(tangential) * (np.eye(3) - across)
        pull *= np.sqrt(self.weights)[:, None, None]
        values = pull[:, :, None, :] * self.barycentric[:, None, :, None]
        columns = np.broadcast_to(
            (3 * self.nodes[:, :, None] + np.arange(3))[:, None], values.shape
        )
        starts = 9 * np.arange(3 * len(self.nodes) + 1)
        shape = (3 * len(self.nodes), 3 * n_vertices)
        matrix = sp.csr_matrix((values.ravel(), columns.ravel(), starts), shape=shape)
        return matrix, np.einsum("iab,ib->ia", pull, self.anchors).ravel()


def surface_springs(
    positions: FloatArray, mesh: TetMesh, target: Target, normal_length: float | None
) -> Springs:
    """Return springs from the template's vertices to the target, and back from every third sample.

    positions : ndarray, shape (n_vertices, 3), current positions of the template's vertices [m]
    normal_length : weight of the normals in the distance [m]. None connects the vertices to the
        closest point of the target's triangles, whatever its normal.
    """
    faces, own = mesh.boundary_faces, mesh.surface_vertices
    face_normals = _area_normals(positions, faces)
    if normal_length is None:
        anchor, normal = _on_triangles(positions[own], target)
    else:
        start = (positions[own], _vertex_normals(face_normals, faces, len(positions))[own])
        near = _nearest((target.points, target.normals), start, normal_length)
        anchor, normal = target.points[near], target.normals[near]
    weights = barycentric_centroids(_PIECES)
    points = np.einsum("qk,fkd->fqd", weights, positions[faces]).reshape(-1, 3)
    normals = np.repeat(_unit(face_normals), len(weights), axis=0)
    q, q_normal = target.points[::3], target.normals[::3]
    near = _nearest((points, normals), (q, q_normal), normal_length or RETURN_NORMAL_LENGTH)
    corner = np.zeros((len(own), 3))
    corner[:, 0] = 1.0
    face_area = np.linalg.norm(face_normals, axis=1)
    area = np.bincount(faces.ravel(), np.repeat(face_area, 3), len(positions))[own]
    return Springs(
        np.concatenate([np.repeat(own[:, None], 3, axis=1), faces[near // len(weights)]]),
        np.concatenate([corner, weights[near % len(weights)]]),
        np.concatenate([anchor, q]),
        np.concatenate([normal, q_normal]),
        np.concatenate([area / area.sum(), np.full(len(q), 1.0 / len(q))]),
    )


def _on_triangles(points: FloatArray, target: Target) -> tuple[FloatArray, FloatArray]:
    """Return the closest points of the target and gradients of the distance there, each (n, 3)."""
    distance, anchor = target.closest(points)
    near = cKDTree(target.points).query(anchor)[1]
    gradient = _unit(points - anchor)  # dominated by rounding where the distance is small
    return anchor, np.where(distance[:, None] > 2e-4, gradient, target.normals[near])


def _nearest(
    among: tuple[FloatArray, FloatArray], of: tuple[FloatArray, FloatArray], length: float
) -> IntArray:
    """Return the indices of the nearest pairs of position and normal, shape (k,)."""
    tree = cKDTree(np.hstack([among[0], length * among[1]]))
    return tree.query(np.hstack([of[0], length * of[1]]))[1]


def _area_normals(vertices: FloatArray, faces: NDArray[np.integer]) -> FloatArray:
    """Return the normal of each face times its area, shape (m, 3) [m^2]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def _vertex_normals(face_normals: FloatArray, faces: IntArray, n_vertices: int) -> FloatArray:
    """Return the area-weighted unit normals, zero off the surface, shape (n_vertices, 3)."""
    weight = np.repeat(face_normals, 3, axis=0)
    sums = [np.bincount(faces.ravel(), weight[:, axis], n_vertices) for axis in range(3)]
    return _unit(np.stack(sums, axis=1))


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
