"""The front door: formats, unit, axes, and every way in which a surface can be wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import igl
import meshio
import numpy as np
import pytest
from scipy.spatial import cKDTree

from avatar_core.errors import SurfaceError
from avatar_core.geometry import surface as door
from avatar_core.geometry import surface_files
from avatar_core.geometry.mesh import regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh, ambiguous_fraction, axes_matrix, read_surface

RADIUS = 60.0  # of the test ball [mm], an organ of 0.12 m


def ball(radius: float = RADIUS, centre: tuple[float, float, float] = (0, 0, 0), level: int = 3):
    """Vertices [mm] and outward faces of a subdivided icosahedron."""
    vertices, faces = igl.icosahedron()
    for _ in range(level):
        vertices, faces = igl.upsample(vertices, faces)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return radius * vertices + np.array(centre), faces


def joined(*soups):
    """One vertex and one face array of several surfaces."""
    starts = np.cumsum([0] + [len(v) for v, _ in soups[:-1]])
    faces = [f + start for (_, f), start in zip(soups, starts, strict=True)]
    return np.vstack([v for v, _ in soups]), np.vstack(faces)


def write_obj(path: Path, vertices, faces) -> Path:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices, dtype=float).tolist()]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in np.asarray(faces).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def refused(path: Path, *words: str, **options) -> None:
    """The file is refused by one line that holds all the words."""
    with pytest.raises(SurfaceError) as caught:
        read_surface(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


# --- formats ----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "vtk", "off"])
def test_every_format_gives_the_same_ball_in_metres(tmp_path, suffix):
    vertices, faces = ball()
    path = tmp_path / f"ball.{suffix}"
    meshio.Mesh(vertices, [("triangle", faces)]).write(path)
    surface = read_surface(path)
    # STL keeps single precision: 1e-7 of the radius
    assert np.allclose(np.linalg.norm(surface.vertices, axis=1), 0.06, rtol=1e-6)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(4 / 3 * np.pi * 0.06**3, rel=0.02)  # facets
    assert surface.area == pytest.approx(4 * np.pi * 0.06**2, rel=0.02)
    assert len(surface.source_sha256) == 64
    assert surface.name == "ball"


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


# --- unit and axes ----------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "radius"), [("mm", 60.0), ("cm", 6.0), ("m", 0.06)])
def test_unit_is_applied_once(tmp_path, unit, radius):
    surface = read_surface(write_obj(tmp_path / "b.obj", *ball(radius)), unit=unit)
    assert surface.extent == pytest.approx(0.12)
    assert surface.unit == unit


def test_axes_are_applied_once(tmp_path):
    vertices, faces = ball(centre=(10, 20, 30))
    path = write_obj(tmp_path / "b.obj", vertices, faces)
    assert read_surface(path).vertices.mean(axis=0) == pytest.approx([0.01, 0.02, 0.03])
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
    path = write_obj(tmp_path / "b.obj", *ball(centre=(10, 20, 30)))
    surface = read_surface(path, axes="LAS")
    assert surface.notices == ()
    assert door._signed_volume(surface.vertices, surface.faces) > 0


@pytest.mark.parametrize("axes", ["RAR", "XYZ", "RA", np.diag([2.0, 2, 2, 1]), np.eye(3)])
def test_axes_that_are_no_axes(axes):
    with pytest.raises(SurfaceError, match="axes"):
        axes_matrix(axes)


# --- axes that a file states ------------------------------------------------------------------


def lump() -> tuple[np.ndarray, np.ndarray]:
    """A ball with a bump to the right, behind and above: no half-turn maps it onto itself [mm]."""
    vertices, faces = ball(centre=(10, 20, 30))
    towards = np.array([0.6, -0.64, 0.48])
    bump = np.clip((vertices - [10, 20, 30]) @ towards / RADIUS, 0, 1)[:, None] ** 4
    return vertices + 25 * bump * towards, faces


def write_stating(path: Path, vertices, faces, words: str, binary: bool = False) -> Path:
    """The surface with ``words`` where 3D Slicer puts its ``SPACE=LPS``."""
    n, text = len(faces), path.suffix[1:]
    points = [" ".join(map(repr, point)) for point in np.asarray(vertices, float).tolist()]
    corners = [" ".join(map(str, face)) for face in np.asarray(faces).tolist()]
    if text == "obj":
        write_obj(path, vertices, faces)
        path.write_text(f"# 3D Slicer output. {words}\n" + path.read_text())
    elif text == "stl" and binary:
        record = np.zeros(n, [("normal", "<f4", 3), ("at", "<f4", (3, 3)), ("_", "<u2")])
        record["at"] = vertices[faces]
        header = f"3D Slicer output. {words}".encode().ljust(80)
        path.write_bytes(header + n.to_bytes(4, "little") + record.tobytes())
    elif text == "stl":
        facets = [
            "facet normal 0 0 0\nouter loop\n"
            + "".join(f"vertex {points[i]}\n" for i in face)
            + "endloop\nendfacet"
            for face in faces
        ]
        path.write_text("\n".join([f"solid 3D Slicer output. {words}", *facets, "endsolid\n"]))
    elif text == "ply":
        header = f"ply\nformat ascii 1.0\ncomment 3D Slicer output. {words}\nelement vertex "
        header += f"{len(points)}\nproperty double x\nproperty double y\nproperty double z\n"
        header += f"element face {n}\nproperty list uchar int vertex_indices\nend_header"
        path.write_text("\n".join([header, *points, *(f"3 {c}" for c in corners), ""]))
    else:
        header = f"# vtk DataFile Version 3.0\n3D Slicer output. {words}\nASCII\n"
        header += f"DATASET UNSTRUCTURED_GRID\nPOINTS {len(points)} double"
        cells = [f"CELLS {n} {4 * n}", *(f"3 {c}" for c in corners)]
        path.write_text("\n".join([header, *points, *cells, f"CELL_TYPES {n}", *["5"] * n, ""]))
    return path


STATING = [("obj", False), ("stl", False), ("stl", True), ("ply", False), ("vtk", False)]


@pytest.mark.parametrize(("suffix", "binary"), STATING)
def test_a_file_that_states_lps_is_read_so(tmp_path, suffix, binary):
    vertices, faces = lump()
    ras = read_surface(write_obj(tmp_path / "ras.obj", vertices, faces))
    turned = vertices * [-1, -1, 1]
    path = write_stating(tmp_path / f"lps.{suffix}", turned, faces, "SPACE=LPS", binary)
    lps = read_surface(path)
    near, _ = cKDTree(ras.vertices).query(lps.vertices)
    assert near.max() < 1e-6
    assert lps.axes_name == "LPS"
    assert lps.notices == ()


def test_a_file_that_states_lps_is_clamped_behind_and_above(tmp_path):
    vertices, faces = lump()
    ras = read_surface(write_obj(tmp_path / "ras.obj", vertices, faces))
    path = write_stating(tmp_path / "lps.obj", vertices * [-1, -1, 1], faces, "SPACE=LPS", False)
    clamped = [clamp_centre(surface) for surface in (ras, read_surface(path))]
    np.testing.assert_allclose(*clamped, rtol=0, atol=1e-9)  # one surface has one mesh
    assert clamped[1][1] < 0.02 < clamped[1][2]  # behind and above the ball's centre


def clamp_centre(surface: SurfaceMesh) -> np.ndarray:
    mesh = tetrahedralize(surface, 300)
    clamped = regions_by_rule(mesh).clamped
    return mesh.vertices[mesh.boundary_faces[clamped]].mean(axis=(0, 1))


@pytest.mark.parametrize(("suffix", "binary"), STATING)
@pytest.mark.parametrize("words", ["SPACE=RAS", "SPACE=LPSX", "AEROSPACE=LPS", ""])
def test_a_file_that_states_ras_or_nothing_is_read_as_ras(tmp_path, suffix, binary, words):
    path = write_stating(tmp_path / f"b.{suffix}", *ball(centre=(10, 20, 30)), words, binary)
    surface = read_surface(path)
    assert surface.vertices.mean(axis=0) == pytest.approx([0.01, 0.02, 0.03], abs=1e-5)
    assert surface.axes_name == "RAS"


def test_given_axes_hold_against_those_that_the_file_states(tmp_path):
    path = write_stating(tmp_path / "b.obj", *ball(centre=(10, 20, 30)), "SPACE=LPS")
    surface = read_surface(path, axes="RAS")
    assert surface.vertices.mean(axis=0) == pytest.approx([0.01, 0.02, 0.03])
    (notice,) = surface.notices
    assert "axes RAS" in notice
    assert "SPACE=LPS" in notice
    assert read_surface(path, axes="LPS").notices == ()


def test_axes_are_looked_for_in_the_head_of_a_file_only(tmp_path, monkeypatch):
    path = write_obj(tmp_path / "b.obj", *ball(centre=(10, 20, 30)))
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
    path = write_obj(tmp_path / "b.obj", *ball(radius))
    refused(path, "organ of", hint, unit=unit)
    assert read_surface(path, unit=unit, check_size=False).extent.max() > 0


def test_unknown_unit(tmp_path):
    refused(write_obj(tmp_path / "b.obj", *ball()), "inch", "mm", unit="inch")


# --- bad input --------------------------------------------------------------------------------


def test_missing_file_and_unknown_format(tmp_path):
    refused(tmp_path / "none.obj", "none.obj", "check the path")
    refused(tmp_path, "cannot read")
    (tmp_path / "organ.xyz").write_text("0 0 0")
    refused(tmp_path / "organ.xyz", "not supported", ".obj")


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "vtk", "off", "nii", "nii.gz"])
def test_garbage_is_refused_in_one_line(tmp_path, suffix):
    path = tmp_path / f"organ.{suffix}"
    path.write_bytes(b"\x8b\xffv garbage\nDATASET POLYDATA\n" + bytes(range(256)))
    refused(path, "organ.")


def test_empty_and_two_triangle_meshes(tmp_path):
    vertices, faces = ball()
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
    vertices, faces = ball()
    vertices[5, 1] = bad
    refused(write_obj(tmp_path / "b.obj", vertices, faces), "1 vertices are NaN")


def test_faces_beyond_the_vertices(tmp_path):
    vertices, faces = ball()
    faces[7, 2] = len(vertices)
    refused(write_obj(tmp_path / "b.obj", vertices, faces), "damaged")


# --- open, cracked, doubled, flipped ----------------------------------------------------------


def half(surface: SurfaceMesh, normal: np.ndarray, share: float = 0.5) -> SurfaceMesh:
    """The faces on one side of a plane, that share of them."""
    height = surface.vertices[surface.faces].mean(axis=1) @ normal
    return replace(surface, faces=surface.faces[height > np.quantile(height, 1 - share)])


@pytest.mark.parametrize("normal", [*np.eye(3), *-np.eye(3), np.array([1, 1, 1]) / 3**0.5])
@pytest.mark.parametrize("share", [0.35, 0.5, 0.75])
def test_an_organ_cut_by_a_plane_is_refused(phantom, tmp_path, normal, share):
    cut = half(phantom, normal, share)
    refused(write_obj(tmp_path / "cut.obj", 1e3 * cut.vertices, cut.faces), "open", "close it")


def test_half_the_faces_turned_is_refused(phantom):
    faces = np.array(phantom.faces)
    faces[::2] = faces[::2, ::-1]
    with pytest.raises(SurfaceError, match="no volume"):
        door.require_closed(replace(phantom, faces=faces))


def test_an_inside_out_surface_is_turned_with_a_notice(tmp_path):
    vertices, faces = ball()
    surface = read_surface(write_obj(tmp_path / "b.obj", vertices, faces[:, ::-1]))
    assert door._signed_volume(surface.vertices, surface.faces) > 0
    assert len(surface.notices) == 1
    assert "inside out" in surface.notices[0]


def test_cracks_single_flips_and_small_holes_are_accepted_as_they_are(phantom, tmp_path):
    corners = np.array(phantom.vertices[phantom.faces]).reshape(-1, 3)  # every face on its own
    corners += 2e-5 * np.random.default_rng(1).standard_normal(corners.shape)  # hairline cracks
    faces = np.arange(len(corners)).reshape(-1, 3)
    faces[::100] = faces[::100, ::-1]
    faces = np.delete(faces, np.arange(50, len(faces), 400), axis=0)
    surface = read_surface(write_obj(tmp_path / "cracked.obj", 1e3 * corners, faces))
    assert surface.notices == ()
    assert len(surface.faces) == len(faces)
    assert not surface.is_watertight
    assert surface.volume == pytest.approx(phantom.volume, rel=0.01)


def test_a_doubled_surface_has_its_volume_once(tmp_path):
    one, two = ball(), ball(RADIUS * 1.001)
    for name, soup in {"same": joined(one, one), "offset": joined(one, two)}.items():
        surface = read_surface(write_obj(tmp_path / f"{name}.obj", *soup))
        assert surface.volume == pytest.approx(4 / 3 * np.pi * 0.06**3, rel=0.02)


# --- components -------------------------------------------------------------------------------


def test_stray_components_are_dropped_with_a_notice(tmp_path):
    stray = ball(10.0, (100, 0, 0), level=1)  # 0.4 % of the volume
    surface = read_surface(write_obj(tmp_path / "b.obj", *joined(ball(), stray)))
    assert surface.extent == pytest.approx(0.12)
    assert surface.volume == pytest.approx(4 / 3 * np.pi * 0.06**3, rel=0.02)
    assert "dropped 1 component(s)" in surface.notices[0]


def test_a_stray_component_close_by_is_no_crack(tmp_path):
    vertices, faces = joined(ball(), ball(8.0, (RADIUS + 9, 0, 0), level=1))
    corners, alone = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    surface = read_surface(write_obj(tmp_path / "soup.obj", corners, alone))
    assert "dropped 1 component(s)" in surface.notices[0]


def test_two_large_components_are_refused(tmp_path):
    second = ball(30.0, (100, 0, 0), level=2)  # 12 % of the volume
    path = write_obj(tmp_path / "b.obj", *joined(ball(), second))
    refused(path, "two separate bodies", "keep one organ")


def test_a_large_cavity_and_an_overlapping_part_belong_to_the_organ(tmp_path):
    vertices, faces = ball(30.0, level=2)
    hollow = read_surface(
        write_obj(tmp_path / "h.obj", *joined(ball(), (vertices, faces[:, ::-1])))
    )
    assert hollow.volume == pytest.approx(4 / 3 * np.pi * (0.06**3 - 0.03**3), rel=0.02)
    part = ball(30.0, (60, 0, 0), level=2)
    union = read_surface(write_obj(tmp_path / "u.obj", *joined(ball(), part)))
    assert union.extent[0] == pytest.approx(0.15)
    island = joined(ball(), (2 * vertices * 0.9, faces[:, ::-1]), ball(30.0, level=2))
    refused(write_obj(tmp_path / "i.obj", *island), "two separate bodies")


# --- real livers ------------------------------------------------------------------------------


@pytest.mark.long
def test_all_real_livers_are_accepted_as_they_are(livers_dir):
    for path in sorted(livers_dir.glob("*.obj")):
        liver = read_surface(path)
        assert ambiguous_fraction(liver) == 0.0, path.name
        n_faces = path.read_text().count("\nf ")
        assert len(liver.faces) == n_faces, path.name
        assert liver.notices == (), path.name


@pytest.mark.parametrize("name", ["LiTS-4", "LiTS-70", "Amos-103", "LiTS-74", "Amos-007"])
def test_real_livers_cut_in_half_are_refused(livers_dir, name):
    liver = read_surface(livers_dir / f"{name}.obj")
    for normal in (*np.eye(3), *-np.eye(3)):
        with pytest.raises(SurfaceError, match="open"):
            door.require_closed(half(liver, normal))
