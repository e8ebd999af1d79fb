"""Displays beside the mesh: a finer surface, and structures that move with the organ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest

from avatar_core.errors import SurfaceError
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.resampling import is_manifold, resampled, unified
from avatar_core.geometry.skin import signed_volume
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.reduction.block_field import TOLERANCE
from avatar_core.vademecum.display import boundary, display_of, structure
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.helpers.box_organ import UP, organ, top
from tests.helpers.contact import prepare
from tests.helpers.shown_dent import ASIDE, DEPTH, SPHERE, displaced, finer
from tests.helpers.small_files import ball


def lesion_at(centre: np.ndarray, radius: float) -> SurfaceMesh:
    points, faces = ball(360, radius)
    return SurfaceMesh(centre + points, faces, "lesion")


@pytest.mark.parametrize("n", [300, 1500, 9000])
def test_a_surface_gets_about_so_many_vertices_and_stays_itself(n: int) -> None:
    vertices, faces = unified(*phantom_liver().skin.boundary)
    fine, triangles = resampled(vertices, faces, n)
    assert abs(len(fine) - n) <= 0.02 * n
    assert is_manifold(triangles) and len(triangles) == 2 * len(fine) - 4  # one closed sphere
    off = 1e3 * np.sqrt(igl.point_mesh_squared_distance(fine, vertices, faces)[0])
    print(f"{off.max():.2f} mm off, rms {np.sqrt((off**2).mean()):.2f}")
    assert off.max() < 3.0 and np.sqrt((off**2).mean()) < 0.7
    normals = igl.per_face_normals(fine, triangles, np.zeros(3))
    middle = fine[triangles].mean(axis=1)
    assert (phantom_liver().skin.contains(middle - 5e-3 * normals)).mean() > 0.98


def bends(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the angle between triangles at an edge, rms over the edges' length [degrees]."""
    normals = igl.per_face_normals(vertices, faces, np.zeros(3))
    beside, _ = igl.triangle_triangle_adjacency(faces)
    angles = np.arccos(np.clip((normals[:, None] * normals[beside]).sum(axis=2), -1.0, 1.0))
    length = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, -1, axis=1)], axis=2)
    return float(np.degrees(np.sqrt((length * angles**2).sum() / length.sum())))


def radius_of(volume: float) -> float:
    """Return the radius of a ball [m]."""
    return float(np.cbrt(volume / (4.0 / 3.0 * np.pi)))


@pytest.mark.parametrize("n", [60, 360, 9000])
def test_a_ball_stays_a_ball_of_its_volume_without_facets(n: int) -> None:
    """n corners stand out from the ball of their volume by about 4 pi / (3 sqrt(3) n) of R."""
    radius = 9e-3
    corners, coarse = ball(n, radius)
    vertices, faces = structure(SurfaceMesh(corners, coarse, "lesion"))
    assert 2000 <= len(vertices) <= 4000
    volume = signed_volume(corners, coarse)
    assert signed_volume(vertices, faces) == pytest.approx(volume, rel=5e-3)
    away = np.linalg.norm(vertices, axis=1) - radius_of(volume)
    assert np.abs(away).max() < radius * 4.0 * np.pi / (3.0 * np.sqrt(3.0) * n) + 1e-5
    assert bends(vertices, faces) < 4.0  # 18 at 60 corners, 7 at 360


def test_open_triangles_are_no_manifold() -> None:
    vertices, faces = unified(*phantom_liver().skin.boundary)
    assert is_manifold(faces) and not is_manifold(faces[1:])
    assert not is_manifold(np.concatenate([faces, faces[:1]]))
    fine, triangles = resampled(vertices, faces[1:], 3 * len(vertices))
    assert len(fine) >= 3 * len(vertices) and len(triangles) % (len(faces) - 1) == 0


def test_what_is_tied_moves_with_a_linear_field() -> None:
    """A linear displacement is interpolated exactly, on the boundary."""
    display = finer(organ("cube"), 1).display
    assert display is not None
    points, stretch = organ("cube").mesh.vertices, np.random.default_rng(1).normal(size=(3, 3))
    moved = (points @ stretch)[display.corners]
    np.testing.assert_allclose(
        np.einsum("vk,vkd->vd", display.weights, moved), display.vertices @ stretch, atol=1e-7
    )
    np.testing.assert_allclose(display.weights.sum(axis=1), 1.0, atol=1e-6)
    assert display.weights.min() >= 0.0


def test_the_meshs_own_vertices_are_shown_as_without() -> None:
    own = organ("cube")
    hung = replace(own, display=display_of(own.mesh, boundary(own.mesh)))
    for aside in ASIDE:
        place = top("cube") + np.array([aside[0], 0.0, aside[1]])
        clouds = [
            displaced(prepare(v, (SPHERE,), effects=()), (SPHERE,), place[None], UP[None], DEPTH)
            for v in (own, hung)
        ]
        np.testing.assert_allclose(clouds[1], clouds[0], atol=2e-7)
    np.testing.assert_array_equal(hung.clamped_faces, own.clamped_faces)


