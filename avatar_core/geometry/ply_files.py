"""PLY files, ASCII and binary of both byte orders: vertices and faces among any other elements.

A header names elements, e.g. ``vertex``, ``face`` or PCL's ``camera``, with their counts. It lists
their properties in any order: numbers, or lists preceded by their lengths. An ASCII file is read
like a binary file of double precision. Counts are compared with the file's size before memory is
allocated.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray, IntArray, Soup
from avatar_core.geometry.vtk_files import Cells, fans

_TYPES = {
    name: kind
    for names, kind in (
        (("char", "int8"), "i1"),
        (("uchar", "uint8"), "u1"),
        (("short", "int16"), "i2"),
        (("ushort", "uint16"), "u2"),
        (("int", "int32"), "i4"),
        (("uint", "uint32"), "u4"),
        (("float", "float32"), "f4"),
        (("double", "float64"), "f8"),
    )
    for name in names
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")  # the second by older programs
_HEAD = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")


@dataclass(frozen=True)
class _Property:
    """A number, or a list of numbers after its length, whose type is ``count``."""

    name: str
    kind: np.dtype[Any]
    count: np.dtype[Any] | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    n: int
    properties: list[_Property]


def read_ply(content: bytes) -> Soup:
    """Return points (n, 3) and triangles (m, 3); polygons become fans, a cloud has no triangles.

    Raises
    ------
    ValueError
        If the file is no PLY file, ends too early, or contradicts itself.
    """
    elements, body = _parts(content)
    points: FloatArray = np.empty((0, 3))
    triangles: IntArray = np.empty((0, 3), dtype=np.int64)
    at = 0
    for element in elements:
        columns, at = _rows(element, body, at)
        if element.name == "vertex":
            points = _points(columns)
        elif element.name == "face" and element.n:
            found = next((columns[name] for name in _CORNERS if name in columns), None)
            if not isinstance(found, tuple):
                raise ValueError(f"its faces have no list {_CORNERS[0]}")
            triangles = fans(*found)
    return points, triangles


def _points(columns: dict[str, NDArray[Any] | Cells]) -> FloatArray:
    found = [columns.get(axis) for axis in "xyz"]
    if not all(isinstance(one, np.ndarray) for one in found):
        raise ValueError("its vertices have no x, y and z")
    with np.errstate(invalid="ignore"):  # some bytes are signalling NaN
        return np.column_stack(found).astype(np.float64)  # type: ignore[arg-type]


# --- header ---------------------------------------------------------------------------------------


def _parts(content: bytes) -> tuple[list[_Element], bytes]:
    """Return the elements in their order, and the rows of all of them in binary."""
    begin = _HEAD.match(content)
    if begin is None:
        raise ValueError("it does not begin with a line 'ply'")
    newline = re.escape(begin[1])
    end = re.search(newline + rb"end_header[ \t]*(" + newline + rb"|$)", content)
    if end is None:
        raise ValueError("its header has no end")
    lines = content[begin.end() : end.start()].decode("latin-1").splitlines()
    form, order, elements = "", "", []
    for words in filter(None, map(str.split, lines)):
        if words[0] == "format":
            form = words[1]
            order = "<" if form == "ascii" else _ORDERS.get(form, "")
        elif words[0] == "element":
            elements.append(_Element(words[1], _count(words[2]), []))
        elif words[0] == "property":
            elements[-1].properties.append(_property(words[1:], order, form == "ascii"))
    if not order:
        raise ValueError(f"its format {form[:20]!r} is not read")
    body = content[end.end() :]
    return elements, np.array(body.split(), "<f8").tobytes() if form == "ascii" else body


def _count(word: str) -> int:
    if not word.isdecimal() or len(word) > 18:
        raise ValueError(f"a count expected, not {word[:20]!r}")
    return int(word)


def _property(words: list[str], order: str, is_text: bool) -> _Property:
    """Return a property from ``float x``, or from ``list uchar int vertex_indices``."""
    kinds = words[1:-1] if words[0] == "list" else words[:-1]
    if len(kinds) != 1 + (words[0] == "list") or not all(kind in _TYPES for kind in kinds):
        raise ValueError(f"its property {' '.join(words)[:40]!r} is not read")
    types = [np.dtype("<f8" if is_text else order + _TYPES[kind]) for kind in kinds]
    return _Property(words[-1], types[-1], types[0] if len(types) > 1 else None)


# --- rows -----------------------------------------------------------------------------------------


def _rows(element: _Element, body: bytes, at: int) -> tuple[dict[str, NDArray[Any] | Cells], int]:
    """Return the columns of an element that begins at a place in the body, and where it ends.

    A column is an array (n,) of numbers, or cells: where each list begins, and the corners.
    """
    if not element.n or not element.properties:
        return {}, at
    first, _ = _row(element, body, at)
    fields: list[Any] = []
    for k, (one, values) in enumerate(zip(element.properties, first, strict=True)):
        fields += [(f"count {k}", one.count)] if one.count is not None else []
        fields.append((f"value {k}", one.kind, (len(values),)))
    record = np.dtype(fields)
    if element.n * record.itemsize <= len(body) - at:
        rows = np.frombuffer(body, record, element.n, at)
        if all((rows[name] == rows[name][0]).all() for name, *_ in fields if name[0] == "c"):
            columns = [rows[f"value {k}"] for k in range(len(element.properties))]
            return _named(element, columns), at + rows.nbytes
    table = []
    for _ in range(element.n):
        row, at = _row(element, body, at)
        table.append(row)
    return _named(element, list(zip(*table, strict=True))), at


def _row(element: _Element, body: bytes, at: int) -> tuple[list[NDArray[Any]], int]:
    """Return the numbers of each property in the row at a place, and where the row ends."""
    found = []
    for one in element.properties:
        n = 1
        if one.count is not None:
            length = _numbers(body, one.count, 1, at)
            n, at = int(_whole(length)[0]), at + length.nbytes
        found.append(_numbers(body, one.kind, n, at))
        at += found[-1].nbytes
    return found, at


def _numbers(body: bytes, kind: np.dtype[Any], n: int, at: int) -> NDArray[Any]:
    if n < 0 or n * kind.itemsize > len(body) - at:
        raise ValueError("it ends before what it announces")
    return np.frombuffer(body, kind, n, at) if n else np.empty(0, kind)


def _named(element: _Element, columns: list[Any]) -> dict[str, NDArray[Any] | Cells]:
    """Return the columns by name, from the numbers of each property."""
    named: dict[str, NDArray[Any] | Cells] = {}
    for one, rows in zip(element.properties, columns, strict=True):
        if one.count is None:
            named[one.name] = np.concatenate(rows)
        elif one.name in _CORNERS:
            starts = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
            named[one.name] = starts, _whole(np.concatenate(rows))
    return named


def _whole(numbers: NDArray[Any]) -> IntArray:
    """Return the numbers as integers; ValueError if they are none."""
    with np.errstate(invalid="ignore"):
        found = numbers.astype(np.int64)
    if (found != numbers).any():
        raise ValueError("a count or corner is no whole number")
    return found
