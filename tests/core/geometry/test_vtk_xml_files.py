"""VTK's XML files: every encoding gives the same surface, or one line says why not."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path

import numpy as np
import pytest

from avatar_core.errors import SurfaceError
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import read_surface
from avatar_core.geometry.surface_files import parse, stated_axes
from tests.helpers.vtp_writer import COMPRESSORS, ENCODINGS, VtpFile

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
FORMS = [
    (encoding, compressor)
    for encoding in ENCODINGS
    for compressor in COMPRESSORS
    if encoding != "ascii" or not compressor
]


def at(folder: Path, content: bytes) -> Path:
    path = folder / "organ.vtp"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(("encoding", "compressor"), FORMS)
def test_every_encoding_gives_the_same_organ(
    tmp_path: Path, encoding: str, compressor: str
) -> None:
    organ = phantom_liver(12e-3)
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
    organ = phantom_liver(12e-3)
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
    with pytest.raises(SurfaceError, match=words) as caught:
        parse(at(tmp_path, BAD[words]), None)
    assert "\n" not in str(caught.value)


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
    with pytest.raises(SurfaceError, match=words):
        parse(at(tmp_path, content.encode()), None)
