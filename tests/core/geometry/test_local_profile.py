"""How shapes whose height is known in closed form fall away around a point."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from avatar_core.geometry.local_profile import OUTER, RADII, LocalProfile, local_profile
from avatar_core.geometry.offsets import Offsets, exact_offsets
from avatar_core.geometry.skin import Soup
from tests.helpers.known_surfaces import ball

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


def tube(radius: float) -> Soup:
    """The upper half of a tube along the y axis, its crest at the origin."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 241)
    ring = radius * np.stack([np.sin(angle), np.zeros(241), np.cos(angle) - 1.0], axis=1)
    half = np.array([0.0, 0.1, 0.0])
    corners = np.concatenate([ring - half, ring + half])
    k = np.arange(240)
    faces = [[k, k + 1, k + 241], [k + 1, k + 242, k + 241]]
    return corners, np.concatenate([np.stack(each, axis=1) for each in faces])


def from_surface(surface: Soup) -> Offsets:
    return partial(exact_offsets, surface)


def at_origin(surface: Soup) -> LocalProfile:
    return local_profile(from_surface(surface), np.zeros((1, 3)), Z[None])


def mean_heights(profile: LocalProfile) -> np.ndarray:
    """kappa r^2 / 2 + tau r^3 / 6 on the circles, shape (n, radii) [m]."""
    curvature, growth = profile.curvature[:, None], profile.growth[:, None]
    return curvature * RADII**2 / 2.0 + growth * RADII**3 / 6.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_ball_is_all_curvature_from_outside_and_from_inside(side: float) -> None:
    surface = ball(RADIUS, level=5)
    points = surface.vertices[surface.faces[::97]].mean(axis=1)
    normals = side * points / np.linalg.norm(points, axis=1, keepdims=True)
    profile = local_profile(from_surface((surface.vertices, surface.faces)), points, normals)
    expected = np.tile(side * RADII**2 / (2.0 * RADIUS), (len(points), 1))
    np.testing.assert_allclose(mean_heights(profile), expected, rtol=0.05)
    assert profile.anisotropy.max() < (0.05 / RADIUS) ** 2


def test_a_plane_has_no_shape() -> None:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3)) * [1, 1, 0]
    profile = local_profile(from_surface(roof(0.0)), points, np.tile(Z, (50, 1)))
    assert abs(mean_heights(profile)).max() < 1e-12
    assert profile.anisotropy.max() < 1e-12


def test_a_tube_is_bent_one_way() -> None:
    """Its principal curvatures are 1 / R and 0: mean and half their difference are 1 / (2 R)."""
    radius = 20e-3
    profile = at_origin(tube(radius))
    assert profile.curvature[0] == pytest.approx(0.5 / radius, rel=0.05)
    assert np.sqrt(profile.anisotropy[0]) == pytest.approx(0.5 / radius, rel=0.05)


@pytest.mark.parametrize("degrees", [5.0, 15.0, 30.0])
def test_a_ridge_falls_off_in_proportion_to_the_radius(degrees: float) -> None:
    """|x| tan(a) on a circle: mean (2 / pi) r tan(a), variance r^2 tan(a)^2 (1/2 - 4 / pi^2)."""
    angle = np.radians(degrees)
    mean = 2.0 / np.pi * RADII * np.tan(angle)
    spread = (8.0 * (0.5 - 4.0 / np.pi**2) * np.tan(angle) ** 2 / RADII[OUTER] ** 2).mean()
    for turn in (0.0, 0.3, 1.0):
        profile = at_origin(roof(angle, turn))
        assert profile.growth[0] < 0.0
        np.testing.assert_allclose(mean_heights(profile)[0, 1:], mean[1:], rtol=0.25)
        assert profile.anisotropy[0] == pytest.approx(spread, rel=0.2)  # of seven directions


def test_a_valley_is_concave() -> None:
    convex, concave = at_origin(roof(np.radians(15.0))), at_origin(roof(-np.radians(15.0)))
    np.testing.assert_allclose(mean_heights(concave), -mean_heights(convex), rtol=0.05)
    np.testing.assert_allclose(concave.anisotropy, convex.anisotropy, rtol=0.1)


def test_a_ridge_beside_the_point_does_not_lift_the_plane() -> None:
    """5 mm from the ridge, on one of its sides, the surface is flat out to there."""
    angle = np.radians(15.0)
    point = 5e-3 * np.array([[np.cos(angle), 0.0, -np.sin(angle)]])
    normal = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    height = mean_heights(local_profile(from_surface(roof(angle)), point, normal))[0]
    assert abs(height[:3]).max() < 0.02 * RADII[2] * np.tan(angle)


def test_a_wall_counts_no_more_than_a_slope_of_45_degrees() -> None:
    """Beside another lobe the profile stays within what a tip can follow."""
    profile = at_origin(roof(np.radians(-85.0)))
    assert (abs(mean_heights(profile)[0]) < RADII).all()
    assert (mean_heights(profile)[0] < 0.0).all()
