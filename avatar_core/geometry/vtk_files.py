"""Surfaces in legacy VTK files, versions 1 to 5.1, in ASCII and binary (big endian).

A file is five lines of header and then sections, each a keyword with counts and its numbers.
``POINTS`` are read. ``POLYGONS``, ``TRIANGLE_STRIPS``, and ``CELLS`` with ``CELL_TYPES`` become
triangles. ``VERTICES``, ``LINES``, ``METADATA`` and ``FIELD`` are skipped. Reading ends at
``POINT_DATA`` or ``CELL_DATA``, behind which there is no geometry. Counts are compared with the
file's size before memory is allocated.
"""

from __future__ import annotations

import re
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray, IntArray, Soup

Cells = tuple[IntArray, IntArray]  # where each cell begins and the last ends, and the corners

_TYPES = {
    "unsigned_char": ">u1",
    "char": ">i1",
    "unsigned_short": ">u2",
    "short": ">i2",
    "unsigned_int": ">u4",
    "int": ">i4",
    "unsigned_long": ">u8",
    "long": ">i8",
    "vtkidtype": ">i4",  # VTK writes its indices as int
    "vtktypeint32": ">i4",
    "vtktypeint64": ">i8",
    "vtktypeuint32": ">u4",
    "vtktypeuint64": ">u8",
    "float": ">f4",
    "double": ">f8",
}
_CELLS = ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS")
_DATASETS = ("POLYDATA", "UNSTRUCTURED_GRID")
_POLYGONS, _STRIP = (5, 7, 9), 6  # cell types: triangle, polygon, quadrilateral; triangle strip
_WORD = re.compile(rb"\S+")
_VERSION = re.compile(rb"# vtk DataFile Version +([1-9]\d?)(\.\d+)?\s*", re.IGNORECASE)
_NEWEST = 5


def read_vtk(content: bytes) -> Soup:
    """Return points and triangles of a legacy VTK file of polygonal data or an unstructured grid.

    Polygons of more than three corners become fans about their first corner; smaller ones give no
    triangle. The triangles of strips come last. Whether their corners exist is not checked.

    Returns
    -------
    points : ndarray, shape (n, 3)
    triangles : ndarray of int, shape (m, 3)

    Raises
    ------
    ValueError, OverflowError
        If the file is no VTK surface, ends too early, or contradicts itself.
    """
    return _Reader(content).surface()


