"""The surface that is drawn around a tip, against Sneddon's, and where it ends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from avatar_core.contact.effects import SeveralTools
from avatar_core.contact.fine_surface import FineSurface, find_touch, fine_surface
from avatar_core.geometry.tip import Tip
from avatar_core.tips.law import dent
from avatar_core.vademecum.model import Vademecum
from tests.helpers.box_organ import UP, organ, top
from tests.helpers.contact import prepare
from tests.helpers.shown_dent import DEPTH, END, SPHERE, sneddon_dent
from tests.helpers.tool_motion import press

ASIDE = ((0.0, 0.0), (3e-3, 2e-3), (6e-3, 0.0), (-9e-3, 7e-3))  # of the middle [m]


def place(aside: tuple[float, float]) -> np.ndarray:
    return np.asarray(top("cube") + np.array([aside[0], 0.0, aside[1]]))


def pose(aside: tuple[float, float], tip: Tip = SPHERE) -> np.ndarray:
    return place(aside) + (tip.offset - DEPTH) * UP


@pytest.fixture(scope="module")
def cube() -> Vademecum:
    return organ("cube")


@pytest.fixture(scope="module")
def clouds(cube: Vademecum) -> list[np.ndarray]:
    """Under the sphere at each of the places."""
    data, found = prepare(cube, (SPHERE,), effects=()), []
    for aside in ASIDE:
        press(data, (SPHERE,), place(aside)[None], UP[None], DEPTH)
        found.append(data.out.cloud.copy())
    return found


def at_rest(shown: FineSurface) -> np.ndarray:
    return shown.positions - shown.displacements


def test_between_the_points_of_a_cloud_the_dent_is_sneddons(
    cube: Vademecum, clouds: list[np.ndarray]
) -> None:
    """And those points stay where they are."""
    errors = []
    for aside, cloud in zip(ASIDE, clouds, strict=True):
        shown = fine_surface(cube, cloud, [SPHERE], pose(aside)[None])
        np.testing.assert_array_equal(shown.positions[: len(cloud)], cloud[:, :3])
        np.testing.assert_array_equal(shown.displacements[: len(cloud)], cloud[:, 3:])
        rest = at_rest(shown)
        distance = np.linalg.norm(rest - place(aside), axis=1)
        near = np.flatnonzero((distance < END) & (np.abs(rest[:, 1] - place(aside)[1]) < 1e-6))
        assert len(near) > 10 * np.sum(near < len(cloud))
        errors.append(-shown.displacements[near, 1] - sneddon_dent(distance[near]))
    found = np.concatenate(errors)
    rms, worst = np.sqrt((found**2).mean()), np.abs(found).max()
    print(f"rms {1e3 * rms:.3f} mm, worst {1e3 * worst:.3f} mm at {len(found)} vertices")
    assert rms < 0.04e-3 and worst < 0.15e-3


def test_the_fine_triangles_are_the_coarse_ones(cube: Vademecum, clouds: list[np.ndarray]) -> None:
    """Sixteen for each near the dent, facing the same way, and without gaps along their rim."""
    shown = fine_surface(cube, clouds[1], [SPHERE], pose(ASIDE[1])[None])
    rest, faces = at_rest(shown), cube.surface_faces
    area, coarse = vector_area(rest, shown.faces), vector_area(cube.surface_vertices, faces)
    size, coarse_size = (np.linalg.norm(each, axis=1).sum() for each in (area, coarse))
    assert size == pytest.approx(coarse_size, rel=1e-5)
    np.testing.assert_allclose(area.sum(axis=0), 0.0, atol=1e-6 * size)
    near = np.linalg.norm(cube.surface_vertices - place(ASIDE[1]), axis=1) < END
    split = near[faces].any(axis=1)
    assert len(shown.faces) == np.sum(~split) + 16 * split.sum()
    inner, outer = ({*map(tuple, edges_of(faces[part]).tolist())} for part in (split, ~split))
    rim = np.array(sorted(inner & outer))
    middle = cube.surface_vertices[rim].mean(axis=1)
    away, number = cKDTree(rest[len(near) :]).query(middle)
    assert len(rim) > 8 and away.max() < 1e-6
    gap = shown.displacements[len(near) + number] - shown.displacements[rim].mean(axis=1)
    assert np.abs(gap).max() < 1e-7


def edges_of(faces: np.ndarray) -> np.ndarray:
    return np.asarray(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2))


def vector_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = vertices[faces.T]
    return np.asarray(0.5 * np.cross(b - a, c - a))


@pytest.mark.parametrize("tip", [SPHERE, Tip("flat", 4e-3), Tip("cone", 8e-3, 60.0)])
def test_the_dent_of_a_cloud_is_found_again(cube: Vademecum, tip: Tip) -> None:
    data = prepare(cube, (tip,), effects=())
    press(data, (tip,), place(ASIDE[1])[None], UP[None], DEPTH)
    touch = find_touch(cube, tip, pose(ASIDE[1], tip))
    assert touch is not None
    delta, _, _, a = dent(data.model.arrays, data.state, 0)
    assert touch.radius == pytest.approx(a, rel=0.01)
    assert touch.wall + tip.depth(np.array(touch.radius)) == pytest.approx(delta, rel=0.01)
    np.testing.assert_allclose(touch.point, data.state.point[0], atol=1e-6)


def test_two_dents_are_both_drawn(cube: Vademecum) -> None:
    """Far from one another, each as if it were alone; those between them meet in the cloud."""
    far = ((-20e-3, 0.0), (20e-3, 0.0))
    data = prepare(cube, (SPHERE, SPHERE), effects=(SeveralTools(),))
    press(data, (SPHERE, SPHERE), np.array([*map(place, far)]), np.array([UP, UP]), DEPTH)
    cloud, poses = data.out.cloud, np.array([*map(pose, far)])
    both = fine_surface(cube, cloud, [SPHERE, SPHERE], poses)
    for k, aside in enumerate(far):
        one = fine_surface(cube, cloud, [SPHERE], poses[[k]])
        found = []
        for shown in (one, both):
            rest = at_rest(shown)[len(cloud) :]
            near = np.linalg.norm(rest - place(aside), axis=1) < 0.5 * END
            order = np.lexsort(np.round(rest[near], 9).T)
            found.append(shown.displacements[len(cloud) :][near][order])
        assert len(found[0]) > 10
        np.testing.assert_allclose(found[1], found[0], atol=1e-6)  # of a dent of 1e-3


def test_an_organ_that_breathes_carries_its_dent_along(
    cube: Vademecum, clouds: list[np.ndarray]
) -> None:
    breath = np.array([1e-3, -2e-3, 12e-3])
    moved = clouds[1] + np.pad(breath, (0, 3)).astype(np.float32)
    still = fine_surface(cube, clouds[1], [SPHERE], pose(ASIDE[1])[None])
    shown = fine_surface(cube, moved, [SPHERE], (pose(ASIDE[1]) + breath)[None])
    np.testing.assert_allclose(shown.positions, still.positions + breath, atol=1e-6)
    np.testing.assert_allclose(shown.displacements, still.displacements, atol=1e-6)


@pytest.mark.parametrize(
    ("tip", "height"), [(SPHERE, 1e-3), (Tip("patch", 3e-3), -DEPTH), (SPHERE, 1.0)]
)
def test_without_a_dent_the_triangles_are_the_meshs(
    cube: Vademecum, clouds: list[np.ndarray], tip: Tip, height: float
) -> None:
    """Above the surface, under a patch, and far away."""
    shown = fine_surface(
        cube, clouds[1], [tip], (place(ASIDE[1]) + (tip.offset + height) * UP)[None]
    )
    np.testing.assert_array_equal(shown.faces, cube.surface_faces)
    np.testing.assert_array_equal(shown.positions, clouds[1][:, :3])
