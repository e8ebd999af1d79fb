"""What a registered template carries to a patient: clamp, loads, and fields on its mesh.

The registered template and the patient's own mesh fill the same organ. A point of one is found in
the other by barycentric coordinates, beyond the surface at the closest point of it:

    u_patient(x) = sum_k l_k(x) u_template,k

so that everything carried is a sparse matrix whose rows sum to one and keep affine fields.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from avatar_core.errors import RegistrationError
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.geometry.mesh import Regions, TetMesh, without_islands
from avatar_core.shapes.registration import Registration
from avatar_core.shapes.springs import barycentric_centroids

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_PIECES = 3  # a patient's face goes to the region that most of its 3^2 pieces lie in
_SLACK = 1e-9  # barycentric coordinates this far below zero still count as inside


@dataclass(frozen=True)
class LoadPositions:
    """Centres of load patches on a patient's surface, in the order of the template's.

    centers : ndarray, shape (n_positions, 3) [m]
    normals : ndarray, shape (n_positions, 3), unit outward normals
    distances : ndarray, shape (n_positions,) [m], from the registered template's positions
    """

    centers: FloatArray
    normals: FloatArray
    distances: FloatArray


def carry_regions(registration: Registration, patient: TetMesh) -> Regions:
    """Clamp and accessible faces of the patient's mesh by correspondence with the template.

    Each piece of a patient's face takes the region of the closest registered face, the face that
    of most of its pieces. Accessible faces that touch the clamp and islands below 5 % of the
    accessible area are left out, as in the anatomical rule.

    Parameters
    ----------
    registration : Registration
    patient : TetMesh of the surface that was registered to

    Raises
    ------
    RegistrationError
        If the patient's mesh lies elsewhere, or no face falls into one of the regions.
    """
    _require_same_place(registration, patient)
    faces = patient.boundary_faces
    weights = barycentric_centroids(_PIECES)
    pieces = np.einsum("qk,fkd->fqd", weights, patient.vertices[faces]).reshape(-1, 3)
    _, owner, _ = _closest(registration.mesh.vertices, registration.mesh.boundary_faces, pieces)
    owner = owner.reshape(len(faces), -1)
    regions = registration.template.regions
    clamped = regions.clamped[owner].mean(axis=1) > 0.5
    accessible = regions.accessible[owner].mean(axis=1) > 0.5
    accessible &= ~np.isin(faces, faces[clamped]).any(axis=1)
    accessible = without_islands(faces, patient.face_areas, accessible, least=0.05)
    if not (clamped.any() and accessible.any()):
        raise RegistrationError(
            "no face of the patient's mesh falls into the template's clamp or accessible region; "
            "use a finer patient mesh"
        )
    return Regions(clamped, accessible)


def carry_positions(
    registration: Registration, loads: LoadSurface, patient: TetMesh
) -> LoadPositions:
    """The template's load positions on the patient's surface.

    Parameters
    ----------
    registration : Registration
    loads : LoadSurface of the template's mesh and regions
    patient : TetMesh of the surface that was registered to

    Raises
    ------
    RegistrationError
        If the patient's mesh lies elsewhere.
    """
    _require_same_place(registration, patient)
    wanted = registered_positions(registration, loads)
    faces = patient.boundary_faces
    centers, face, weight = _closest(patient.vertices, faces, wanted)
    normals = np.einsum("ik,ikd->id", weight, patient.vertex_normals[faces[face]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return LoadPositions(centers, normals, np.linalg.norm(centers - wanted, axis=1))


def registered_positions(registration: Registration, loads: LoadSurface) -> FloatArray:
    """The template's load positions on the registered template: vertices, then edge midpoints.

    Returns
    -------
    ndarray, shape (n_positions, 3) [m]

    Raises
    ------
    RegistrationError
        If the loads belong to another mesh or other regions.
    """
    template = registration.template
    faces = template.mesh.boundary_faces[template.regions.accessible]
    corner = loads.corners
    if corner.shape != faces.shape or not np.array_equal(loads.vertices[corner], faces):
        raise RegistrationError(
            "the load positions are not those of the template; make them by load_surface from the "
            "template's mesh and regions"
        )
    point = registration.mesh.vertices[loads.vertices]
    positions = np.empty((loads.n_positions, 3))
    positions[: len(point)] = point
    middle = loads.face_positions[:, 3:]  # none where the faces are fine
    for k in range(middle.shape[1]):
        positions[middle[:, k]] = (point[corner[:, k]] + point[corner[:, k - 2]]) / 2.0
    return positions


def field_map(registration: Registration, points: FloatArray) -> sp.csr_matrix:
    """Interpolation of nodal fields from the registered template to points.

    Points in a tetrahedron take its barycentric coordinates, points outside those of the closest
    point of the surface.

    Parameters
    ----------
    registration : Registration
    points : ndarray, shape (n, 3) [m], for instance the vertices of the patient's own mesh

    Returns
    -------
    sparse, shape (n, n_template_vertices), rows sum to one
    """
    mesh = registration.mesh
    tet, weight = locate(mesh, points)
    inside = np.flatnonzero(tet >= 0)
    outside = np.flatnonzero(tet < 0)
    faces = mesh.boundary_faces
    _, face, face_weight = _closest(mesh.vertices, faces, points[outside])
    rows = np.concatenate([np.repeat(inside, 4), np.repeat(outside, 3)])
    columns = np.concatenate([mesh.tets[tet[inside]].ravel(), faces[face].ravel()])
    values = np.concatenate([weight[inside].ravel(), face_weight.ravel()])
    return sp.csr_matrix((values, (rows, columns)), shape=(len(points), len(mesh.vertices)))


def load_map(registration: Registration, loads: LoadSurface, points: FloatArray) -> sp.csr_matrix:
    """Interpolation between the template's load positions at points of the patient's surface.

    By the loads' own shape functions at the closest point of the registered template's accessible
    faces.

    Parameters
    ----------
    registration : Registration
    loads : LoadSurface of the template's mesh and regions
    points : ndarray, shape (n, 3) [m]

    Returns
    -------
    sparse, shape (n, n_positions), rows sum to one

    Raises
    ------
    RegistrationError
        If the loads belong to another mesh or other regions.
    """
    positions = registered_positions(registration, loads)
    _, face, barycentric = _closest(positions, loads.corners, points)
    columns, values = loads.weights(face, barycentric)
    rows = np.repeat(np.arange(len(points)), columns.shape[1])
    return sp.csr_matrix(
        (values.ravel(), (rows, columns.ravel())), shape=(len(points), len(positions))
    )


def locate(mesh: TetMesh, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """Tetrahedron and barycentric coordinates of points.

    Returns
    -------
    tet : ndarray of int, shape (n,), -1 outside
    weight : ndarray, shape (n, 4), sums to one, zero outside
    """
    corners = mesh.vertices[mesh.tets]
    center = corners.mean(axis=1)
    reach = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
    found = cKDTree(points).query_ball_point(center, reach * (1.0 + 1e-9))
    size = np.array([len(hits) for hits in found])
    tet = np.repeat(np.arange(len(found)), size)
    point = np.fromiter((i for hits in found for i in hits), np.int64, size.sum())
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    local = np.linalg.inv(edges)[tet] @ (points[point] - corners[tet, 0])[:, :, None]
    weight = np.concatenate([1.0 - local.sum(axis=1), local[:, :, 0]], axis=1)
    depth = weight.min(axis=1)
    order = np.argsort(depth, kind="stable")  # the deepest of a point is written last
    order = order[depth[order] >= -_SLACK]
    where, coordinates = np.full(len(points), -1), np.zeros((len(points), 4))
    where[point[order]], coordinates[point[order]] = tet[order], weight[order]
    return where, coordinates


def _closest(
    vertices: FloatArray, faces: IntArray, points: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Closest points of a triangulation (n, 3), their faces (n,) and barycentric coordinates."""
    faces = faces.astype(np.int64)
    if len(points) == 0:
        return np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros((0, 3))
    _, face, nearest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), vertices, faces
    )
    a, b, c = (np.ascontiguousarray(vertices[faces[face, k]]) for k in range(3))
    weight = np.clip(igl.barycentric_coordinates(nearest, a, b, c), 0.0, 1.0)
    return nearest, face, weight / weight.sum(axis=1, keepdims=True)


def _require_same_place(registration: Registration, patient: TetMesh) -> None:
    """Raise RegistrationError unless the patient's surface runs along the registered one."""
    mesh = registration.mesh
    on_surface = patient.vertices[patient.surface_vertices]
    nearest, _, _ = _closest(mesh.vertices, mesh.boundary_faces, on_surface)
    mean = float(np.linalg.norm(nearest - on_surface, axis=1).mean())
    if not mean <= 0.5 * patient.mean_surface_edge:
        raise RegistrationError(
            f"the patient's mesh lies {mean * 1e3:.3g} mm off the registered template; pass the "
            "mesh of the surface that was registered to"
        )
