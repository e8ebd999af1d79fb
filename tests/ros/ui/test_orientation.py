"""Left is left on the planning page, for every way in which a surface may state its axes."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from avatar_core.geometry.surface import read_surface
from avatar_ros.ui.view.orientation import (
    AXES,
    FOV,
    NAMES,
    Pose,
    basis,
    cube,
    label_places,
    scale_bar,
    seen_letters,
    standard_view,
)
from tests.helpers.small_files import ball

# directions of a file's axes, as a rotation from RAS
TURNS = {
    "RAS": np.diag([1.0, 1.0, 1.0]),
    "LPS": np.diag([-1.0, -1.0, 1.0]),
    "SRA": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}


NO_TIPS = np.zeros((0, 3))


def lopsided() -> tuple[np.ndarray, np.ndarray]:
    """Return a ball with a bump at the patient's right, RAS [mm]."""
    points, faces = ball(500, 50.0)
    bump = np.exp(-((points - [50.0, 0.0, 0.0]) ** 2).sum(axis=1) / 15.0**2)
    return points * (1.0 + 0.6 * bump[:, None]), faces


@pytest.mark.parametrize("axes", TURNS)
def test_the_letter_r_stands_at_the_patients_right(tmp_path: Path, axes: str) -> None:
    points, faces = lopsided()
    file = tmp_path / "liver.obj"
    meshio.write_points_cells(file, points @ TURNS[axes].T, {"triangle": faces})
    organ = read_surface(file, unit="mm", axes=axes)
    places = label_places(organ.vertices)
    bump = organ.vertices[np.argmax(np.linalg.norm(organ.vertices, axis=1))]
    nearest = min(places, key=lambda letter: float(np.linalg.norm(places[letter] - bump)))
    assert nearest == "R"


@pytest.mark.parametrize("side", AXES)
def test_a_standard_view_comes_from_its_side(side: str) -> None:
    pose = standard_view(side, np.array([0.1, 0.2, 0.3]), 0.2)
    right, up, towards = basis(pose)
    assert towards @ AXES[side] > 0.99
    on_right = {"A": "L", "P": "R", "R": "A", "L": "P", "S": "R", "I": "L"}
    on_top = {"S": "A", "I": "A"}.get(side, "S")
    assert right @ AXES[on_right[side]] > 0.99
    assert up @ AXES[on_top] > 0.99
    assert f'data-facing="{NAMES[side]}"' in cube(pose)


def in_picture(pose: Pose, point: np.ndarray) -> np.ndarray:
    """Return where a point is, relative to the height of the picture."""
    right, up, towards = basis(pose)
    depth = (pose.position - point) @ towards
    return np.array([point @ right, point @ up]) / (2.0 * np.tan(0.5 * FOV) * depth)


def seen_from(
    pose: Pose, vertices: np.ndarray, tips: np.ndarray = NO_TIPS, aspect: float = 1.0
) -> dict[str, np.ndarray]:
    """Return drawn letters, with their places in the picture relative to its height."""
    middle = scale_bar(pose, FOV, float(np.ptp(vertices, axis=0).max()))[1].mean(axis=0)
    seen = {"scale": middle} | seen_letters(vertices, pose, FOV, middle, tips, aspect)
    return {letter: in_picture(pose, place) for letter, place in seen.items()}


@pytest.mark.parametrize("side", AXES)
def test_a_standard_view_has_the_letters_of_its_four_sides(side: str) -> None:
    vertices = 1e-3 * lopsided()[0]
    found = seen_from(standard_view(side, vertices.mean(axis=0), 0.13), vertices)
    along = {"A", "P"} if side in "AP" else {"R", "L"} if side in "RL" else {"S", "I"}
    assert set(found) == {"scale"} | set(AXES) - along


@pytest.mark.parametrize("aspect", [0.6, 0.8, 1.0, 1.6])
@pytest.mark.parametrize("side", AXES)
def test_the_letters_of_a_narrow_picture_are_not_cut(side: str, aspect: float) -> None:
    """A long organ; if a tool takes its place, a letter may be missing."""
    vertices = 1e-3 * ball(500, 50.0)[0] * [2.0, 1.6, 1.4]
    pose = standard_view(side, np.zeros(3), 0.2, aspect)
    half = 0.025  # half the size of a letter
    tools = label_places(vertices)
    for tips in (NO_TIPS, *(place[None] for place in tools.values())):
        found = seen_from(pose, vertices, tips, aspect)
        assert len(found) == 5 or len(tips)
        assert max(np.abs(place[0]) for place in found.values()) < 0.5 * aspect - half
        assert max(np.abs(place[1]) for place in found.values()) < 0.5 - half


@pytest.mark.parametrize("turn", np.linspace(0.0, 345.0, 24))
@pytest.mark.parametrize("distance", [0.25, 0.4])
def test_letters_lie_over_nothing(turn: float, distance: float) -> None:
    vertices = 1e-3 * lopsided()[0]
    along, height = np.radians(turn), 0.3
    towards = np.array([np.cos(along), np.sin(along), height]) / np.hypot(1.0, height)
    pose = Pose(distance * towards, np.zeros(3), np.array(AXES["S"]))
    tips = label_places(vertices)["A"][None]  # where a letter would otherwise be
    found = seen_from(pose, vertices, tips)
    for letter in set(found) - {"scale"}:
        across, up = np.abs(found[letter] - in_picture(pose, tips[0]))
        assert across > 0.1 or up > 0.025
    places = list(found.values())
    for k, one in enumerate(places):
        assert all(np.abs(one - other).max() > 0.025 for other in places[:k])
    surface = np.array([in_picture(pose, point) for point in vertices])
    for letter in set(found) - {"scale"}:
        assert np.abs(surface - found[letter]).max(axis=1).min() > 0.025
    assert len(found) >= 4


def test_the_scale_is_as_long_as_it_says_in_the_plane_of_the_organs_middle() -> None:
    pose = standard_view("A", np.zeros(3), 0.2)
    length, ends = scale_bar(pose, FOV, 0.2)
    assert length == 0.05
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(length)
    towards = basis(pose)[2]
    np.testing.assert_allclose((ends - pose.look_at) @ towards, 0.0, atol=1e-12)
