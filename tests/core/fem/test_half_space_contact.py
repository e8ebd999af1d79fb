"""Balls on half-spaces whose surface is bent, against Sneddon's and Hertz's closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from avatar_core.fem.half_space_contact import loads_on_heights, ring_radii, sector_angles
from avatar_core.fem.signorini import half_space_radius
from avatar_core.geometry.tip import Tip

WINDOW = 1.8  # relative to the radius of the contact on a plane


def on_heights(radius: float, depth: float, window: float, height: np.ndarray) -> float:
    """Return F / E* on a ball over a surface ``height`` below the plane, (RINGS, SECTORS)."""
    under = Tip("sphere", radius).height(window * ring_radii()) - depth
    return float(loads_on_heights(under[None], np.array([window]), height[None])[0])


def load(radius: float, depth: float, kappa_x: float = 0.0, kappa_y: float = 0.0) -> float:
    """Return F / E* on a ball over a surface that falls as kappa_x x^2 / 2 + kappa_y y^2 / 2."""
    window = min(WINDOW * half_space_radius(Tip("sphere", radius), depth), 0.999 * radius)
    r, theta = window * ring_radii()[:, None], sector_angles()
    height = 0.5 * r**2 * (kappa_x * np.cos(theta) ** 2 + kappa_y * np.sin(theta) ** 2)
    return on_heights(radius, depth, window, height)


@pytest.mark.parametrize("radius", [1.5e-3, 10e-3])
@pytest.mark.parametrize("part", [0.1, 0.3, 0.8])
def test_a_plane_is_sneddons(radius: float, part: float) -> None:
    depth = part * radius
    a = half_space_radius(Tip("sphere", radius), depth)
    exact = 0.5 * (a * a + radius**2) * np.log((radius + a) / (radius - a)) - a * radius
    assert load(radius, depth) == pytest.approx(exact, rel=0.015)


@pytest.mark.parametrize("tip", [Tip("flat", 3e-3), Tip("cone", 8e-3, 60.0)])
def test_any_tip_on_a_plane_is_sneddons(tip: Tip) -> None:
    depth, a = 2e-3, min(half_space_radius(tip, 2e-3), tip.radius)
    exact = 2.0 * a * depth if tip.shape == "flat" else a * depth
    window = min(WINDOW * a, 0.999 * tip.radius)
    under = tip.height(window * ring_radii()) - depth
    plane = np.zeros((1, len(ring_radii()), len(sector_angles())))
    found = loads_on_heights(under[None], np.array([window]), plane)[0]
    assert found == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize("kappa", [-50.0, 50.0, 200.0])
def test_a_ball_on_a_ball_is_hertzs(kappa: float) -> None:
    radius, depth = 5e-3, 0.1e-3
    exact = 4.0 / 3.0 * np.sqrt(depth**3 / (1.0 / radius + kappa))
    assert load(radius, depth, kappa, kappa) == pytest.approx(exact, rel=0.03)


def test_a_ball_on_a_ridge_touches_over_hertzs_ellipse() -> None:
    """Curvatures 1/R along the ridge and 3/R across it (Johnson 1985, Sec. 4.2)."""
    radius, depth = 5e-3, 0.1e-3
    long, across = 1.0 / radius, 3.0 / radius

    def ratio(e: float) -> float:
        k, q = ellipk(e * e), ellipe(e * e)
        return float((q / (1.0 - e * e) - k) / (k - q)) - across / long

    e = brentq(ratio, 1e-3, 1.0 - 1e-9)
    k, q = ellipk(e * e), ellipe(e * e)
    # p0 a / E* by either curvature: depth = p0 b K / E*, A = p0 b (K - E) / (E* e^2 a^2)
    scale = depth / k
    a = np.sqrt(2.0 * scale * (k - q) / (e * e * long))
    b = a * np.sqrt(1.0 - e * e)
    exact = 2.0 / 3.0 * np.pi * a * b * scale / b
    assert load(radius, depth, 0.0, 2.0 / radius) == pytest.approx(exact, rel=0.03)


def test_the_tilt_of_a_plane_turns_the_force() -> None:
    """Across a plane tilted by 10 degrees, the depth shrinks by the cosine."""
    radius, depth, tilt = 5e-3, 1e-3, np.radians(10.0)
    window = 2.2 * half_space_radius(Tip("sphere", radius), depth)
    height = np.tan(tilt) * window * ring_radii()[:, None] * np.cos(sector_angles())
    tilted = on_heights(radius, depth, window, height)
    left = (depth - radius) * np.cos(tilt) + radius
    assert tilted == pytest.approx(load(radius, left), rel=0.04)


def test_no_balls_no_loads() -> None:
    assert loads_on_heights(np.empty((0, 8)), np.empty(0), np.empty((0, 8, 8))).shape == (0,)


def test_no_overlap_no_load() -> None:
    assert load(5e-3, 1e-3, 3e3, 3e3) > 0.0
    height = np.full((len(ring_radii()), len(sector_angles())), 2e-3)
    assert on_heights(5e-3, 1e-3, 1e-3, height) == 0.0
