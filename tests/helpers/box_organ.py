"""Boxes clamped below and pressed around the middle of their top: exact solutions are near.

A cube of 200 mm acts as a half-space under a tip. A column of half its width also gives way as a
whole. Near the load their meshes are as coarse as a liver's, with the usual element and patch.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.patch_loads import load_surface, patch_loads
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.refinement import Grading, refine
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.rule import BuildRule
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Provenance
from avatar_core.vademecum.tip_field import make_tip_field
from tests.core.conftest import box_mesh, box_regions
from tests.helpers.disk_cache import cached_on_disk

Body = Literal["cube", "column"]

HEIGHT = 0.2  # [m]
WIDTH: dict[Body, float] = {"cube": 0.2, "column": 0.1}  # [m]
UP = np.array([0.0, 1.0, 0.0])
MATERIAL = Material()
MODULUS = MATERIAL.young_modulus / (1.0 - MATERIAL.poisson_ratio**2)  # E* [Pa]
PATCH_RADIUS = 12e-3  # [m]
FINE = 3e-3  # elements on which a patch sinks as on finer ones, to 0.1 % [m]
_COARSE = 12e-3  # longest edge around the middle of the top [m]
_PRESSED = 30e-3  # radius of the accessible part [m]


def top(body: Body) -> np.ndarray:
    """Return the middle of the top, shape (3,) [m]."""
    return np.array([0.5 * WIDTH[body], HEIGHT, 0.5 * WIDTH[body]])


def body_mesh(
    body: Body, edge: float = _COARSE, radius: float = 1.5 * _PRESSED
) -> tuple[TetMesh, Regions]:
    """Mesh a box: edges up to ``edge`` within a radius of the top's middle, longer elsewhere."""
    mesh = box_mesh(8, (WIDTH[body], HEIGHT, WIDTH[body]))
    return refine(mesh, box_regions(mesh), [Grading(top(body), UP, edge, radius, 0.0, 0.5)])


@cached_on_disk
def organ(body: Body) -> Vademecum:
    """Build a vademecum with few modes: at load positions the response is exact with any number."""
    mesh, regions = body_mesh(body)
    offset = mesh.vertices[mesh.boundary_faces].mean(axis=1) - top(body)
    near = np.linalg.norm(offset, axis=1) < _PRESSED
    regions = Regions(regions.clamped, regions.accessible & near)
    return build_vademecum(
        body,
        Elasticity(mesh, MATERIAL, regions.clamped),
        regions,
        load_surface(mesh, regions, PATCH_RADIUS),
        make_tip_field(mesh, regions, PATCH_RADIUS),
        BuildRule(),
        Provenance(body, ""),
    )


@cached_on_disk
def patch_compliance(body: Body) -> float:
    """Return the sinking of a patch at the middle per unit force, on fine elements [m/N]."""
    mesh, regions = body_mesh(body, FINE, PATCH_RADIUS)
    elasticity = Elasticity(mesh, MATERIAL, regions.clamped)
    load = patch_loads(elasticity, top(body)[None], PATCH_RADIUS)[:, [1]]
    return float((load.T @ elasticity.solve(load))[0, 0])
