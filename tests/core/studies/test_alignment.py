"""Alignment of organs against known motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar_core.geometry.surface import read_surface
from avatar_core.studies.alignment import align, surface_points
from tests.helpers.known_surfaces import RADIUS, ball


def test_points_on_a_surface_are_spread_by_area():
    sphere = ball(level=5)
    half = sphere.vertices[sphere.faces].mean(axis=1)[:, 0] > 0
    corners = np.vstack([sphere.faces[half], sphere.faces[~half]])
    points = surface_points(replace(sphere, faces=corners), 1000)
    assert np.abs(points.mean(axis=0)).max() < 0.02 * RADIUS
    assert np.abs(np.mean(points[:, 0] > 0) - 0.5) < 2e-3


MOTIONS = [  # rotation vector [degrees], scale, translation [m]
    ((0, 0, 0), 1.0, (0.0, 0.0, 0.0)),
    ((20, -10, 5), 1.2, (0.05, -0.03, 0.08)),
    ((0, 180, 0), 0.8, (0.0, 0.1, 0.0)),
    ((-110, 40, 75), 1.1, (-0.2, 0.0, 0.1)),
    ((45, 45, 100), 0.9, (0.0, 0.0, 0.3)),
]


@pytest.mark.parametrize(
    ("name", "motion"),
    [
        *(("phantom", i) for i in (0, 1, 4)),
        ("LiTS-4", 3),
        *(
            pytest.param(name, i, marks=pytest.mark.long)
            for name, i in (("phantom", 2), ("phantom", 3), ("LiTS-4", 1), ("LiTS-60", 2))
        ),
    ],
)
def test_alignment_recovers_a_known_motion(request, phantom, name, motion):
    turn, scale, shift = MOTIONS[motion]
    surface = phantom
    if name != "phantom":
        surface = read_surface(request.getfixturevalue("livers_dir") / f"{name}.obj")
    rotation = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    moved = scale * surface.vertices @ rotation.T + shift
    found = align(surface, replace(surface, vertices=moved))
    between = Rotation.from_matrix(found.rotation @ rotation.T).magnitude()
    # the grids of 24 cells differ after a rotation: their interpolation error is 0.5 to 1 mm,
    # over 60 random motions of ten livers at most 0.06 degrees, 7e-4 and 0.26 mm
    assert np.degrees(between) < 0.15
    assert found.scale == pytest.approx(scale, rel=2e-3)
    assert np.abs(found.apply(surface.vertices) - moved).max() < 6e-4
    assert np.allclose(found.invert(found.apply(surface.vertices)), surface.vertices, atol=1e-12)
    assert found.residual < 1.5e-3


def test_rigid_alignment_leaves_the_size(phantom):
    rotation = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix()
    reference = replace(phantom, vertices=1.1 * phantom.vertices @ rotation.T)
    found = align(phantom, reference, scale=False)
    assert found.scale == 1.0
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.angle == pytest.approx(np.degrees(np.linalg.norm([0.3, 0.1, -0.2])), abs=1.0)
    assert found.residual > 2e-3  # a tenth of the size is left between them
