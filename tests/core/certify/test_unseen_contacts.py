"""Sampling of contacts that no build has seen."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from avatar_core.certify.unseen_contacts import draw_contacts
from avatar_core.errors import ConvergenceError
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.vademecum.tip_field import TipField

RADIUS = 0.03  # radius of the ball [m]
LOBE = np.array([0.0, 0.0, 0.052]), 0.012  # a lobe over its pole: centre and radius [m]


def organ(*lobes: tuple[np.ndarray, float]) -> Any:
    """Return the upper half of a ball with lobes, as far as contacts are drawn from it."""
    from tests.helpers.known_surfaces import ball

    surface = ball(RADIUS)
    upper = surface.faces[surface.vertices[surface.faces][:, :, 2].min(axis=1) > 0.0]
    n = len(surface.vertices)
    axis = np.linspace(-0.07, 0.07, 71)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    parts = ((np.zeros(3), RADIUS), *lobes)
    distance = np.min([np.linalg.norm(points - c, axis=-1) - r for c, r in parts], axis=0)
    place = (axis[[0, 0, 0]], axis[1:2] - axis[0])
    field = TipField(distance, np.ones_like(distance), *place)
    normals = surface.vertices / RADIUS
    loads = LoadSurface(surface.vertices, normals, upper, np.arange(n), 0.012)
    return SimpleNamespace(surface=loads, tip_field=field)


def test_a_contact_can_be_reached_along_its_normal() -> None:
    contacts = draw_contacts(organ(LOBE), 2000, seed=3)
    np.testing.assert_allclose(np.linalg.norm(contacts.normal, axis=1), 1.0)
    for height in np.linspace(2e-3, 14e-3, 13):
        place = contacts.tip + height * contacts.normal
        assert np.linalg.norm(place, axis=1).min() > RADIUS
        assert np.linalg.norm(place - LOBE[0], axis=1).min() > LOBE[1] - 1e-3  # between samples


def test_an_organ_without_a_place_to_touch_is_refused() -> None:
    closed = organ()
    closed.tip_field = closed.tip_field._replace(access=0.0 * closed.tip_field.access)
    with pytest.raises(ConvergenceError, match="0 of 5 tips found a place"):
        draw_contacts(closed, 5, seed=0)