class _Reader:
    """A place in the content of a file, which moves on as the file is read."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0
        self._version = 0
        self._binary = False

    def surface(self) -> Soup:
        self._header()
        points: FloatArray = np.empty((0, 3))
        polygons = in_strips = _no_triangles()
        cells: Cells = np.zeros(1, dtype=np.int64), np.empty(0, dtype=np.int64)
        while (keyword := self._word()) not in ("", "POINT_DATA", "CELL_DATA"):
            if keyword == "DATASET":
                self._expect(*_DATASETS)
            elif keyword == "POINTS":
                points = self._points()
            elif keyword == "POLYGONS":
                polygons = fans(*self._cells())
            elif keyword == "TRIANGLE_STRIPS":
                in_strips = strips(*self._cells())
            elif keyword == "CELLS":
                cells = self._cells()
            elif keyword == "CELL_TYPES":
                kinds = self._numbers(self._count(), np.dtype(">i4"))
                polygons = fans(*_chosen(cells, np.isin(kinds, _POLYGONS)))
                in_strips = strips(*_chosen(cells, kinds == _STRIP))
            else:
                self._skip(keyword)
        return points, np.vstack([polygons, in_strips])

    # --- sections -------------------------------------------------------------------------------

    def _header(self) -> None:
        """Read version, title, and ASCII or BINARY: three lines."""
        version = _VERSION.fullmatch(self._line())
        if version is None:
            raise ValueError("it does not begin with '# vtk DataFile Version'")
        self._version = int(version[1])
        if self._version > _NEWEST:
            raise ValueError(f"version {self._version} is not known, only up to {_NEWEST}.1")
        self._line()
        form = self._line().strip().upper()
        if form not in (b"ASCII", b"BINARY"):
            raise ValueError("its third line is neither ASCII nor BINARY")
        self._binary = form == b"BINARY"

    def _points(self) -> FloatArray:
        n = self._count()
        kind = self._type()
        values = self._numbers(3 * n, kind)
        with np.errstate(invalid="ignore"):  # some bytes are signalling NaN
            return values.astype(np.float64).reshape(n, 3)

    def _cells(self) -> Cells:
        """Read cells of any number of corners: counts before the corners, or since 5.0 offsets."""
        n, size = self._count(), self._count()
        if self._version < 5:
            return _split(self._numbers(size, np.dtype(">i4")), n)
        if n == 0:
            return np.zeros(1, dtype=np.int64), np.empty(0, dtype=np.int64)
        self._expect("OFFSETS")
        starts = self._numbers(n, self._type(of_indices=True)).astype(np.int64)
        self._expect("CONNECTIVITY")
        corners = self._numbers(size, self._type(of_indices=True)).astype(np.int64)
        if starts[0] != 0 or starts[-1] != size or (starts[1:] < starts[:-1]).any():
            raise ValueError("its offsets do not divide the corners into cells")
        return starts, corners

    def _skip(self, keyword: str) -> None:
        """Pass over a section that holds no surface."""
        if keyword in _CELLS:
            self._cells()
        elif keyword == "METADATA":
            self._skip_metadata()
        elif keyword == "FIELD":
            self._word()
            for _ in range(self._count()):
                self._skip_array()
        else:
            raise ValueError(f"unknown section {keyword[:20]!r}")

    def _skip_metadata(self) -> None:
        """Pass over metadata, which end with an empty line."""
        self._line()
        while self._line().strip():
            pass

    def _skip_array(self) -> None:
        """Pass over an array of a field: its name, components, tuples, type and numbers."""
        name = self._word()
        if name == "METADATA":  # metadata of the array before
            self._skip_metadata()
            name = self._word()
        if not name:
            raise ValueError("it ends within a field")
        count = self._count() * self._count()
        if self._peek() == "STRING":
            self._word()
            self._skip_strings(count)
        else:
            self._numbers(count, self._type())

    def _skip_strings(self, count: int) -> None:
        """Pass over strings from the next line on: one a line, or each after its length."""
        self._line()
        self._require(count)
        for _ in range(count):
            if self._binary:
                self._skip_binary_string()
            else:
                self._line()

    def _skip_binary_string(self) -> None:
        """Pass over a string after its length.

        The highest two bits of the length say whether it has 8, 4, 2 or 1 bytes.
        """
        self._require(1)
        n_bytes = 8 >> (self._content[self._at] >> 6)
        self._require(n_bytes)
        length = int.from_bytes(self._content[self._at : self._at + n_bytes], "big")
        length %= 1 << (8 * n_bytes - 2)
        self._require(n_bytes + length)
        self._at += n_bytes + length

    # --- words and numbers ----------------------------------------------------------------------

    def _line(self) -> bytes:
        """Return the rest of this line without its end; empty at the end of the file."""
        end = self._content.find(b"\n", self._at)
        end = len(self._content) if end < 0 else end
        line, self._at = self._content[self._at : end], end + 1
        return line

    def _word(self) -> str:
        """Return the next word in capitals; empty at the end of the file."""
        match = _WORD.search(self._content, self._at)
        if match is None:
            return ""
        self._at = match.end()
        return match[0].decode("latin-1").upper()

    def _peek(self) -> str:
        """Return the next word, which is read again."""
        before = self._at
        word = self._word()
        self._at = before
        return word

    def _require(self, n_bytes: int) -> None:
        left = len(self._content) - self._at
        if n_bytes > left:
            raise ValueError(f"it ends {n_bytes - left} byte(s) before what it announces")

    def _expect(self, *words: str) -> None:
        found = self._word()
        if found not in words:
            raise ValueError(f"{' or '.join(words)} expected, not {found[:20]!r}")

    def _count(self) -> int:
        word = self._word()
        if not word.isdecimal() or len(word) > 18:
            raise ValueError(f"a count expected, not {word[:20]!r}")
        return int(word)

    def _type(self, of_indices: bool = False) -> np.dtype[Any]:
        name = self._word().lower()
        kind = np.dtype(_TYPES[name]) if name in _TYPES else None
        if kind is None or (of_indices and kind.kind == "f"):
            raise ValueError(f"numbers of type {name[:20]!r} are not read")
        return kind

    def _numbers(self, count: int, kind: np.dtype[Any]) -> NDArray[Any]:
        """Return the next numbers, shape (count,); binary ones begin with the next line."""
        if self._binary:
            self._line()
        self._require(count * kind.itemsize if self._binary else 2 * count - 1)
        return self._binary_numbers(count, kind) if self._binary else self._words(count, kind)

    def _binary_numbers(self, count: int, kind: np.dtype[Any]) -> NDArray[Any]:
        values = np.frombuffer(self._content, kind, count, self._at) if count else np.empty(0, kind)
        self._at += count * kind.itemsize
        return values

    def _words(self, count: int, kind: np.dtype[Any]) -> NDArray[Any]:
        values = np.empty(count, kind.newbyteorder("="))
        number = float if kind.kind == "f" else int
        found, end = 0, self._at
        with np.errstate(over="ignore"):  # a float beyond single precision is infinite
            for word in islice(_WORD.finditer(self._content, self._at), count):
                values[found] = number(word[0])
                found, end = found + 1, word.end()
        if found < count:
            raise ValueError(f"it ends after {found} of {count} numbers")
        self._at = end
        return values


# --- cells to triangles ---------------------------------------------------------------------------


def _no_triangles() -> IntArray:
    return np.empty((0, 3), dtype=np.int64)


def _split(row: NDArray[Any], n: int) -> Cells:
    """Return the n cells of a row [k, corner 1, ..., corner k, ...]; ValueError if n is wrong."""
    if n > len(row):
        raise ValueError(f"{n} cells do not fit into {len(row)} numbers")
    counts = np.empty(n, dtype=np.int64)
    at = 0
    for cell in range(n):
        count = int(row[at]) if at < len(row) else -1
        if count < 0:
            raise ValueError(f"the corners of cell {cell} of {n} are not where they should be")
        counts[cell] = count
        at += 1 + count
    if at != len(row):
        raise ValueError(f"{n} cells take {at} numbers, not {len(row)}")
    starts = np.concatenate([[0], np.cumsum(counts)])
    return starts, np.delete(row, starts[:-1] + np.arange(n)).astype(np.int64)


def _chosen(cells: Cells, kept: NDArray[Any]) -> Cells:
    """Return the cells that a mask (n,) keeps."""
    starts, corners = cells
    lengths = np.diff(starts)
    if len(kept) != len(lengths):
        raise ValueError(f"{len(lengths)} cells have {len(kept)} types")
    return np.concatenate([[0], np.cumsum(lengths[kept])]), corners[np.repeat(kept, lengths)]


def _windows(starts: IntArray) -> tuple[IntArray, IntArray]:
    """Return the first corner of each triangle's cell, and the triangle's place in its cell.

    A cell of k corners makes k - 2 triangles, and none for fewer than three. Shapes (m,), (m,).
    """
    numbers = np.maximum(np.diff(starts) - 2, 0)
    first = np.repeat(starts[:-1], numbers)
    place = np.arange(len(first)) - np.repeat(np.cumsum(numbers) - numbers, numbers)
    return first, place


def fans(starts: IntArray, corners: IntArray) -> IntArray:
    """Return the polygons as triangles about their first corners, shape (m, 3)."""
    first, place = _windows(starts)
    return corners[np.column_stack([first, first + place + 1, first + place + 2])]


def strips(starts: IntArray, corners: IntArray) -> IntArray:
    """Return the triangles of strips, every second one turned to face one way, shape (m, 3)."""
    first, place = _windows(starts)
    turned = place % 2
    at = first + place
    return corners[np.column_stack([at + turned, at + 1 - turned, at + 2])]
