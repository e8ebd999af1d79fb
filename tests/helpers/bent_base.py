"""A base of bent phantoms with their responses, and a patient outside it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar_core.atlas.base import PatientBase
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.patch_loads import load_surface, patch_loads
from avatar_core.geometry.mesh import TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.reduction.galerkin import compact_response
from avatar_core.shapes.registration import (
    Registration,
    RegistrationQuality,
    SimilarityTransform,
    Template,
)
from tests.helpers.disk_cache import cached_on_disk

N_BASE = 5


def bent_phantoms() -> tuple[PatientBase, SurfaceMesh, Registration]:
    """Return the base, the patient's surface, and the template registered to that surface."""
    organ = phantom_liver(0.012)
    template = Template.of(organ, 300)
    mesh = template.mesh
    loads = load_surface(mesh, template.regions)
    maps = population(N_BASE + 1, seed=3, bend=0.01)
    vertices = np.array([shape(mesh.vertices) for shape in maps])
    names = tuple(f"phantom-{i}" for i in range(N_BASE))
    base = PatientBase(template, loads, Material(), names, vertices[:-1], _responses())
    surface = replace(maps[-1].moved(organ), name="patient")
    return base, surface, registration_of(template, vertices[-1])


def registration_of(template: Template, vertices: np.ndarray) -> Registration:
    """Return a registration that places the template's vertices there, without a quality."""
    still = SimilarityTransform(1.0, np.eye(3), np.zeros(3))
    quality = RegistrationQuality(0.0, 0.0, 0.0, 0.0, 1.0, 0.0, None)  # type: ignore[arg-type]
    mesh = TetMesh(vertices, template.mesh.tets)
    return Registration(template, mesh, still, quality, (), True)


@cached_on_disk
def _responses() -> list[CompactResponse]:
    """Compute the responses of the base's anatomies."""
    mesh = tetrahedralize(phantom_liver(0.012), 300)
    regions = regions_by_rule(mesh)
    loads, responses = load_surface(mesh, regions), []
    for shape in population(N_BASE + 1, seed=3, bend=0.01)[:-1]:
        elasticity = Elasticity(
            TetMesh(shape(mesh.vertices), mesh.tets), Material(), regions.clamped
        )
        patches = patch_loads(elasticity, shape(loads.centers), loads.patch_radius)
        responses.append(compact_response(elasticity, patches, 40))
    return responses


@cached_on_disk
def patient_mesh() -> TetMesh:
    """Mesh the patient's surface independently of the template."""
    surface = population(N_BASE + 1, seed=3, bend=0.01)[-1].moved(phantom_liver(0.012))
    return tetrahedralize(surface, 350)
