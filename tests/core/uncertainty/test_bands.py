"""Bands of force and displacement: their target, one single output, and refused input."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from avatar_core.contact.tool_path import starts_apart
from avatar_core.errors import AvatarError, ContactError, CoordinateError
from avatar_core.geometry.point_location import closest_points
from avatar_core.uncertainty.bands import force_bands
from avatar_core.uncertainty.distributions import (
    Distribution,
    Fixed,
    Lognormal,
    LogUniform,
    Uniform,
)
from avatar_core.vademecum.model import Vademecum
from tests.helpers.soft_organ import organ_on_springs

pytestmark = pytest.mark.long  # it builds an organ

YOUNG = {"young": Lognormal(5e3, 1.5)}


@pytest.fixture(scope="module")
def point(phantom_vademecum: Vademecum) -> np.ndarray:
    return phantom_vademecum.surface.centers[starts_apart(phantom_vademecum, 1)[0]]


def test_one_parameter_has_all_variance_of_one_force(
    phantom_vademecum: Vademecum, point: np.ndarray
) -> None:
    bands = force_bands(phantom_vademecum, YOUNG, [point], [3e-3])
    assert bands.force.shape == (3, 1, 1)
    assert bands.shares["young"].tolist() == [[1.0]]


def test_a_target_moves_as_the_field_between_the_vertices(
    phantom_vademecum: Vademecum, point: np.ndarray
) -> None:
    v = phantom_vademecum
    corners = v.mesh.tets[len(v.mesh.tets) // 2]
    inside = v.mesh.vertices[corners].mean(axis=0)
    bands = force_bands(v, {"young": Fixed(5e3)}, [point], [3e-3], target=inside)
    place = starts_apart(v, 1)
    by_axis = v.displacement(np.array(place), np.ones(1)).reshape(-1, 3, 3)[corners].mean(axis=0)
    moved = np.linalg.norm(by_axis @ v.surface.normals[place[0]])
    stiffer = v.material.young_modulus / 5e3
    np.testing.assert_allclose(bands.moved, stiffer * moved * bands.force, rtol=1e-6)


def test_a_target_off_the_organ_is_refused(phantom_vademecum: Vademecum, point: np.ndarray) -> None:
    """A corner of the organ's box is no point of the organ."""
    v = phantom_vademecum
    corner = v.mesh.vertices.max(axis=0)
    feet, _, _ = closest_points(v.mesh.vertices, v.mesh.boundary_faces, corner[None])
    off = 1e3 * np.linalg.norm(feet[0] - corner)
    assert off > 5.0
    with pytest.raises(ContactError, match=f"lies {off:.0f} mm outside the organ; give a point"):
        force_bands(v, YOUNG, [point], [3e-3], target=corner)
    for target in ([0.0, 0.0], [0.0, math.nan, 0.0]):
        with pytest.raises(ContactError, match="give three finite numbers, in metres"):
            force_bands(v, YOUNG, [point], [3e-3], target=target)


@pytest.mark.parametrize(
    ("given", "kind", "reason"),
    [
        ({"depths": []}, ContactError, "give rising numbers above 0"),
        ({"depths": [math.nan]}, ContactError, "give rising numbers above 0"),
        ({"draws": 0}, AvatarError, "0 draws span no band; give 1 or more"),
        ({"seed": -1}, AvatarError, "the seed is -1; give 0 or more"),
    ],
)
def test_bands_of_no_depth_draw_or_seed_are_refused(
    phantom_vademecum: Vademecum,
    point: np.ndarray,
    given: dict[str, Any],
    kind: type[AvatarError],
    reason: str,
) -> None:
    with pytest.raises(kind, match=re.escape(reason)):
        force_bands(phantom_vademecum, YOUNG, [point], **{"depths": [3e-3], **given})


@pytest.mark.parametrize(
    "made",
    [
        lambda: Fixed(math.nan),
        lambda: Fixed(math.inf),
        lambda: Uniform(1e3, math.inf),
        lambda: LogUniform(1e3, math.inf),
        lambda: Lognormal(math.inf, 1.5),
    ],
)
def test_distributions_are_finite(made: Callable[[], Distribution]) -> None:
    with pytest.raises(CoordinateError, match=r"give .*(finite|LOW < HIGH)"):
        made()


def test_supports_out_of_the_built_range_are_said() -> None:
    """The range counts over Young's modulus: a soft organ on the softest springs stays in it."""
    organ = organ_on_springs()
    young, point = organ.material.young_modulus, organ.surface.centers[starts_apart(organ, 1)[0]]
    uncertain = {"young": Lognormal(young, 2.0), "support.bare_area": Fixed(1e5)}
    (notice,) = force_bands(organ, uncertain, [point], [3e-3]).notices
    assert "support.bare_area over young lies outside the" in notice
    assert "in 50% of the draws" in notice and "wider --support bare_area=LOW:HIGH" in notice
    inside = {**uncertain, "support.bare_area": Fixed(1e7)}
    assert force_bands(organ, inside, [point], [3e-3]).notices == ()
