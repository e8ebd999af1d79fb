"""PLY in every layout of header and body, and rare features of other mesh formats."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_core.geometry.label_files import is_label_map
from avatar_core.geometry.surface import read_surface
from avatar_core.geometry.surface_files import parse
from avatar_core.geometry.surface_formats import kind_of
from tests.core.geometry.test_vtk_files import CUBE, QUADS, TRIANGLES, VtkFile
from tests.helpers.known_surfaces import refused
from tests.helpers.mesh_mutations import encode, pristine

FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
CODES = {"uchar": "u1", "short": "i2", "int": "i4", "uint32": "u4", "float": "f4", "double": "f8"}
Row = list[tuple[str, Any]]  # types and numbers; for a list, the types of its length and numbers


class PlyFile:
    """Writer of elements row by row, as text or as bytes of either order."""

    def __init__(self, form: str) -> None:
        self.form, self.head, self.body = form, f"ply\nformat {form} 1.0\ncomment c\n", b""

    def element(self, name: str, properties: Iterable[str], rows: Iterable[Row]) -> PlyFile:
        rows = list(rows)
        lines = [f"element {name} {len(rows)}", *(f"property {one}" for one in properties)]
        self.head += "\n".join([*lines, ""])
        for row in rows:
            words = [word for kind, value in row for word in self._words(kind, value)]
            self.body += b" ".join(words) + b"\n" if self.form == "ascii" else b"".join(words)
        return self

    def _words(self, kind: str, value: Any) -> list[bytes]:
        numbers = [(kind, value)]
        if " " in kind:
            length, kind = kind.split()
            numbers = [(length, len(value)), *((kind, one) for one in value)]
        if self.form == "ascii":
            return [str(number).encode() for _, number in numbers]
        order = ">" if self.form == "binary_big_endian" else "<"
        return [np.array(number, order + CODES[code]).tobytes() for code, number in numbers]

    def camera(self) -> PlyFile:
        """Return a camera element as PCL writes it."""
        return self.element("camera", ["float view_px", "float view_py"], [[("float", 1.0)] * 2])

    def cube(self, faces: list[tuple[int, ...]] = TRIANGLES) -> PlyFile:
        """Return properties in an unusual order, normals, colours and texture on the faces."""
        corners = [
            [("uchar", 7), ("float", z), ("double", x), ("float", y), ("float", 0.0)]
            for x, y, z in CUBE.tolist()
        ]
        kinds = ["uchar red", "float z", "double x", "float y", "float nx"]
        self.element("vertex", kinds, corners)
        texture = ("uchar float", (0.5, 0.25))
        rows = [[("uchar", 255), texture, ("uchar int", face), ("short", -1)] for face in faces]
        lists = ["list uchar float texcoord", "list uchar int vertex_indices"]
        kinds = ["uchar red", *lists, "short flags"]
        return self.element("face", kinds, rows)

    def at(self, folder: Path, newline: bytes = b"\n") -> Path:
        path = folder / "cube.ply"
        head = (self.head + "end_header\n").encode().replace(b"\n", newline)
        path.write_bytes(head + self.body)
        return path


@pytest.mark.parametrize("newline", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("form", FORMS)
def test_every_layout_gives_the_same_cube(tmp_path: Path, form: str, newline: bytes) -> None:
    mixed = [QUADS[0], *TRIANGLES[2:]], [*TRIANGLES[:10], QUADS[5]]
    for faces in (TRIANGLES, QUADS, *mixed):
        file = PlyFile(form).camera().element("edge", ["int vertex1"], [[("int", 3)]] * 2)
        vertices, triangles = parse(file.cube(faces).camera().at(tmp_path, newline), None)[:2]
        np.testing.assert_array_equal(vertices, CUBE)
        np.testing.assert_array_equal(triangles, TRIANGLES)


@pytest.mark.parametrize("form", FORMS)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, form: str) -> None:
    whole = PlyFile(form).cube().at(tmp_path).read_bytes()
    path = tmp_path / "cube.ply"
    for n_bytes in range(0, len(whole) - 4, 7):
        path.write_bytes(whole[:n_bytes])
        refused(path, "cube.ply")
    refused(path, "it ends before what it announces")


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (b"ply\n", b"plx\n", "does not begin with a line 'ply'"),
        (b"end_header", b"end_heads", "header has no end"),
        (b"format ascii", b"format utf", "its format 'utf'"),
        (b"vertex 8", b"vertex -8", "a count expected"),
        (b"vertex 8", b"vertex 999999999999999999", "before what it announces"),
        (b"face 12", b"face 99999999999999999999", "a count expected"),
        (b"list uchar int", b"list uchar complex", "is not read"),
        (b"double x", b"double u", "no x, y and z"),
        (b"vertex_indices", b"indices", "no list vertex_indices"),
        (b"0.25 3 0 2 3", b"0.25 3.5 0 2 3", "no whole number"),
        (b"0.25 3 0 2 3", b"0.25 -3 0 2 3", "before what it announces"),
        (b"0.25 3 0 2 3", b"0.25 3 0 2 8", "a face names vertex 9 of 8"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, old: bytes, new: bytes, why: str) -> None:
    path = PlyFile("ascii").cube().at(tmp_path)
    path.write_bytes(path.read_bytes().replace(old, new))
    refused(path, why)


def coloured_off(content: bytes) -> bytes:
    """Return colours on vertices and faces, comments, and the counts behind the keyword."""
    lines = content.splitlines()
    n = int(lines[1].split()[0])
    vertices = [line + b" 10 20 30 255" for line in lines[2 : 2 + n]]
    faces = [line + b" 3 200 10 10" for line in lines[2 + n :]]
    return b"\n".join([b"COFF " + lines[1], b"# a ball", *vertices, b"", *faces, b""])


ODD: dict[str, tuple[str, Callable[[bytes], bytes]]] = {
    "bytes behind the last triangle": ("stl", lambda content: content + b"\xd0 tail" * 9),
    "text in capitals": ("stl-text", lambda content: content.upper()),
    "byte order mark of OBJ": ("obj", lambda content: b"\xef\xbb\xbf" + content),
    "byte order mark of PLY": ("ply-text", lambda content: b"\xef\xbb\xbf" + content),
    "colours in OFF": ("off", coloured_off),
    "a vertex that no face uses": ("obj", lambda content: content + b"v 0 0 300\n"),
}


@pytest.mark.parametrize("what", ODD)
@pytest.mark.parametrize("name", ["1.2.840.113619.2.55", "ball.SUFFIX"])
def test_what_other_programs_write_is_the_same_ball(tmp_path: Path, what: str, name: str) -> None:
    """The name need not tell the format."""
    kind, change = ODD[what]
    path = tmp_path / name.replace("SUFFIX", kind.partition("-")[0])
    path.write_bytes(change(encode(pristine(), kind)))
    if kind == "stl" and "SUFFIX" not in name:
        path.write_bytes(encode(pristine(), kind))  # a tail hides a binary STL without a name
    found = read_surface(path)
    assert len(found.vertices) == len(pristine().vertices)
    assert found.volume == pytest.approx(0.000819385, rel=1e-5)
    assert np.abs(found.bounding_box).max() == pytest.approx(0.06, rel=0.01)  # a coarse ball
    assert found.notices == ()


@pytest.mark.parametrize("form", ["ASCII", "BINARY"])
@pytest.mark.parametrize("version", [3.0, 5.1])
def test_faces_of_an_unstructured_grid(tmp_path: Path, form: str, version: float) -> None:
    """Triangles, quadrilaterals and a strip are faces; lines and tetrahedra are not."""
    file = VtkFile(form, version).text("DATASET UNSTRUCTURED_GRID")
    file.text("POINTS 8 float").numbers(CUBE.ravel(), ">f4")
    cells = [(0, 1), (0, 1, 2, 4), QUADS[0], *TRIANGLES[2:10], (1, 3, 5, 7)]
    file.cells("CELLS", cells).text(f"CELL_TYPES {len(cells)}")
    file.numbers([3, 10, 9, *[5] * 8, 6], ">i4")
    expected = [*TRIANGLES[:10], (1, 3, 5), (5, 3, 7)]
    triangles = parse(file.at(tmp_path), None)[1]
    assert sorted(map(sorted, triangles.tolist())) == sorted(map(sorted, expected))


def test_an_unstructured_grid_whose_types_do_not_fit_is_refused(tmp_path: Path) -> None:
    file = VtkFile("ASCII", 3.0).text("DATASET UNSTRUCTURED_GRID")
    file.text("POINTS 8 float").numbers(CUBE.ravel(), ">f4").cells("CELLS", TRIANGLES)
    refused(file.text("CELL_TYPES 2").numbers([5, 5], ">i4").at(tmp_path), "12 cells have 2 types")


@pytest.mark.parametrize(
    ("beginning", "kind"),
    [
        (bytes(128) + b"DICM", ".dcm"),
        (b"NRRD0004\n", ".nrrd"),
        (bytes(344) + b"n+1\0", ".nii"),
        (bytes(4) + b"n+2\0\r\n\x1a\n", ".nii"),
        (gzip.compress(bytes(344) + b"n+1\0" + bytes(9999)), ".nii.gz"),
        (gzip.compress(b"ply\n"), ""),
        (b"\x1f\x8b garbage", ""),
    ],
    ids=["dicom", "nrrd", "nifti-1", "nifti-2", "packed nifti", "packed mesh", "garbage"],
)
def test_a_name_that_tells_nothing(tmp_path: Path, beginning: bytes, kind: str) -> None:
    path = tmp_path / "1.2.840.113619.2.55"
    path.write_bytes(beginning)
    assert kind_of(path) == kind and is_label_map(path) == bool(kind)
    assert kind_of(tmp_path / "none") == ""
