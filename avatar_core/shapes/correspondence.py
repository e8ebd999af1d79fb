"""Transfer from a registered template to a patient: clamp, load positions, fields on the mesh.

The registered template and the patient's own mesh fill the same organ. A point of one mesh has
barycentric coordinates l_k in the other. A point outside takes those of the closest point of the
surface:

    u_patient(x) = sum_k l_k(x) u_template,k

Fields are thus transferred by sparse matrices whose rows sum to one and reproduce affine fields.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import RegistrationError
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.geometry.mesh import Regions, TetMesh, without_islands
from avatar_core.geometry.point_location import barycentric_centroids, carriers, closest_points
from avatar_core.shapes.registration import Registration

_PIECES = 3  # a patient's face is split into 3^2 pieces, whose majority decides on its region


def carry_regions(registration: Registration, patient: TetMesh) -> Regions:
    """Return the clamped and accessible faces of the patient's mesh, from those of the template.

    Accessible faces that touch the clamp, and islands below 5 % of the accessible area, are dropped
    like by the anatomical rule. For parameters and errors see :func:`carry_faces`.
    RegistrationError is also raised if a region would be empty.
    """
    regions = registration.template.regions
    parts = {"clamped": regions.clamped, "accessible": regions.accessible}
    clamped, accessible = carry_faces(registration, patient, parts).values()
    faces = patient.boundary_faces
    accessible &= ~np.isin(faces, faces[clamped]).any(axis=1)
    accessible = without_islands(faces, patient.face_areas, accessible, least=0.05)
    if not (clamped.any() and accessible.any()):
        raise RegistrationError(
            "no face of the patient's mesh falls into the template's clamp or accessible region; "
            "use a finer patient mesh"
        )
    return Regions(clamped, accessible)


def carry_faces(
    registration: Registration, patient: TetMesh, parts: Mapping[str, NDArray[np.bool_]]
) -> dict[str, NDArray[np.bool_]]:
    """Return parts of the template's surface on the patient's mesh, by name, (n_faces,) each.

    Each piece of a patient's face takes the part of the closest registered face. The face takes the
    part of most of its pieces.

    Parameters
    ----------
    patient : TetMesh
        Mesh of the surface that was registered to.
    parts : Mapping[str, ndarray of bool]
        Masks over the template's boundary faces.

    Raises
    ------
    RegistrationError
        If the mesh does not lie on the registered template.
    """
    _require_same_place(registration, patient)
    faces = patient.boundary_faces
    centroids = barycentric_centroids(_PIECES)
    pieces = np.einsum("qk,fkd->fqd", centroids, patient.vertices[faces]).reshape(-1, 3)
    _, owner, _ = closest_points(
        registration.mesh.vertices, registration.mesh.boundary_faces, pieces
    )
    owner = owner.reshape(len(faces), -1)
    return {name: part[owner].mean(axis=1) > 0.5 for name, part in parts.items()}


def registered_positions(registration: Registration, loads: LoadSurface) -> FloatArray:
    """Return the template's load positions on the registered template.

    Vertices come first, then edge midpoints.

    Returns
    -------
    ndarray, shape (n_positions, 3)
        Positions [m].

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


def interpolation_matrix(mesh: TetMesh, points: FloatArray) -> sp.csr_matrix:
    """Return the matrix that interpolates nodal fields of a mesh at points.

    A point in a tetrahedron takes its barycentric coordinates, a point outside those of the closest
    point of the surface.

    Parameters
    ----------
    mesh : TetMesh
        Mesh of the field, e.g. the registered template.
    points : ndarray, shape (n, 3)
        Points [m], e.g. the vertices of the patient's own mesh.

    Returns
    -------
    sparse, shape (n, n_vertices)
        Matrix whose rows sum to one.
    """
    corners, weights = carriers(mesh, points)
    rows = np.repeat(np.arange(len(points)), 4)
    shape = (len(points), len(mesh.vertices))
    return sp.csr_matrix((weights.ravel(), (rows, corners.ravel())), shape=shape)


def load_map(registration: Registration, loads: LoadSurface, points: FloatArray) -> sp.csr_matrix:
    """Return interpolation from the template's load positions to points of the patient's surface.

    It uses the shape functions of the loads, at the closest point of the registered template's
    accessible faces.

    Parameters
    ----------
    loads : LoadSurface
        Load positions of the template's mesh and regions.
    points : ndarray, shape (n, 3)
        Points [m].

    Returns
    -------
    sparse, shape (n, n_positions)
        Matrix whose rows sum to one.

    Raises
    ------
    RegistrationError
        If the loads belong to another mesh or other regions.
    """
    positions = registered_positions(registration, loads)
    _, face, barycentric = closest_points(positions, loads.corners, points)
    columns, values = loads.weights(face, barycentric)
    rows = np.repeat(np.arange(len(points)), columns.shape[1])
    return sp.csr_matrix(
        (values.ravel(), (rows, columns.ravel())), shape=(len(points), len(positions))
    )


def _require_same_place(registration: Registration, patient: TetMesh) -> None:
    """Raise RegistrationError unless the patient's surface runs along the registered one."""
    mesh = registration.mesh
    on_surface = patient.vertices[patient.surface_vertices]
    nearest, _, _ = closest_points(mesh.vertices, mesh.boundary_faces, on_surface)
    mean = float(np.linalg.norm(nearest - on_surface, axis=1).mean())
    if not mean <= 0.5 * patient.mean_surface_edge:
        raise RegistrationError(
            f"the patient's mesh lies {mean * 1e3:.3g} mm off the registered template; pass the "
            "mesh of the surface that was registered to"
        )
