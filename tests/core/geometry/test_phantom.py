"""The built-in liver: closed, liver-sized, liver-shaped, evenly triangulated, always the same."""

from __future__ import annotations

import time

import igl
import numpy as np
import pytest

from avatar_core.errors import SurfaceError
from avatar_core.geometry.phantom import (
    VISCERAL_NORMAL,
    Ellipsoid,
    liver_level_set,
    phantom_liver,
    project,
    smooth_union,
)
from avatar_core.geometry.surface import (
    keep_organ,
    read_surface,
    require_closed,
    require_plausible_size,
)


def test_phantom_passes_its_own_front_door(phantom, tmp_path):
    assert keep_organ(phantom) is phantom
    assert require_closed(phantom) is phantom
    require_plausible_size(phantom)
    path = tmp_path / "phantom.obj"
    igl.writeOBJ(str(path), 1e3 * phantom.vertices, phantom.faces.astype(np.int64))
    again = read_surface(path)
    assert again.notices == ()
    assert again.volume == pytest.approx(phantom.volume)


def test_phantom_is_one_closed_sphere_like_surface(phantom):
    assert phantom.is_watertight
    assert igl.euler_characteristic(phantom.faces.astype(np.int64)) == 2  # no handle, one piece


def test_phantom_has_the_size_of_a_liver(phantom):
    assert phantom.volume == pytest.approx(1.5e-3, rel=0.02)
    assert np.all(np.abs(phantom.extent - [0.20, 0.155, 0.14]) < 0.01)


def test_right_lobe_is_the_large_one_and_the_left_lobe_tapers(phantom):
    rng = np.random.default_rng(0)
    points = rng.uniform(*phantom.bounding_box, (40_000, 3))
    inside = points[phantom.skin.signed_distance(points) < 0]
    areas = [np.sum(np.abs(inside[:, 0] - x) < 0.01) for x in (0.03, -0.05, -0.09)]
    assert areas[0] > 2 * areas[1] > 4 * areas[2]
    right, left = inside[inside[:, 0] > 0.02], inside[inside[:, 0] < -0.06]
    assert left[:, 2].mean() > right[:, 2].mean()  # the left lobe lies higher
    assert left[:, 1].mean() > right[:, 1].mean()  # and further forward


def test_visceral_face_is_flat_and_the_dome_is_not(phantom):
    corners = phantom.vertices[phantom.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    direction = np.array(VISCERAL_NORMAL) / np.linalg.norm(VISCERAL_NORMAL)
    along = normals @ direction / areas

    def share(cosine):
        return areas[cosine > np.cos(np.radians(5))].sum() / areas.sum()

    assert share(along) > 0.10
    assert share(-along) < 0.02


def test_notch_parts_the_lobes_at_the_inferior_border(phantom):
    across = np.array([[-0.053, 0.056, 0.005], [-0.039, 0.056, 0.005], [-0.016, 0.056, 0.005]])
    left, between, right = phantom.skin.signed_distance(across)
    assert left < -0.003
    assert right < -0.003
    assert between > 0.003


def test_triangulation_is_even_and_on_the_level_set(phantom):
    edges = phantom.vertices[phantom.faces] - phantom.vertices[phantom.faces[:, [1, 2, 0]]]
    lengths = np.linalg.norm(edges, axis=2)
    assert lengths.mean() == pytest.approx(6e-3, rel=0.1)
    assert 2000 < len(phantom.faces) < 8000
    angles = np.degrees(igl.internal_angles(phantom.vertices, phantom.faces.astype(np.int64)))
    assert angles.min() > 15
    assert np.abs(liver_level_set(phantom.vertices)).max() < 1e-5


def test_phantom_is_always_the_same_and_fast(phantom):
    start = time.process_time()
    again = phantom_liver()
    assert time.process_time() - start < 1.0
    assert np.array_equal(again.vertices, phantom.vertices)
    assert np.array_equal(again.faces, phantom.faces)


def test_spacing_sets_the_edge_and_keeps_the_organ(phantom):
    fine = phantom_liver(spacing=5e-3)
    assert fine.is_watertight
    assert fine.mean_edge == pytest.approx(phantom.mean_edge * 5 / 7, rel=0.1)
    assert fine.volume == pytest.approx(phantom.volume, rel=0.02)


@pytest.mark.parametrize("spacing", [0.0, -1.0, 1e-4, 7.0, float("nan")])
def test_senseless_spacing_is_refused(spacing):
    with pytest.raises(SurfaceError, match="choose"):
        phantom_liver(spacing=spacing)


def test_smooth_union_is_the_minimum_away_from_the_seam_and_smooth_on_it():
    a = np.linspace(-1, 1, 2001)
    union = smooth_union(a, -a, width=0.5)
    far = np.abs(a) > 0.25
    assert np.array_equal(union[far], np.minimum(a, -a)[far])
    assert np.max(np.abs(np.diff(union, 2))) < 2.01 * np.diff(a)[0] ** 2 / 0.5  # bounded curvature
    assert union.max() == pytest.approx(-0.125)


def test_projection_lands_on_the_zero_surface():
    sphere = Ellipsoid((0, 0, 0), (0.05, 0.07, 0.09))
    start = 1.1 * np.array(sphere.radii) * np.eye(3)
    assert np.abs(sphere(project(start, sphere))).max() < 1e-6
