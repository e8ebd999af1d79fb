"""How shapes whose height is known in closed form fall away around a point."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.geometry.local_profile import RADII, local_profile
from avatar_core.geometry.skin import Soup
from tests.hard.surfaces import ball

RADIUS = 30e-3  # of the ball [m]
Z = np.array([0.0, 0.0, 1.0])


def roof(angle: float, turn: float = 0.0) -> Soup:
    """Two half planes that fall off from the y axis, turned about z."""
    z = -0.1 * np.tan(angle)
    corner = np.array(
        [[0, -0.1, 0], [0, 0.1, 0], [0.1, -0.1, z], [0.1, 0.1, z], [-0.1, -0.1, z], [-0.1, 0.1, z]]
    )
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return corner @ rotation.T, np.array([[0, 2, 3], [0, 3, 1], [0, 1, 5], [0, 5, 4]])


def test_a_ball_is_all_curvature() -> None:
    surface = ball(RADIUS, level=5)
    corners = surface.vertices[surface.faces[::97]]
    points = corners.mean(axis=1)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    kappa, beta = local_profile((surface.vertices, surface.faces), points, normals)
    np.testing.assert_allclose(kappa, 1.0 / RADIUS, rtol=0.05)
    assert beta.max() < 1e-3


def test_a_hollow_is_curved_the_other_way() -> None:
    surface = ball(RADIUS, level=5)
    points = surface.vertices[surface.faces[::97]].mean(axis=1)
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    kappa, beta = local_profile((surface.vertices, surface.faces), points, normals)
    np.testing.assert_allclose(kappa, -1.0 / RADIUS, rtol=0.05)
    assert beta.max() < 5e-3


def test_a_plane_has_neither() -> None:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3)) * [1, 1, 0]
    kappa, beta = local_profile(roof(0.0), points, np.tile(Z, (50, 1)))
    assert abs(kappa).max() < 1e-9
    assert abs(beta).max() < 1e-12


@pytest.mark.parametrize("degrees", [5.0, 15.0, 30.0])
def test_a_ridge_falls_off_in_proportion_to_the_radius(degrees: float) -> None:
    """Averaged over a circle across it, |x| tan(a) is (2 / pi) r tan(a)."""
    angle = np.radians(degrees)
    for turn in (0.0, 0.3, 1.0):
        kappa, beta = local_profile(roof(angle, turn), np.zeros((1, 3)), Z[None])
        assert beta[0] == pytest.approx(2.0 / np.pi * np.tan(angle), rel=0.03)
        assert abs(kappa[0]) * RADII[-1] / 2.0 < 0.03 * beta[0]


def test_a_valley_has_no_ridge() -> None:
    angle = np.radians(15.0)
    kappa, beta = local_profile(roof(-angle), np.zeros((1, 3)), Z[None])
    assert beta[0] == 0.0
    assert kappa[0] < 0.0


def test_a_ridge_beside_the_point_does_not_lift_the_plane() -> None:
    """5 mm from the ridge, on one of its sides, the surface is flat out to there."""
    angle = np.radians(15.0)
    point = 5e-3 * np.array([[np.cos(angle), 0.0, -np.sin(angle)]])
    normal = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    kappa, beta = local_profile(roof(angle), point, normal)
    assert beta[0] == 0.0
    assert 0.0 <= kappa[0] < 1.0 / 0.1


def test_a_wall_counts_no_more_than_a_slope_of_45_degrees() -> None:
    """Beside another lobe the profile stays within what a tip can follow."""
    wall = roof(np.radians(-85.0))
    kappa, beta = local_profile(wall, np.zeros((1, 3)), Z[None])
    assert beta[0] == 0.0
    assert -2.0 / RADII[0] < kappa[0] < 0.0
