"""Polygonal data in legacy and XML VTK files: each layout gives the same surface or a refusal."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from avatar_core.geometry.surface import read_surface
from avatar_core.geometry.surface_files import parse, stated_axes
from tests.helpers.known_surfaces import ball, refused
from tests.helpers.vtp_writer import COMPRESSORS, ENCODINGS, VtpFile

CUBE = np.array([(x, y, z) for z in (0, 100) for y in (0, 100) for x in (0, 100)])
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
TRIANGLES = [corners for a, b, c, d in QUADS for corners in ((a, b, c), (a, c, d))]
FORMS = [("ASCII", 3.0), ("BINARY", 3.0), ("ASCII", 5.1), ("BINARY", 5.1)]


class VtkFile:
    """Writer of a file section by section, with numbers as text or as big-endian bytes."""

    def __init__(self, form: str, version: float) -> None:
        self.form, self.version = form, version
        self.content = f"# vtk DataFile Version {version}\na cube\n{form}\n".encode()

    def text(self, line: str) -> VtkFile:
        self.content += line.encode() + b"\n"
        return self

    def numbers(self, values: Iterable[float], kind: str) -> VtkFile:
        array = np.asarray(list(values), kind)
        text = " ".join(map(str, array.tolist())).encode()
        self.content += (array.tobytes() if self.form == "BINARY" else text) + b"\n"
        return self

    def points(self, name: str = "float", kind: str = ">f4") -> VtkFile:
        return self.text("DATASET POLYDATA").text(f"POINTS 8 {name}").numbers(CUBE.ravel(), kind)

    def cells(self, section: str, cells: list[tuple[int, ...]]) -> VtkFile:
        corners = [corner for cell in cells for corner in cell]
        if self.version < 5:
            row = [number for cell in cells for number in (len(cell), *cell)]
            return self.text(f"{section} {len(cells)} {len(row)}").numbers(row, ">i4")
        starts = np.cumsum([0] + [len(cell) for cell in cells])
        self.text(f"{section} {len(starts)} {len(corners)}")
        self.text("OFFSETS vtktypeint64").numbers(starts, ">i8")
        return self.text("CONNECTIVITY vtktypeint32").numbers(corners, ">i4")

    def at(self, folder: Path) -> Path:
        path = folder / "cube.vtk"
        path.write_bytes(self.content)
        return path


@pytest.mark.parametrize(("form", "version"), FORMS)
@pytest.mark.parametrize("cells", [TRIANGLES, QUADS])
def test_every_layout_gives_the_same_cube(
    tmp_path: Path, form: str, version: float, cells: list[tuple[int, ...]]
) -> None:
    path = VtkFile(form, version).points().cells("POLYGONS", cells).at(tmp_path)
    vertices, faces = parse(path, None)
    np.testing.assert_array_equal(vertices, CUBE)
    np.testing.assert_array_equal(faces, TRIANGLES)
    assert read_surface(path).volume == pytest.approx(1e-3)


@pytest.mark.parametrize("form", ["ASCII", "BINARY"])
@pytest.mark.parametrize(
    ("name", "kind"), [("double", ">f8"), ("int", ">i4"), ("short", ">i2"), ("vtktypeint64", ">i8")]
)
def test_points_of_any_type(tmp_path: Path, form: str, name: str, kind: str) -> None:
    path = VtkFile(form, 4.2).points(name, kind).cells("POLYGONS", TRIANGLES).at(tmp_path)
    np.testing.assert_array_equal(parse(path, None)[0], CUBE)


@pytest.mark.parametrize(("form", "version"), FORMS)
def test_triangles_of_a_strip_face_one_way(tmp_path: Path, form: str, version: float) -> None:
    sides, ends = [(0, 1, 4, 5, 6, 7, 2, 3, 0, 1)], [QUADS[4], QUADS[5]]
    file = VtkFile(form, version).points().cells("TRIANGLE_STRIPS", sides).cells("POLYGONS", ends)
    vertices, faces = parse(file.at(tmp_path), None)
    assert faces[4:8].tolist() == [[0, 1, 4], [4, 1, 5], [4, 5, 6], [6, 5, 7]]
    surface = read_surface(file.at(tmp_path))
    assert surface.is_watertight
    assert surface.volume == pytest.approx(1e-3)
    assert len(vertices) == 8 and len(faces) == 12


@pytest.mark.parametrize(("form", "version"), FORMS)
def test_what_is_no_surface_is_skipped(tmp_path: Path, form: str, version: float) -> None:
    file = VtkFile(form, version).points().text("METADATA").text("INFORMATION 0").text("")
    file.cells("VERTICES", [(0,), (1,)]).cells("LINES", [(0, 1, 2), (3, 4)])
    file.text("FIELD FieldData 3").text("TIME 1 1 double").numbers([1.5], ">f8")
    file.text("METADATA").text("COMPONENT_NAMES").text("POLYGONS").text("")
    file.text("source 1 2 string")
    for name in ("one%20name", "x" * 70):  # longer than a length of one byte allows
        length = (
            bytes([192 + len(name)]) if len(name) < 64 else struct.pack(">H", 2**15 + len(name))
        )
        file.content += length + name.encode() if form == "BINARY" else name.encode() + b"\n"
    file.text("").text("more 2 2 int").numbers([1, 2, 3, 4], ">i4")
    file.cells("POLYGONS", QUADS)
    file.text("CELL_DATA 6").text("SCALARS x int").text("LOOKUP_TABLE default").text("nonsense")
    vertices, faces = parse(file.at(tmp_path), None)
    np.testing.assert_array_equal(vertices, CUBE)
    np.testing.assert_array_equal(faces, TRIANGLES)


def test_polygons_of_one_and_two_corners_are_no_triangles(tmp_path: Path) -> None:
    cells = [(0,), *TRIANGLES[:5], (), (1, 2), *TRIANGLES[5:]]
    for version in (3.0, 5.1):
        path = VtkFile("BINARY", version).points().cells("POLYGONS", cells).at(tmp_path)
        np.testing.assert_array_equal(parse(path, None)[1], TRIANGLES)


@pytest.mark.parametrize(("form", "version"), FORMS)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, form: str, version: float) -> None:
    whole = VtkFile(form, version).points().cells("POLYGONS", TRIANGLES).content
    last_number = 3 if form == "ASCII" else 2  # without it, a number or one byte is missing
    path = tmp_path / "cube.vtk"
    for n_bytes in range(len(whole) - last_number + 1):
        path.write_bytes(whole[:n_bytes])
        refused(path, "cube.vtk")
    refused(path, "it ends")


@pytest.mark.parametrize(("form", "version"), FORMS)
@pytest.mark.parametrize("index", [8, -1, 2**31 - 1])
def test_an_index_out_of_range_is_refused(
    tmp_path: Path, form: str, version: float, index: int
) -> None:
    file = VtkFile(form, version).points().cells("POLYGONS", [*TRIANGLES[:-1], (0, 1, index)])
    refused(file.at(tmp_path), "of 8", "damaged")


@pytest.mark.parametrize("form", ["ASCII", "BINARY"])
@pytest.mark.parametrize(
    ("version", "head", "why"),
    [
        (3.0, "POINTS 99999999999999999 double", "before what it announces"),
        (3.0, "POINTS 9999999999999999999999 double", "a count expected"),
        (3.0, "POINTS -1 double", "a count expected"),
        (3.0, "POINTS 0 complex", "type 'complex'"),
        (3.0, "POLYGONS 1 99999999999999999", "before what it announces"),
        (3.0, "POLYGONS 99999999999999999 0", "do not fit"),
        (5.1, "POLYGONS 2 3\nOFFSET vtktypeint64", "OFFSETS expected"),
        (5.1, "POLYGONS 99999999999999999 3\nOFFSETS vtktypeint64", "before what it announces"),
        (5.1, "POLYGONS 2 3\nOFFSETS double", "type 'double'"),
        (3.0, "FIELD data 99999999999999999", "within a field"),
        (3.0, "FIELD data 1\nx 999999999 999999999 string", "before what it announces"),
        (3.0, "FACES 1 4", "unknown section 'FACES'"),
        (3.0, "DATASET STRUCTURED_POINTS", "POLYDATA or UNSTRUCTURED_GRID expected"),
        (6.0, "POINTS 0 float", "version 6"),
    ],
)
def test_claims_that_the_file_does_not_keep(
    tmp_path: Path, form: str, version: float, head: str, why: str
) -> None:
    refused(VtkFile(form, version).text("DATASET POLYDATA").text(head).at(tmp_path), why)


def test_cells_that_contradict_their_counts(tmp_path: Path) -> None:
    for row, why in (
        ([-1, 0, 1, 2], "the corners of cell 0 of 2"),
        ([2**31 - 1, 0, 1, 2], "the corners of cell 1 of 2"),
        ([3, 0, 1, 2, 3, 0, 1], "2 cells take 8 numbers, not 7"),
        ([3, 0, 1, 2, 3, 0, 1, 2, 3], "2 cells take 8 numbers, not 9"),
    ):
        file = VtkFile("BINARY", 3.0).points().text(f"POLYGONS 2 {len(row)}").numbers(row, ">i4")
        refused(file.at(tmp_path), why)
    for starts in ([1, 3, 6], [0, 4, 3, 6], [0, 3, 7], [0, -3, 6]):
        file = VtkFile("BINARY", 5.1).points().text(f"POLYGONS {len(starts)} 6")
        file.text("OFFSETS vtktypeint64").numbers(starts, ">i8")
        file.text("CONNECTIVITY vtktypeint64").numbers([0, 1, 2, 2, 1, 3], ">i8")
        refused(file.at(tmp_path), "offsets")


def test_the_header_is_checked(tmp_path: Path) -> None:
    whole = VtkFile("ASCII", 3.0).points().cells("POLYGONS", TRIANGLES).content
    path = tmp_path / "cube.vtk"
    for old, new, why in (
        (b"# vtk", b"#  tk", "begin"),
        (b"Version 3.0", b"Version x", "begin"),
        (b"ASCII", b"TEXT", "neither ASCII nor BINARY"),
        (b"POINTS 8", b"POINTS 7", "unknown section"),
        (b"POLYGONS 12 48", b"POLYGONS 12 99", "before what it announces"),
        (b"POLYGONS 12 48", b"POLYGONS 12 49", "it ends after 48 of 49 numbers"),
    ):
        path.write_bytes(whole.replace(old, new))
        refused(path, why)


# --- XML files -------------------------------------------------------------------------------

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
XML_FORMS = [
    (encoding, compressor)
    for encoding in ENCODINGS
    for compressor in COMPRESSORS
    if encoding != "ascii" or not compressor
]


def at(folder: Path, content: bytes) -> Path:
    path = folder / "organ.vtp"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(("encoding", "compressor"), XML_FORMS)
def test_every_encoding_gives_the_same_organ(
    tmp_path: Path, encoding: str, compressor: str
) -> None:
    organ = ball(level=2)
    for big, header in ((False, "u4"), (True, "u8")):
        file = VtpFile(encoding, compressor, big, header)
        file.axes("LPS").piece(1e3 * organ.vertices * [-1, -1, 1], organ.faces.tolist())
        path = at(tmp_path, file.content())
        found = read_surface(path)
        np.testing.assert_allclose(found.vertices, organ.vertices, atol=1e-12)
        np.testing.assert_array_equal(found.faces, organ.faces)
        assert (found.axes_name, found.notices) == ("LPS", ())


def test_pieces_polygons_and_strips_come_in_their_order(tmp_path: Path) -> None:
    file = VtpFile("binary").piece(SQUARE, [(0, 1, 2, 3)], [(0, 1, 3, 2)], "f4")
    points, triangles = parse(at(tmp_path, file.piece(SQUARE + 1, [(0, 1, 2)]).content()), None)
    np.testing.assert_array_equal(points, np.vstack([SQUARE, SQUARE + 1]))
    expected = [[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3], [4, 5, 6]]
    assert sorted(map(sorted, triangles.tolist())) == sorted(expected)


def test_a_file_without_the_field_states_no_axes(tmp_path: Path) -> None:
    content = VtpFile().piece(SQUARE, [(0, 1, 2)]).content()
    assert stated_axes(at(tmp_path, content)) is None
    assert stated_axes(at(tmp_path, b"<VTKFile>")) is None


def test_a_field_behind_the_points_is_found(tmp_path: Path) -> None:
    organ = ball(level=2)
    file = VtpFile("appended").piece(1e3 * organ.vertices, organ.faces.tolist()).axes("LPS")
    assert stated_axes(at(tmp_path, file.content())) == "LPS"


GOOD = VtpFile("binary", "vtkZLibDataCompressor").piece(SQUARE, [(0, 1, 2)]).content()
RAW = VtpFile("raw").piece(SQUARE, []).content()
BAD = {
    "no PolyData": b"<VTKFile type='ImageData'><ImageData/></VTKFile>",
    "document type": b"<!DOCTYPE a [<!ENTITY b 'c'>]>" + GOOD,
    "vtkLZ4DataCompressor": GOOD.replace(b"vtkZLibData", b"vtkLZ4Data"),
    "do not exist": VtpFile().piece(SQUARE, [(0, 1, 4)]).content(),
    "do not divide": VtpFile().piece(SQUARE, [(0, 1, 2)]).content().replace(b"\n3\n", b"\n2\n"),
    "before what it announces": RAW[: RAW.index(b"   _") + 50],
}


@pytest.mark.parametrize("words", BAD)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, words: str) -> None:
    refused(at(tmp_path, BAD[words]), words)


@pytest.mark.parametrize(
    ("claim", "words"), [(2**31, "more than it can hold"), (0, "claims to hold nothing")]
)
def test_a_block_that_claims_what_it_cannot_hold_is_not_unpacked(
    tmp_path: Path, claim: int, words: str
) -> None:
    packed = zlib.compress(bytes(24))
    sizes = np.array([1, claim, 0, len(packed)], "<u4").tobytes()
    data = base64.b64encode(sizes) + base64.b64encode(packed)
    text = f'<DataArray type="Float64" Name="Points" format="binary">{data.decode()}</DataArray>'
    content = (
        '<VTKFile type="PolyData" compressor="vtkZLibDataCompressor"><PolyData><Piece>'
        f"<Points>{text}</Points></Piece></PolyData></VTKFile>"
    )
    refused(at(tmp_path, content.encode()), words)
