"""Coarse phantoms over Poisson's ratio and a tumour's contrast, a support, and a resection."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.fem import patch_loads
from avatar_core.geometry.cut_surface import CutSurface
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.rule import BuildRule
from avatar_core.offline.supports import SupportOption
from avatar_core.pipeline import OrganOptions, build
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.vademecum.model import Vademecum
from tests.helpers.disk_cache import cached_on_disk

POISSON = Coordinate("poisson", 0.30, 0.49, 2)
CONTRAST = Coordinate("contrast", 0.5, 10.0, 3)


def ball(center: np.ndarray, radius: float) -> SurfaceMesh:
    """Mesh a sphere: an octahedron whose faces were divided three times."""
    points = [
        np.array(p, float)
        for p in [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    ]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    corners = np.array([[points[i] for i in face] for face in faces])
    for _ in range(3):
        a, b, c = corners.transpose(1, 0, 2)
        ab, bc, ca = (
            (p + q) / np.linalg.norm(p + q, axis=1)[:, None] for p, q in ((a, b), (b, c), (c, a))
        )
        corners = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    vertices, index = np.unique(corners.reshape(-1, 3).round(12), axis=0, return_inverse=True)
    return SurfaceMesh(center + radius * vertices, index.reshape(-1, 3).astype(np.int32), "tumour")


def soft_tumour() -> SurfaceMesh:
    return ball(phantom_liver(12e-3).vertices.mean(axis=0) + np.array([0.0, 0.03, 0.0]), 0.02)


@cached_on_disk
def soft_organ() -> Vademecum:
    options = OrganOptions(
        n_displayed=0,
        n_vertices=450,
        rule=BuildRule(max_modes=60),
        coordinates=(POISSON, CONTRAST),
        tumour=soft_tumour(),
        n_certified=16,
    )
    return build(phantom_liver(12e-3), options)


@cached_on_disk
def organ_on_springs() -> Vademecum:
    """Build over the stiffness of the bare area, the only support; loads at vertices alone."""
    options = OrganOptions(
        n_displayed=0,
        n_vertices=450,
        rule=BuildRule(max_modes=60),
        supports=(SupportOption.parse("bare_area=1e5:1e9:3"),),
        n_certified=8,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(patch_loads, "MIDPOINTS_FROM", 1.0)
        return build(phantom_liver(12e-3), options)


@cached_on_disk
def cut_organ() -> Vademecum:
    """Build over a cut beside a tumour, from the front 90 % of the way back; loads at vertices."""
    x, y, z = map(float, phantom_liver(12e-3).vertices.mean(axis=0))
    options = OrganOptions(
        n_vertices=450,
        rule=BuildRule(max_modes=60),
        resection=CutSurface((0.0, -1.0, 0.0), (x + 0.03, y, z), (1.0, 0.0, 0.0), part=0.9),
        tumour=soft_tumour(),
        n_certified=8,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(patch_loads, "MIDPOINTS_FROM", 1.0)
        return build(phantom_liver(12e-3), options)