def test_a_patch_is_shown_by_interpolation_alone() -> None:
    tip = Tip("patch", SPHERE.radius)
    coarse, fine = organ("cube"), finer(organ("cube"))
    assert fine.display is not None
    at = (top("cube")[None], UP[None], DEPTH)
    cloud, shown = (displaced(prepare(v, (tip,), effects=()), (tip,), *at) for v in (coarse, fine))
    index = np.searchsorted(coarse.mesh.surface_vertices, fine.display.corners)
    exact = np.einsum("vk,vkd->vd", fine.display.weights, cloud[index])
    np.testing.assert_allclose(shown, exact, atol=1e-7)
    assert np.abs(exact).max() > 1e-4


def test_the_volume_shows_the_mesh() -> None:
    fine = finer(organ("cube"))
    assert len(prepare(fine, cloud="volume").out.cloud) == len(fine.mesh.vertices)
    assert len(prepare(fine).out.cloud) == len(fine.surface_vertices) > len(fine.mesh.vertices)
    assert fine.info().n_surface_vertices == len(fine.mesh.surface_vertices)


def test_a_structure_moves_with_the_organ() -> None:
    """Between the vertices of the mesh it moves as the volume; the organ's part is unchanged."""
    cube, lesion = organ("cube"), lesion_at(top("cube") + np.array([2e-3, -12e-3, 1e-3]), 8e-3)
    display = display_of(cube.mesh, boundary(cube.mesh), [("lesion", structure(lesion))])
    with_lesion = replace(cube, display=display)
    tip = Tip("patch", SPHERE.radius)  # the modes hold its field as a whole
    at = (top("cube")[None], UP[None], DEPTH)
    cloud = displaced(prepare(with_lesion, (tip,), effects=()), (tip,), *at)
    n, volume = len(cube.surface_vertices), prepare(cube, (tip,), cloud="volume", effects=())
    whole = displaced(volume, (tip,), *at)
    inside = np.unique(with_lesion.structures["lesion"])
    np.testing.assert_array_equal(inside, np.arange(n, len(cloud)))
    exact = np.einsum("vk,vkd->vd", display.weights[inside], whole[display.corners[inside]])
    alike = 4.0 * TOLERANCE * DEPTH  # surface and volume have blocks of their own
    np.testing.assert_allclose(cloud[inside], exact, atol=alike)
    np.testing.assert_allclose(cloud[:n], whole[cube.mesh.surface_vertices], atol=alike)
    rest = np.einsum("vk,vkd->vd", display.weights, cube.mesh.vertices[display.corners])
    np.testing.assert_allclose(rest, display.vertices, atol=1e-6)
    moved = np.linalg.norm(cloud[inside], axis=1)
    assert 0.2 * DEPTH < moved.mean() < 0.8 * DEPTH and np.ptp(moved) > 0.1 * DEPTH
    assert len(with_lesion.organ_faces) == len(cube.surface_faces)


def test_a_structure_with_too_many_vertices_is_thinned() -> None:
    lesion = lesion_at(np.zeros(3), 0.02)
    fine = SurfaceMesh(*igl.upsample(lesion.vertices, lesion.faces.astype(np.int64), 3))
    assert len(fine.vertices) > 4000 >= len(structure(fine)[0]) > 3900


@pytest.mark.long
def test_a_tumour_is_stored_with_its_organ_and_stays_there(tmp_path: Path) -> None:
    liver = phantom_liver(12e-3)
    lesion = lesion_at(liver.vertices.mean(axis=0) + np.array([0.0, 0.03, 0.0]), 0.02)
    options = OrganOptions(
        n_displayed=0,
        n_vertices=450,
        rule=BuildRule(max_modes=20),
        tumour=lesion,
        contrast=5.0,
        n_certified=2,
    )
    save_vademecum(build(liver, options), tmp_path / "sick.h5")
    sick = load_vademecum(tmp_path / "sick.h5")
    assert list(sick.structures) == ["lesion"]
    used = sick.surface_vertices[np.unique(sick.structures["lesion"])]
    away = np.linalg.norm(used - lesion.vertices.mean(axis=0), axis=1)
    assert away == pytest.approx(radius_of(lesion.volume), abs=1e-4)
    assert len(sick.organ_faces) == len(sick.mesh.boundary_faces)


@pytest.mark.parametrize("n", [1, -5, 99, 2_000_000])
def test_absurd_numbers_are_refused_before_any_work(n: int) -> None:
    with pytest.raises(SurfaceError, match="displayed vertices; ask for"):
        OrganOptions(n_displayed=n)
