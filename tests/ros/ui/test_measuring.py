"""Lengths, depths, gaps and margins of the planning page, on bodies with known answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from avatar_core.geometry.tip import Tip
from avatar_ros.ui.measure.measures import PLANE, TOOL, Measures, Now
from avatar_ros.ui.measure.measures_view import MeasuresView
from avatar_ros.ui.session.presets import material_text
from avatar_ros.ui.view.measuring import Place, depth, gap, hit, is_plane, margin
from avatar_ros.ui.view.organ import Organ
from tests.helpers.box_organ import UP
from tests.helpers.small_files import ball
from tests.ros.helpers.page import Noted

RADIUS = 0.05
POINTS, FACES = ball(2000, RADIUS)
FACETS = 4e-4  # largest distance between the ball and its facets [m]


def test_a_click_finds_the_near_side() -> None:
    for way in np.eye(3):
        place = hit(0.3 * way, -way, POINTS, FACES)
        assert place is not None
        np.testing.assert_allclose(place.at(POINTS), RADIUS * way, atol=FACETS)
        assert place.weights.sum() == pytest.approx(1.0)
    assert hit(np.array([0.3, 0, 0]), np.array([1.0, 0, 0]), POINTS, FACES) is None
    assert hit(np.array([0.3, 0.06, 0]), np.array([-1.0, 0, 0]), POINTS, FACES) is None


def test_a_place_moves_with_the_tissue() -> None:
    place = hit(np.array([0.3, 0, 0]), np.array([-1.0, 0, 0]), POINTS, FACES)
    assert isinstance(place, Place)
    moved = 1.1 * POINTS + [0.0, 0.0, 0.01]
    np.testing.assert_allclose(place.at(moved), 1.1 * place.at(POINTS) + [0, 0, 0.01], atol=1e-12)


def test_a_gap_is_the_shortest_way() -> None:
    body = np.array([[0.08, 0.0, 0.0], [0.0, 0.07, 0.0], [0.0, 0.0, 0.09]])
    found = gap(body, POINTS, FACES)
    assert found.length == pytest.approx(0.02, abs=FACETS)
    np.testing.assert_array_equal(found.begin, body[1])
    assert np.linalg.norm(found.end - found.begin) == pytest.approx(found.length)


@pytest.mark.parametrize("height", [0.06, 0.052, 0.047])
def test_a_depth_is_that_of_the_deepest_point(height: float) -> None:
    tip = np.array([0.0, height, 0.0]) + ball(200, 4e-3)[0]
    assert depth(tip, POINTS, FACES) == pytest.approx(RADIUS + 4e-3 - height, abs=FACETS)


def test_far_from_the_surface_there_is_no_depth() -> None:
    assert depth(np.array([[0.0, 0.3, 0.0]]), POINTS, FACES) == -np.inf


@pytest.mark.parametrize(("height", "expected"), [(0.06, 0.01), (-0.07, 0.02), (0.045, -0.005)])
def test_a_margin_is_that_of_the_plane_and_negative_if_it_cuts(
    height: float, expected: float
) -> None:
    plane = np.array([[0.0, 0.0, height], [0.1, 0.0, height], [0.0, 0.1, height]])
    assert margin(plane, POINTS) == pytest.approx(expected, abs=FACETS)
    assert margin(plane[::-1], POINTS) == pytest.approx(expected, abs=FACETS)


def test_a_lesion_without_a_contrast_is_called_as_stiff_as_the_organ(cube: Organ) -> None:
    sick = replace(cube, structures={"lesion": cube.faces})
    assert "as stiff" in material_text(sick, {"young": 8e3})
    assert "as stiff" not in material_text(cube, {"young": 8e3})
    assert "as stiff" not in material_text(sick, {"young": 8e3, "contrast": 3.0})
    built = replace(sick, vademecum=replace(cube.vademecum, contrast=4.0))
    assert "tumour 4 x E" in material_text(built, {"young": 8e3})


def test_three_points_on_a_line_are_no_plane() -> None:
    assert not is_plane(np.outer([0.0, 1.0, 2.0], [0.01, 0.0, 0.0]))
    assert not is_plane(np.zeros((3, 3)))
    assert is_plane(0.05 * np.eye(3))


# --- Places -----------------------------------------------------------------------------------

CORNERS = np.array([[0.05, 0.2, 0.05], [0.15, 0.2, 0.05], [0.1, 0.2, 0.15]])


def test_the_way_to_a_cut_is_said_at_rest_and_now(
    cube: Organ, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The margin at rest is found once, that of now from the points that are drawn."""
    asked: list[Any] = []

    def margins(vademecum: Any, points: Any = None) -> dict[str, float]:
        asked.append(points)
        return {"lesion": 0.010 if points is None else 0.007}

    monkeypatch.setattr("avatar_ros.ui.measure.measures.margins", margins)
    measures = Measures(Noted())  # type: ignore[arg-type]
    measures.show_organ(cube, Tip())
    for _ in range(2):
        lines = measures.lines(Now(cube.vertices, cube.vertices[0], 1e3))
    assert "Cut to lesion: 10.0 mm at rest, 7.0 mm now" in lines
    assert [points is None for points in asked] == [True, False, False]


def test_a_dot_of_a_plane_is_dragged_over_the_organ(cube: Organ) -> None:
    view, surface = Noted(), (cube.vertices, cube.faces)
    measures = Measures(view)  # type: ignore[arg-type]
    measures.show_organ(cube, Tip())
    assert measures.mode == TOOL
    measures.mode = PLANE
    for corner in CORNERS:
        place = hit(corner + 0.3 * UP, -UP, *surface)
        assert place is not None
        measures.click(place, cube.vertices)
    first = 3  # first of the plane's dots

    def placed() -> np.ndarray:
        return np.array([place.at(cube.vertices) for place in measures._places[PLANE]])

    np.testing.assert_allclose(placed(), CORNERS, atol=1e-6)
    measures.drag(first + 1, np.array([0.18, 0.5, 0.08]), -UP, *surface)
    moved = np.array([CORNERS[0], [0.18, 0.2, 0.08], CORNERS[2]])
    np.testing.assert_allclose(placed(), moved, atol=1e-6)
    measures.drag(first + 1, np.array([0.5, 0.5, 0.5]), -UP, *surface)  # beside the organ
    measures.drag(first + 1, 0.5 * (CORNERS[0] + CORNERS[2]) + UP, -UP, *surface)  # on a line
    measures.drag(0, CORNERS[0] + UP, -UP, *surface)  # no probe was placed
    np.testing.assert_allclose(placed(), moved, atol=1e-6)


def test_the_ray_to_a_dragged_dot_begins_at_the_camera(server: Any) -> None:
    dragged: list[Any] = []
    view = MeasuresView(server, lambda *given: dragged.append(given))
    (binding,) = view._dots[4]._impl.drag_cb
    event = Noted()
    event.client, event.end_position = Noted(), (0.0, 0.0, 1.0)  # type: ignore[attr-defined]
    event.client.camera = Noted()  # type: ignore[attr-defined]
    event.client.camera.position = (0.0, 2.0, 1.0)  # type: ignore[attr-defined]
    binding.callback(event)
    ((dot, origin, way),) = dragged
    assert dot == 4
    np.testing.assert_array_equal([origin, way], [[0.0, 2.0, 1.0], [0.0, -2.0, 0.0]])
