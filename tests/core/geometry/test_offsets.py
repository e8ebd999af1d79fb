"""Interpolated offsets from a surface, against offsets computed point by point."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.geometry import offsets
from avatar_core.geometry.offsets import MARGIN, SPACING, OffsetGrid, exact_offsets
from avatar_core.geometry.skin import Soup
from tests.helpers.known_surfaces import ball

RADIUS = 30e-3  # radius of the ball [m]
LAYER = 8e-3  # above and below its surface [m]


@pytest.fixture(scope="module")
def soup() -> Soup:
    surface = ball(RADIUS)
    return surface.vertices, surface.faces


def directions(n: int) -> np.ndarray:
    out = np.random.default_rng(0).standard_normal((n, 3))
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def layer(n: int) -> np.ndarray:
    depth = np.random.default_rng(1).uniform(-LAYER, LAYER, (n, 1))
    return directions(n) * (RADIUS + depth)


def test_the_way_off_a_ball_is_its_distance(soup):
    """Linear interpolation errs by h^2/8 times the second derivative along each axis, 1/r here."""
    points = layer(4000)
    radius = np.linalg.norm(points, axis=1)
    out = points / radius[:, None]
    facets = np.abs((exact_offsets(soup, points) * out).sum(axis=1) - (radius - RADIUS)).max()
    bound = 3.0 * SPACING**2 / 8.0 / (RADIUS - LAYER) + facets
    found = (OffsetGrid(soup)(points) * out).sum(axis=1)
    assert np.abs(found - (radius - RADIUS)).max() < bound < 0.05e-3


def test_offsets_beside_a_plane_are_exact():
    corners = [[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]]
    plane = (np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))
    points = np.random.default_rng(2).uniform(-0.02, 0.02, (500, 3))
    found = OffsetGrid(plane)(points)
    assert found == pytest.approx(points * [0.0, 0.0, 1.0], abs=1e-8)  # float32 of 20 mm


def test_each_grid_point_is_found_once(soup, monkeypatch):
    asked: list[np.ndarray] = []

    def counted(surface: Soup, points: np.ndarray) -> np.ndarray:
        asked.append(points)
        return exact_offsets(surface, points)

    monkeypatch.setattr(offsets, "exact_offsets", counted)
    grid = OffsetGrid(soup)
    first = grid(layer(4000))
    assert np.array_equal(grid(layer(4000)), first)
    assert len(asked) == 1
    assert len(np.unique(np.round(asked[0] / SPACING).astype(int), axis=0)) == len(asked[0])


def test_points_off_the_grid_count_as_at_its_border(soup):
    grid = OffsetGrid(soup)
    border = np.array([[RADIUS + MARGIN, 0.0, 0.0]])
    assert grid(border * 5.0) == pytest.approx(grid(border), abs=2e-3)
