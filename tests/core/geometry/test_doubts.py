"""Doubts about an organ: its size, holes, a second body on a bridge, a lesion out of place."""

from __future__ import annotations

import re

import numpy as np
import pytest

from avatar_core.errors import SurfaceError
from avatar_core.geometry.doubts import doubts_of
from avatar_core.geometry.level_set import DistanceGrid, isosurface
from avatar_core.geometry.surface import SurfaceMesh
from tests.helpers.known_surfaces import ball, with_hole

LIVER = ball(0.065, level=3)  # 1,150 ml


def test_a_liver_of_its_size_is_not_doubted() -> None:
    assert doubts_of(LIVER) == ()


def test_an_organ_of_another_size_needs_its_own_clamp() -> None:
    (notice,) = doubts_of(ball(0.035, level=3))
    assert "180 ml" in notice and "700 to 3,500 ml" in notice and "--groups" in notice
    assert doubts_of(ball(0.035, level=3), has_groups=True) == ()
    assert "4,189 ml" in doubts_of(ball(0.1, level=3))[0]


@pytest.mark.parametrize(
    ("place", "words"),
    [(0.03, "inside: 100%"), (0.06, "inside: 75%, reaching 8 mm out"), (0.09, None)],
)
def test_how_much_of_a_lesion_lies_inside_is_said(place: float, words: str | None) -> None:
    lesion = ball(0.013, (0.0, 0.0, place), level=3)
    if words is None:
        with pytest.raises(SurfaceError, match=r"0% of the lesion \(9.2 ml\).* 38 mm out; check"):
            doubts_of(LIVER, [lesion])
        return
    (notice,) = doubts_of(LIVER, [lesion])
    assert notice == f"lesion surface: 9.2 ml, {words}"


@pytest.mark.parametrize(("width", "is_said"), [(0.007, True), (0.02, False)])
def test_a_body_on_a_thin_bridge_is_said(width: float, is_said: bool) -> None:
    """A ball of 80 ml, 30 mm beside the organ, and a bar of square section between them."""
    spacing = 2.5e-3
    shape = (100, 60, 60)
    origin = np.array([-0.075, -0.075, -0.075])
    axes = [o + spacing * np.arange(n) for o, n in zip(origin, shape, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    away = np.sqrt(y**2 + z**2)
    organ = np.sqrt(x**2 + away**2) - 0.065
    second = np.sqrt((x - 0.122) ** 2 + away**2) - 0.0267
    bar = np.maximum(np.maximum(abs(y), abs(z)) - width / 2, abs(x - 0.08) - 0.04)
    values = np.minimum(np.minimum(organ, second), bar)
    surface: SurfaceMesh = isosurface(DistanceGrid(tuple(origin), spacing, values))
    found = [notice for notice in doubts_of(surface) if "hangs on the rest" in notice]
    assert len(found) == is_said


def test_a_hole_that_was_closed_is_said_and_a_missing_triangle_is_not() -> None:
    pole = np.array([0.0, 0.0, 0.065])
    (notice,) = doubts_of(with_hole(LIVER, pole, 0.04))
    found = re.fullmatch(r"a hole of (.*)% of the surface at \((.*)\) mm was closed flat.*", notice)
    assert found and 3.0 < float(found[1]) < 4.5
    x, y, z = map(float, found[2].split(","))
    assert abs(x) < 4.0 and abs(y) < 4.0 and 57.0 < z < 65.0
    small = SurfaceMesh(LIVER.vertices, LIVER.faces[1:])
    assert not small.is_watertight and doubts_of(small) == ()
