"""The elastic problem of a patient: an own mesh, held and loaded where the template is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.atlas.base import PatientBase
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import LoadSurface, load_surface, patch_normals
from avatar_core.fem.supports import Support
from avatar_core.geometry.attachments import attachments_by_rule
from avatar_core.geometry.groups import faces_of_groups, regions_of_groups
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.point_location import closest_points
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.supports import SupportOption, held_at
from avatar_core.shapes.correspondence import carry_faces, carry_regions, registered_positions
from avatar_core.shapes.registration import Registration

MISSED = 3e-3  # distance from a mesh, of parts that it does not reach [m]


@dataclass(frozen=True, eq=False)
class PatientProblem:
    """A patient's own mesh, with clamp and load positions transferred from the template.

    Attributes
    ----------
    surface : SurfaceMesh
        Surface of the patient.
    registration : Registration
        Registration of the template to it.
    mesh, regions, loads, elasticity : TetMesh, Regions, LoadSurface, Elasticity
        Mesh and problem of the patient.
    notices : tuple[str, ...]
        Doubts about the organ, one line each.
    """

    surface: SurfaceMesh
    registration: Registration
    mesh: TetMesh
    regions: Regions
    loads: LoadSurface
    elasticity: Elasticity
    notices: tuple[str, ...] = ()

    @property
    def outline(self) -> SurfaceMesh | None:
        """Surface that tools touch; None for the boundary of a registered template.

        The registered template lies beside the surface.
        """
        return None if self.mesh is self.registration.mesh else self.surface


def patient_problem(
    surface: SurfaceMesh,
    base: PatientBase,
    registration: Registration,
    mesh: TetMesh,
    groups: Mapping[str, np.ndarray] | None = None,
    supports: Sequence[SupportOption] = (),
) -> PatientProblem:
    """Transfer clamp or supports, accessible region and patch radius to a patient's mesh.

    Parameters
    ----------
    groups : Mapping[str, ndarray] or None
        Points of the clamp, the accessible region and supports, in place of the template's
        (:mod:`avatar_core.geometry.groups`). Without supports, both regions are needed.
    supports : Sequence[SupportOption]
        Supports that hold the organ instead of the clamp.

    Raises
    ------
    RegistrationError, MeshError, MaterialError
        If the mesh lies elsewhere, or is too coarse for the regions, supports or the patch.
    """
    springs: tuple[Support, ...] = ()
    if supports:
        places = template_places(registration, mesh) | faces_of_groups(mesh, groups or {})
        regions, springs = held_at(mesh, supports, places)
    elif groups is not None:
        regions = regions_of_groups(mesh, groups)
    else:
        regions = carry_regions(registration, mesh)
    loads = load_surface(mesh, regions, base.loads.patch_radius)
    elasticity = Elasticity(mesh, base.material, regions.clamped, supports=springs)
    return PatientProblem(surface, registration, mesh, regions, loads, elasticity)


def template_places(registration: Registration, mesh: TetMesh) -> dict[str, np.ndarray]:
    """Return the faces of a patient's mesh at the template's accessible region and attachments."""
    template = registration.template
    parts = attachments_by_rule(template.mesh) | {"accessible": template.regions.accessible}
    return carry_faces(registration, mesh, parts)


def template_problem(
    surface: SurfaceMesh, base: PatientBase, registration: Registration, member: int | None = None
) -> PatientProblem:
    """Return a patient on the registered template: without a mesh of its own.

    Responses combine node by node.

    Parameters
    ----------
    member : int or None
        Anatomy of the base that is the patient. Its response is on its own registered template,
        which is moved to the patient.
    """
    template, own = base.template, registration
    if member is not None:
        own = replace(registration, mesh=base.mesh_at(member, registration.mesh.centroid))
    loads = replace(base.loads, centers=registered_positions(own, base.loads))
    loads = replace(loads, normals=patch_normals(own.mesh, loads.centers, loads.patch_radius))
    elasticity = Elasticity(own.mesh, base.material, template.regions.clamped)
    return PatientProblem(surface, own, own.mesh, template.regions, loads, elasticity)


def distances_to_mesh(problem: PatientProblem) -> np.ndarray:
    """Return distances of the vertices of the patient's surface from the mesh, shape (n,) [m]."""
    points = problem.surface.vertices
    closest, _, _ = closest_points(problem.mesh.vertices, problem.mesh.boundary_faces, points)
    return np.asarray(np.linalg.norm(points - closest, axis=1))


def missed(problem: PatientProblem) -> tuple[float, np.ndarray]:
    """Return the largest distance of the patient's surface to the mesh [m], and its place (3,)."""
    distance = distances_to_mesh(problem)
    worst = int(np.argmax(distance))
    return float(distance[worst]), problem.surface.vertices[worst]


def missed_part(problem: PatientProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices [m] and faces of the surface with a corner ``MISSED`` off the mesh."""
    faces = problem.surface.faces
    far = faces[(distances_to_mesh(problem) > MISSED)[faces].any(axis=1)]
    used, local = np.unique(far, return_inverse=True)
    return problem.surface.vertices[used], local.reshape(-1, 3)


def said_of_missed(problem: PatientProblem) -> str:
    """Return a line with the distance of a registered template from the patient."""
    far, (x, y, z) = missed(problem)
    return (
        f"interpolated on a registered template, which is up to {1e3 * far:.1f} mm off the surface "
        f"of the organ, at ({x:.3f}, {y:.3f}, {z:.3f}) m; choose reduced for the organ's own mesh"
    )
