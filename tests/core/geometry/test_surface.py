"""Reading a surface: formats, unit, axes, and every kind of faulty surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from avatar_core.errors import SurfaceError
from avatar_core.geometry import surface as door
from avatar_core.geometry import surface_files
from avatar_core.geometry.doubts import doubts_of
from avatar_core.geometry.mesh import TetMesh, regions_by_rule
from avatar_core.geometry.skin import signed_volume
from avatar_core.geometry.surface import SurfaceMesh, ambiguous_fraction, axes_matrix, read_surface
from avatar_core.geometry.surface_formats import MESHES, SUFFIXES
from tests.helpers.known_surfaces import (
    RADIUS,
    ball,
    ball_volume,
    inside_out,
    joined,
    refused,
    soup,
    write_obj,
    written,
)
from tests.helpers.mesh_mutations import SUFFIXES as KINDS
from tests.helpers.mesh_mutations import Soup, encode, pristine

BALL = ball(level=3)
CENTRE = np.array([0.01, 0.02, 0.03])
ASIDE = ball(centre=CENTRE, level=3)


def encoded(folder: Path, surface: SurfaceMesh, kind: str, words: str) -> Path:
    """Write a file with some words where 3D Slicer puts its ``SPACE=LPS``."""
    path = folder / f"organ.{kind.partition('-')[0]}"
    path.write_bytes(encode(Soup(1e3 * surface.vertices, surface.faces), kind, words))
    return path


# --- formats ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_format_gives_the_same_ball_in_metres(tmp_path, kind):
    path = tmp_path / f"ball.{kind.partition('-')[0]}"
    path.write_bytes(encode(pristine(), kind))
    surface = read_surface(path)
    assert surface.is_watertight
    assert len(surface.source_sha256) == 64
    assert surface.name == "ball"
    if kind != "nii.gz":  # its voxels are 10 mm
        # STL keeps single precision: 1e-7 of the radius
        assert np.allclose(np.linalg.norm(surface.vertices, axis=1), 0.06, rtol=1e-6)
        assert surface.volume == pytest.approx(0.000819385, rel=1e-5)
        assert len(surface.faces) == len(pristine().faces)


@pytest.mark.parametrize(
    "faces",
    [
        "f 1/1/1 4/2/1 3/3/1 2/1/1\nf 5//1 6//1 7//1 8//1",  # normals and textures
        "f 1/1 4/2 3/3 2/1\nf -4 -3 -2 -1",  # negative indices
        "f 1 4 3\nf 1 3 2\nf 5 6 7 8",  # triangles and quads
    ],
)
def test_obj_face_forms(tmp_path, faces):
    corners = [(0, 0), (100, 0), (100, 100), (0, 100)]
    vertices = [f"v {x} {y} {z} 0.5 0.5 0.5" for z in (0, 100) for x, y in corners]
    textures = ["vt 0 0", "vt 1 0", "vt 1 1", "vn 0 0 1"]
    sides = ["f 1 2 6 5", "f 2 3 7 6", "f 3 4 8 7", "f 4 1 5 8"]
    path = tmp_path / "cube.obj"
    path.write_text("\n".join(["g cube", *vertices, *textures, faces, *sides]))
    cube = read_surface(path)
    assert len(cube.faces) == 12
    assert cube.volume == pytest.approx(1e-3)
    assert cube.area == pytest.approx(0.06)


def test_legacy_vtk_polydata(tumour_dir):
    liver = read_surface(tumour_dir / "liver.vtk")
    assert 1e-3 < liver.volume < 3e-3
    assert read_surface(tumour_dir / "liver_tumours.vtk").volume < 2e-4


def test_the_ball_is_written_in_every_format_of_meshes():
    assert {f".{kind.partition('-')[0]}" for kind in KINDS} >= set(MESHES)


# --- unit and axes ----------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e3), ("cm", 1e2), ("m", 1.0)])
def test_unit_is_applied_once(tmp_path, unit, scale):
    surface = read_surface(written(tmp_path, BALL, scale), unit=unit)
    assert np.allclose(surface.vertices, BALL.vertices, rtol=0, atol=1e-12)
    assert surface.unit == unit


def test_axes_are_applied_once(tmp_path):
    path = written(tmp_path, ASIDE)
    assert read_surface(path).vertices.mean(axis=0) == pytest.approx(CENTRE)
    lps = read_surface(path, axes="LPS")
    assert lps.vertices.mean(axis=0) == pytest.approx([-0.01, -0.02, 0.03])
    ria = read_surface(path, axes="ria")  # y points down, z forward
    assert ria.vertices.mean(axis=0) == pytest.approx([0.01, 0.03, -0.02])
    assert (lps.axes_name, ria.axes_name) == ("LPS", "RIA")
    shift = np.eye(4)
    shift[:3, 3] = [1, 2, 3]
    shifted = read_surface(path, axes=shift)
    assert shifted.vertices.mean(axis=0) == pytest.approx([0.011, 0.022, 0.033])
    assert shifted.axes_name == "matrix"


def test_mirrored_axes_keep_the_faces_outward(tmp_path):
    path = written(tmp_path, ASIDE)
    surface = read_surface(path, axes="LAS")
    assert surface.notices == ()
    assert signed_volume(surface.vertices, surface.faces) > 0


@pytest.mark.parametrize("axes", ["RAR", "XYZ", "RA", np.diag([2.0, 2, 2, 1]), np.eye(3)])
def test_axes_that_are_no_axes(axes):
    with pytest.raises(SurfaceError, match="axes"):
        axes_matrix(axes)


# --- axes that a file states ------------------------------------------------------------------


def lump() -> SurfaceMesh:
    """Return a ball with a bump to the right, behind and above: no half-turn preserves it."""
    towards = np.array([0.6, -0.64, 0.48])
    bump = np.clip((ASIDE.vertices - CENTRE) @ towards / RADIUS, 0, 1)[:, None] ** 4
    return replace(ASIDE, vertices=ASIDE.vertices + 0.025 * bump * towards)


STATING = ("obj", "stl", "stl-text", "ply-text", "vtk")


@pytest.mark.parametrize("kind", STATING)
def test_a_file_that_states_lps_is_read_so(tmp_path, kind):
    turned = replace(lump(), vertices=lump().vertices * [-1, -1, 1])
    lps = read_surface(encoded(tmp_path, turned, kind, "3D Slicer output. SPACE=LPS"))
    near, _ = cKDTree(lump().vertices).query(lps.vertices)
    assert near.max() < 1e-6
    assert lps.axes_name == "LPS"
    assert lps.notices == ()
    clamped = [clamp_centre(surface) for surface in (lump(), lps)]
    np.testing.assert_allclose(*clamped, rtol=0, atol=1e-6)
    assert clamped[1][1] < CENTRE[1] < clamped[1][2]  # behind and above


def clamp_centre(surface: SurfaceMesh) -> np.ndarray:
    """Return the middle of the clamp by rule, on tetrahedra about the middle of the surface."""
    vertices = np.vstack([surface.vertices, surface.vertices.mean(axis=0)])
    middle = np.full(len(surface.faces), len(surface.vertices))
    mesh = TetMesh(vertices, np.column_stack([surface.faces[:, ::-1], middle]))
    clamped = regions_by_rule(mesh).clamped
    return mesh.vertices[mesh.boundary_faces[clamped]].mean(axis=(0, 1))


@pytest.mark.parametrize("kind", STATING)
@pytest.mark.parametrize("words", ["SPACE=RAS", "SPACE=LPSX", "AEROSPACE=LPS", ""])
def test_a_file_that_states_ras_or_nothing_is_read_as_ras(tmp_path, kind, words):
    surface = read_surface(encoded(tmp_path, ASIDE, kind, f"3D Slicer output. {words}"))
    assert surface.vertices.mean(axis=0) == pytest.approx(CENTRE, abs=1e-5)
    assert surface.axes_name == "RAS"


def test_given_axes_hold_against_those_that_the_file_states(tmp_path):
    path = encoded(tmp_path, ASIDE, "obj", "SPACE=LPS")
    surface = read_surface(path, axes="RAS")
    assert surface.vertices.mean(axis=0) == pytest.approx(CENTRE)
    (notice,) = surface.notices
    assert "axes RAS" in notice
    assert "SPACE=LPS" in notice
    assert read_surface(path, axes="LPS").notices == ()


def test_axes_are_looked_for_in_the_head_of_a_file_only(tmp_path, monkeypatch):
    path = written(tmp_path, ASIDE)
    path.write_text(path.read_text() + "# SPACE=LPS\n")
    monkeypatch.setattr(surface_files, "HEADER_BYTES", 1000)
    assert surface_files.stated_axes(path) is None
    assert read_surface(path).axes_name == "RAS"


@pytest.mark.parametrize(
    ("radius", "unit", "hint"),
    [
        (60.0, "cm", "--unit mm"),  # organ of 12 m
        (75.0, "cm", "--unit mm"),
        (0.075, "mm", "--unit m"),
        (7.5, "mm", "--unit cm"),
        (750.0, "mm", "rescale"),  # organ of 1.5 m in every unit
        (0.75, "mm", "rescale"),  # organ of 1.5 mm
    ],
)
def test_wrong_unit_names_the_probable_one(tmp_path, radius, unit, hint):
    path = written(tmp_path, BALL, radius / RADIUS)
    refused(path, "organ of", hint, unit=unit)
    assert read_surface(path, unit=unit, check_size=False).extent.max() > 0


def test_unknown_unit(tmp_path):
    refused(written(tmp_path, BALL), "inch", "mm", unit="inch")


# --- bad input --------------------------------------------------------------------------------


def test_missing_file_and_unknown_format(tmp_path):
    refused(tmp_path / "none.obj", "none.obj", "check the path")
    refused(tmp_path, "cannot read")
    (tmp_path / "organ.xyz").write_text("0 0 0")
    refused(tmp_path / "organ.xyz", "not supported", ".obj")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_garbage_is_refused_in_one_line(tmp_path, suffix):
    path = tmp_path / f"organ{suffix}"
    path.write_bytes(b"\x8b\xffv garbage\nDATASET POLYDATA\n" + bytes(range(256)))
    refused(path, "organ.")


def test_empty_and_two_triangle_meshes(tmp_path):
    vertices, faces = 1e3 * BALL.vertices, BALL.faces
    refused(write_obj(tmp_path / "none.obj", np.empty((0, 3)), faces[:0]), "no vertices")
    refused(write_obj(tmp_path / "points.obj", vertices, faces[:0]), "no triangles")
    refused(write_obj(tmp_path / "two.obj", vertices, faces[:2]), "2 triangle(s)")
    plane = np.column_stack(np.meshgrid([0, 50, 100], [0, 100])).reshape(-1, 2)
    flat = np.column_stack([plane, np.zeros(len(plane))])
    refused(
        write_obj(tmp_path / "flat.obj", flat, [[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]]),
        "no volume",
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_vertices_that_are_no_numbers(tmp_path, bad):
    vertices = 1e3 * BALL.vertices
    vertices[5, 1] = bad
    refused(write_obj(tmp_path / "b.obj", vertices, BALL.faces), "1 vertices are NaN")


def test_faces_beyond_the_vertices(tmp_path):
    faces = np.array(BALL.faces)
    faces[7, 2] = len(BALL.vertices)
    refused(write_obj(tmp_path / "b.obj", BALL.vertices, faces), "damaged")


# --- open, cracked, doubled, flipped ----------------------------------------------------------


def half(surface: SurfaceMesh, normal: np.ndarray, share: float = 0.5) -> SurfaceMesh:
    """Return the faces on one side of a plane, up to a fraction of them."""
    height = surface.vertices[surface.faces].mean(axis=1) @ normal
    return replace(surface, faces=surface.faces[height > np.quantile(height, 1 - share)])


@pytest.mark.parametrize("normal", [[1, 0, 0], [0, -1, 0], [0, 0, 1], [0.6, 0.64, 0.48]])
@pytest.mark.parametrize("share", [0.35, 0.5, 0.75])
def test_an_organ_cut_by_a_plane_is_refused(phantom, tmp_path, normal, share):
    cut = half(phantom, normal, share)
    refused(written(tmp_path, cut), "open", "close it")


def test_half_the_faces_turned_is_refused(phantom):
    faces = np.array(phantom.faces)
    faces[::2] = faces[::2, ::-1]
    with pytest.raises(SurfaceError, match="no volume"):
        door.require_closed(replace(phantom, faces=faces))


def test_cracks_single_flips_and_small_holes_are_accepted_as_they_are(phantom, tmp_path):
    cracked = soup(phantom)
    faces = np.array(cracked.faces)
    faces[::100] = faces[::100, ::-1]
    faces = np.delete(faces, np.arange(50, len(faces), 400), axis=0)
    surface = read_surface(written(tmp_path, replace(cracked, faces=faces)))
    assert surface.notices == ()
    assert len(surface.faces) == len(faces)
    assert not surface.is_watertight
    assert surface.volume == pytest.approx(phantom.volume, rel=0.01)


# --- components -------------------------------------------------------------------------------


def test_stray_components_are_dropped_with_a_notice(tmp_path):
    stray = ball(0.010, (0.1, 0, 0), level=1)  # 0.5 % of the volume
    surface = read_surface(written(tmp_path, joined(BALL, stray)))
    assert surface.extent == pytest.approx(BALL.extent)
    assert surface.volume == pytest.approx(ball_volume(), rel=4e-3)
    assert "dropped 1 component(s)" in surface.notices[0]


def test_a_stray_component_close_by_is_no_crack(tmp_path):
    both = joined(BALL, ball(0.008, (RADIUS + 0.009, 0, 0), level=1))
    surface = read_surface(written(tmp_path, soup(both, crack=0.0)))
    assert "dropped 1 component(s)" in surface.notices[0]


def test_a_large_cavity_and_an_overlapping_part_belong_to_the_organ(tmp_path):
    small = ball(RADIUS / 2, level=2)
    hollow = read_surface(written(tmp_path, joined(BALL, inside_out(small))))
    assert hollow.volume == pytest.approx(ball_volume() - ball_volume(RADIUS / 2), rel=4e-3)
    part = ball(RADIUS / 2, (RADIUS, 0, 0), level=2)
    union = read_surface(written(tmp_path, joined(BALL, part)))
    assert union.extent[0] == pytest.approx(2.5 * RADIUS, rel=0.02)
    island = joined(BALL, inside_out(ball(0.9 * RADIUS, level=2)), small)
    refused(written(tmp_path, island), "two separate bodies", "keep one organ")


# --- real livers ------------------------------------------------------------------------------


@pytest.mark.long
def test_all_real_livers_are_accepted_as_they_are(livers_dir):
    for path in sorted(livers_dir.glob("*.obj")):
        liver = read_surface(path)
        assert ambiguous_fraction(liver) == 0.0, path.name
        n_faces = path.read_text().count("\nf ")
        assert len(liver.faces) == n_faces, path.name
        assert liver.notices == (), path.name
        assert doubts_of(liver) == (), path.name
