"""An organ's mesh, cut along a plane or a Bezier surface: sides, faces between them, bad input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_core.errors import MeshError
from avatar_core.geometry.cut_surface import CutSurface
from avatar_core.geometry.cutting import cut, snapped
from avatar_core.geometry.mesh import TetMesh, quality
from tests.helpers.elastic_shapes import box_mesh

PLANE: dict[str, Any] = {
    "point": [0.05, 0.05, 0.05],
    "normal": [1.0, 0.0, 0.0],
    "open_along": [0.0, 1.0, 0.0],
}


def plane_at(x: float, normal: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> CutSurface:
    return CutSurface((0.0, 1.0, 0.0), (x, 0.05, 0.05), normal)


def bezier(height: np.ndarray) -> CutSurface:
    """Return control points over a square of 0.1 m in y and z, at x = 0.05 + height (4, 4)."""
    along = np.linspace(0.0, 0.1, 4)
    y, z = np.meshgrid(along, along, indexing="ij")
    points = np.stack([0.05 + height, y, z], axis=2).reshape(16, 3)
    return CutSurface((0.0, 1.0, 0.0), bezier=tuple(map(tuple, points.tolist())))


def area_of(mesh: TetMesh, faces: np.ndarray) -> np.ndarray:
    a, b, c = (mesh.vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def test_a_box_in_halves_keeps_its_boundary_and_gets_two_faces_inside() -> None:
    whole, second = snapped(box_mesh(4), plane_at(0.05))
    mesh = cut(whole, second)
    np.testing.assert_array_equal(whole.vertices, box_mesh(4).vertices)  # they lie on the plane
    np.testing.assert_array_equal(mesh.joined[mesh.boundary_faces], whole.boundary_faces)
    np.testing.assert_array_equal(mesh.is_second_side, second)
    assert mesh.pieces.max() == 1
    assert mesh.tet_volumes[second].sum() == pytest.approx(mesh.volume / 2.0)
    one, other = (area_of(mesh, faces) for faces in mesh.cut_faces)
    np.testing.assert_allclose(one.sum(axis=0), [0.01, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(one, other, atol=1e-15)
    assert not np.intersect1d(*mesh.cut_faces).size
    np.testing.assert_array_equal(*mesh.vertices[mesh.cut_faces])


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (1.0, 0.3, -0.2)])
@pytest.mark.parametrize("x", [0.046, 0.06])
def test_vertices_move_onto_a_plane_between_them(
    x: float, normal: tuple[float, float, float]
) -> None:
    surface = plane_at(x, normal)
    mesh, second = snapped(box_mesh(6), surface)
    assert mesh.volume == pytest.approx(1e-3, rel=1e-4)  # only its edges have no tangent plane
    assert quality(mesh).min_dihedral > 5.0
    faces = cut(mesh, second).cut_faces[0]
    off = np.abs(surface.heights(mesh.vertices[np.unique(faces)]))
    assert off.mean() < 0.05 * 0.1 / 6.0  # relative to an edge
    expected = 1e-3 * (1.0 - x / 0.1)  # through the centre in y and z
    assert mesh.tet_volumes[second].sum() == pytest.approx(expected, rel=0.02)


def test_a_flat_bezier_surface_is_its_plane_also_beyond_its_edges() -> None:
    points = np.random.default_rng(0).uniform(-0.03, 0.13, (200, 3))
    flat, plane = bezier(np.zeros((4, 4))), plane_at(0.05)
    sign = np.sign(flat.mean_normal @ plane.mean_normal)
    np.testing.assert_allclose(flat.heights(points), sign * plane.heights(points), atol=1e-9)
    np.testing.assert_allclose(flat.offsets(points), plane.offsets(points), atol=1e-9)


def test_a_bezier_surface_interpolates_its_corners_and_has_their_tangents() -> None:
    height = np.zeros((4, 4))
    height[1:3, 1:3] = 0.02
    surface = bezier(height)
    corners = np.array(surface.bezier)[[0, 3, 12, 15]]
    np.testing.assert_allclose(surface.offsets(corners), 0.0, atol=1e-9)
    # at the middle both Bernstein sums of the inner points are 3/4
    middle = np.array([[0.05 + 0.02 * 0.75**2, 0.05, 0.05]])
    np.testing.assert_allclose(surface.offsets(middle), 0.0, atol=1e-5)
    mesh, second = snapped(box_mesh(6), surface)
    assert cut(mesh, second).pieces.max() == 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"normal": [0.0, 0.0, 0.0]}, "'normal' of the resection has no length"),
        ({"open_along": [2.0, 0.1, 0.0]}, "opens along its own normal"),
        ({"open_along": [0.0, 0.0, 0.0]}, "'open_along' of the resection has no length"),
        ({"open_along": [0.0, 1.0]}, "3 values"),
        ({"part": 1.5}, "'part' is 1.5"),
        ({"part": 0.0}, "'part' is 0"),
        ({"colour": 1}, "unknown value 'colour'"),
        ({"point": [float("nan"), 0.0, 0.0]}, "not finite"),
        ({"bezier": [[0.0, 0.0, 0.0]]}, "give one"),
        ({"point": None}, "give one"),
    ],
)
def test_a_bad_surface_is_refused(tmp_path: Path, change: dict[str, Any], reason: str) -> None:
    file = tmp_path / "plane.json"
    file.write_text(json.dumps(PLANE | change))
    with pytest.raises(MeshError, match=reason) as refused:
        CutSurface.read(file)
    assert "\n" not in str(refused.value)
    assert "build the file again" not in str(refused.value)


@pytest.mark.parametrize("content", [None, b"\xff\xfe", b"{", b"[]", b"{}"])
def test_a_file_that_is_no_surface_is_refused(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "plane.json"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(MeshError, match=r"resection .*plane\.json"):
        CutSurface.read(file)


@pytest.mark.parametrize("x", [0.2, 0.0005])
def test_a_plane_that_misses_the_organ_is_refused(x: float) -> None:
    with pytest.raises(MeshError, match="cuts off"):
        snapped(box_mesh(4), plane_at(x))
