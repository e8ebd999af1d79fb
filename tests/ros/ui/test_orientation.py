"""Left is left on the planning page, for every way in which a surface may state its axes."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest
from avatar_ros.ui.orientation import (
    AXES,
    FOV,
    NAMES,
    basis,
    cube,
    label_places,
    scale_bar,
    standard_view,
)

from avatar_core.geometry.surface import read_surface
from tests.helpers.small_files import ball

# Where the axes of a file point, as a rotation from RAS.
TURNS = {
    "RAS": np.diag([1.0, 1.0, 1.0]),
    "LPS": np.diag([-1.0, -1.0, 1.0]),
    "SRA": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}


def lopsided() -> tuple[np.ndarray, np.ndarray]:
    """A ball with a bump at the patient's right, RAS [mm]."""
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


def test_the_scale_is_as_long_as_it_says_in_the_plane_of_the_organs_middle() -> None:
    pose = standard_view("A", np.zeros(3), 0.2)
    length, ends = scale_bar(pose, FOV, 0.2)
    assert length == 0.05
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(length)
    towards = basis(pose)[2]
    np.testing.assert_allclose((ends - pose.look_at) @ towards, 0.0, atol=1e-12)
