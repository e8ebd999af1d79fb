"""Polygonal data in VTK's XML files (.vtp), in all of their encodings.

``VTKFile > PolyData > Piece`` holds ``Points``, ``Polys`` and ``Strips``. Each is an array written
as text, inline in base64, or appended after everything else in base64 or raw. Arrays other than
text begin with their sizes and may be compressed in blocks. Claimed sizes are compared with the
file before memory is allocated. No document type is read.

https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

from __future__ import annotations

import base64
import lzma
import zlib
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray, IntArray, Soup
from avatar_core.geometry.vtk_files import fans, strips

_TYPES = {f"Int{8 * n}": f"i{n}" for n in (1, 2, 4, 8)}
_TYPES |= {f"UInt{8 * n}": f"u{n}" for n in (1, 2, 4, 8)}
_TYPES |= {"Float32": "f4", "Float64": "f8", "String": "u1"}
_APPENDED = b"<AppendedData"
_MOST = 1100  # times that zlib makes anything smaller
_AXES = "SPACE"  # the field in which 3D Slicer states them


def read_vtp(content: bytes) -> Soup:
    """Return points and triangles of all pieces; polygons become fans.

    The triangles of strips come last in each piece.

    Returns
    -------
    points : ndarray, shape (n, 3)
    triangles : ndarray of int, shape (m, 3)

    Raises
    ------
    ValueError and errors of the parsers
        If the file is no .vtp file, ends too early, or contradicts itself, e.g. names missing
        corners.
    """
    file = _File(content)
    points: list[FloatArray] = [np.empty((0, 3))]
    triangles: list[IntArray] = [np.empty((0, 3), dtype=np.int64)]
    for piece in file.polydata.findall("Piece"):
        here = file.points(piece)
        for name, split in (("Polys", fans), ("Strips", strips)):
            found = split(*file.cells(piece, name))
            if len(found) and not 0 <= found.min() <= found.max() < len(here):
                raise ValueError(f"its {name} have corners that do not exist")
            triangles.append(found + sum(map(len, points)))
        points.append(here)
    return np.concatenate(points), np.concatenate(triangles)


def stated_axes_of(content: bytes) -> str:
    """Return the axes that the file's field data state; empty if none."""
    file = _File(content)
    for array in file.polydata.iterfind("FieldData/*"):
        if array.get("Name") == _AXES:
            return bytes(file.numbers(array)).decode("latin-1").rstrip("\0")
    return ""


class _File:
    """The elements of a file, and the data appended to them."""

    def __init__(self, content: bytes) -> None:
        head, appended, tail = content.partition(_APPENDED)
        if b"<!" in head.replace(b"<!--", b""):
            raise ValueError("it declares a document type")
        self._root = ElementTree.fromstring(head + b"</VTKFile>" if appended else content)
        attributes, _, data = tail.partition(b">")
        self._is_raw = b"raw" in attributes
        self._appended = data.lstrip()[1:]  # behind an underscore
        polydata = self._root.find("PolyData")
        if self._root.tag != "VTKFile" or polydata is None:
            raise ValueError("it holds no PolyData")
        self.polydata = polydata
        self._order = ">" if self._root.get("byte_order") == "BigEndian" else "<"
        self._size = np.dtype(self._order + _TYPES[self._root.get("header_type", "UInt32")])

    def points(self, piece: Element) -> FloatArray:
        """Return the points of a piece, shape (n, 3)."""
        array = piece.find("Points/DataArray")
        if array is None:
            return np.empty((0, 3))
        with np.errstate(invalid="ignore"):  # some bytes are signalling NaN
            return self.numbers(array).astype(np.float64).reshape(-1, 3)

    def cells(self, piece: Element, name: str) -> tuple[IntArray, IntArray]:
        """Return where each cell begins and the last ends, and the corners."""
        arrays = {array.get("Name"): array for array in piece.iterfind(f"{name}/DataArray")}
        if not {"offsets", "connectivity"} <= arrays.keys():
            return np.zeros(1, dtype=np.int64), np.empty(0, dtype=np.int64)
        ends, corners = (
            self.numbers(arrays[part]).astype(np.int64) for part in ("offsets", "connectivity")
        )
        starts = np.concatenate([np.zeros(1, dtype=np.int64), ends])
        if starts[-1] != len(corners) or (np.diff(starts) < 0).any():
            raise ValueError("its offsets do not divide the corners into cells")
        return starts, corners

    def numbers(self, array: Element) -> NDArray[Any]:
        """Return the numbers of an array, shape (n,)."""
        kind = np.dtype(self._order + _TYPES[array.get("type", "")])
        form, text = array.get("format"), (array.text or "").strip()
        if form == "ascii":
            return np.array(text.split(), dtype=kind)
        if form == "appended":
            data = self._appended[int(array.get("offset", "")) :]
        elif form == "binary":
            data = text.encode("ascii")
        else:
            raise ValueError(f"arrays of format {str(form)[:20]!r} are not read")
        return np.frombuffer(self._bytes(data, self._is_raw and form == "appended"), kind)

    def _bytes(self, data: bytes, is_raw: bool) -> bytes:
        """Return the bytes of an array behind its sizes."""
        compressor = self._root.get("compressor")
        if compressor is None:
            (n_bytes,) = self._sizes(data, 1, is_raw)
            return _part(data, self._size.itemsize, n_bytes, is_raw)
        (n_blocks,) = self._sizes(data, 1, is_raw)
        _, whole, last, *packed = self._sizes(data, 3 + n_blocks, is_raw)
        header = (3 + n_blocks) * self._size.itemsize
        data = data[header if is_raw else _n_letters(header) :]
        blocks, at, out = _part(data, 0, sum(packed), is_raw), 0, []
        for k, n in enumerate(packed):
            size = last if k == n_blocks - 1 and last else whole
            out.append(_unpacked(blocks[at : at + n], size, compressor))
            at += n
        return b"".join(out)

    def _sizes(self, data: bytes, n: int, is_raw: bool) -> list[int]:
        header = _part(data, 0, n * self._size.itemsize, is_raw)
        return [int(size) for size in np.frombuffer(header, self._size)]


def _n_letters(n_bytes: int) -> int:
    """Return the length of so many bytes in base64."""
    return -(-n_bytes // 3) * 4


def _part(data: bytes, start: int, n: int, is_raw: bool) -> bytes:
    """Return ``n`` bytes from ``start`` on, of raw data or base64."""
    end = start + n
    part = data[:end] if is_raw else base64.b64decode(data[: _n_letters(end)])[:end]
    if len(part) < end:
        raise ValueError(f"it ends {end - len(part)} byte(s) before what it announces")
    return part[start:]


def _unpacked(block: bytes, size: int, compressor: str) -> bytes:
    """Return a block that holds ``size`` bytes."""
    if size > _MOST * (len(block) + 64):
        raise ValueError("a block claims more than it can hold")
    if size == 0:  # to a decompressor, no limit
        raise ValueError("a block claims to hold nothing")
    if compressor == "vtkZLibDataCompressor":
        out = zlib.decompressobj().decompress(block, size)
    elif compressor == "vtkLZMADataCompressor":
        out = lzma.LZMADecompressor().decompress(block, size)
    else:
        raise ValueError(f"{compressor[:30]} is not read; write it with zlib or none")
    if len(out) != size:
        raise ValueError("a block holds less than it claims")
    return out
