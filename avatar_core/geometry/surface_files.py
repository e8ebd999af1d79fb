"""Surface file formats: each reader returns vertices and triangles, unconnected and unchecked.

Meshes give triangles in the file's coordinates. A label map gives the surface of one label
(:mod:`avatar_core.geometry.label_maps`). This module checks only that the file can be read;
:mod:`avatar_core.geometry.surface` decides.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from avatar_core.common import files
from avatar_core.common.arrays import IntArray, Soup
from avatar_core.errors import SurfaceError, one_line
from avatar_core.geometry.label_files import is_label_map
from avatar_core.geometry.label_maps import surface_of_label
from avatar_core.geometry.ply_files import read_ply
from avatar_core.geometry.surface_formats import (
    BYTE_ORDER_MARK,
    MAX_FILE_BYTES,
    MESHES,
    SUFFIXES,
    kind_of,
)
from avatar_core.geometry.vtk_files import read_vtk
from avatar_core.geometry.vtk_xml_files import read_vtp, stated_axes_of

HEADER_BYTES = 1 << 16  # first bytes of a file, where its axes are sought


@dataclass(frozen=True)
class Format:
    """Reader of one mesh format.

    read : function that returns vertices (n, 3) and triangles (m, 3) of a file's content
    comments : function that returns the part of a file's head that may state its axes; None if the
        format has none
    """

    read: Callable[[bytes], Soup]
    comments: Callable[[bytes], bytes] | None = None


def content_of(path: Path) -> bytes:
    """Return the file's bytes, for its hash; SurfaceError if it is no ordinary file."""
    with _naming(path), files.opened(path, MAX_FILE_BYTES) as source:
        return files.content_of(source)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Turn an error of the operating system into a SurfaceError that names the file."""
    try:
        yield
    except (files.FileError, OSError) as error:
        raise SurfaceError(
            f"cannot read {path}: {error}; check the path and its permissions"
        ) from error


def stated_axes(path: Path) -> str | None:
    """Return the axes that a file's header states, "RAS" or "LPS"; None if it states none.

    3D Slicer writes ``SPACE=LPS`` or ``SPACE=RAS`` into the header of STL, the comments of OBJ and
    PLY, and the title of legacy VTK. In VTK's XML it writes ``LPS`` or ``RAS`` as the field
    ``SPACE``, which alone may lie beyond the first ``HEADER_BYTES``. Label maps say where their
    voxels lie, and are read in RAS.

    Raises SurfaceError if there is no ordinary file of that name.
    """
    if is_label_map(path):
        return "RAS"
    kind = kind_of(path)
    comments_of = _FORMATS[kind].comments if kind in MESHES else None
    if comments_of is None:
        return None
    with _naming(path), files.opened(path, MAX_FILE_BYTES) as source:
        head = source.read(-1 if kind == ".vtp" else HEADER_BYTES)
    head = head.removeprefix(BYTE_ORDER_MARK)
    found = re.search(rb"\bSPACE=(RAS|LPS)\b", comments_of(head), re.IGNORECASE)
    return found[1].decode().upper() if found else None


def _obj_comments(head: bytes) -> bytes:
    return b"\n".join(line for line in head.splitlines() if line.lstrip().startswith(b"#"))


def _ply_comments(head: bytes) -> bytes:
    lines = head.partition(b"end_header")[0].splitlines()
    return b"\n".join(line for line in lines if line.startswith(b"comment"))


def _stl_comments(head: bytes) -> bytes:
    """Return the line ``solid`` of a text file, or the 80 bytes that begin a binary one."""
    is_text = head.startswith(b"solid") and b"\0" not in head
    return head.partition(b"\n")[0] if is_text else head[:80]


def _vtk_comments(head: bytes) -> bytes:
    """Return the title, which is the second line."""
    return b"".join(head.splitlines()[1:2])


def _vtp_comments(content: bytes) -> bytes:
    """Return the field ``SPACE``; nothing for a broken file, which is refused later, on reading."""
    with suppress(Exception):
        return f"SPACE={stated_axes_of(content)}".encode()
    return b""


def parse(path: Path, label: int | str | None = None) -> Soup:
    """Return the vertices (n, 3) in the file's unit and axes, and triangles (m, 3)."""
    return parsed(path, label)[0]


def parsed(
    path: Path,
    label: int | str | None = None,
    inside: Sequence[str] = (),
    is_organ: bool = True,
    mm: float = 1.0,
) -> tuple[Soup, tuple[str, ...]]:
    """Return the result of :func:`parse`, and notices of a label map.

    For label, inside, is_organ and mm see :func:`avatar_core.geometry.label_maps.surface_of_label`.
    """
    kind = kind_of(path)
    if not kind:
        raise SurfaceError(f"{path.name}: format not supported; use {', '.join(SUFFIXES)}")
    try:
        if is_label_map(path):
            return surface_of_label(path, label, inside, is_organ, mm)
        if label is not None:
            raise SurfaceError(
                f"{path.name} is a surface, which has no label {label}; leave it out"
            )
        return _FORMATS[kind].read(content_of(path).removeprefix(BYTE_ORDER_MARK)), ()
    except SurfaceError:
        raise
    except Exception as error:  # of parsers, each with errors of its own
        raise SurfaceError(
            f"{path.name}: not a readable {kind[1:].upper()} file ({one_line(error, 80)}); "
            "export it again"
        ) from error


def _read_obj(content: bytes) -> Soup:
    """Return the triangles of a Wavefront OBJ: v, and f as a, a/b, a//c, a/b/c, -1 or a polygon."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for line in content.decode("utf-8", errors="replace").splitlines():
        words = line.split()
        if words and words[0] == "v":
            vertices.append([float(word) for word in words[1:4]])
        elif words and words[0] == "f":
            indices = [int(word.split("/")[0]) for word in words[1:]]
            polygons.append([i - 1 if i > 0 else len(vertices) + i for i in indices])
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), _fan(polygons)


def _fan(polygons: Iterable[Iterable[int]]) -> IntArray:
    """Split polygons into fans of triangles about their first corner, shape (m, 3)."""
    triangles = [
        (corners[0], b, c) for corners in map(list, polygons) for b, c in pairwise(corners[1:])
    ]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _read_stl(content: bytes) -> Soup:
    """Return the triangles of an STL, in text or binary with anything after its last triangle."""
    n = int.from_bytes(content[80:84], "little")
    if 0 < 84 + 50 * n <= len(content):  # a text would have to be of gigabytes
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.frombuffer(content, record, n, 84)["corners"].reshape(-1, 3)
    elif content.lstrip()[:5].lower() == b"solid" and b"\0" not in content[:512]:
        words = re.findall(rb"\svertex\s+(\S+)\s+(\S+)\s+(\S+)", content, re.IGNORECASE)
        corners = np.array(words, np.float64).reshape(-1, 3)
    else:
        raise ValueError(f"it ends before the last of its {n} triangles")
    with np.errstate(invalid="ignore"):  # some bytes are signalling NaN
        points, index = np.unique(corners.astype(np.float64), axis=0, return_inverse=True)
    return points, index.reshape(-1, 3)


def _read_off(content: bytes) -> Soup:
    """Return the triangles of an OFF in text, with or without colours, normals and texture.

    Its keywords are OFF, COFF, NOFF and STOFF.
    """
    text = content.decode("utf-8", errors="replace")
    begin = re.match(r"\s*(ST)?C?N?OFF(?![A-Za-z])", text)
    if begin is None or "BINARY" in text[: begin.end() + 10]:
        raise ValueError("it does not begin with OFF or COFF, or is binary; save it as text")
    lines = [line.partition("#")[0].split() for line in text[begin.end() :].splitlines()]
    (counts, *rows) = filter(None, lines)
    n, m = (int(word) for word in counts[:2])
    if min(n, m) < 0 or n + m > len(rows):
        raise ValueError(f"it ends after {len(rows)} of {n + m} vertices and faces")
    points = np.array([[float(word) for word in row[:3]] for row in rows[:n]], np.float64)
    # Behind its corners, a face has its colour.
    polygons = [[int(word) for word in row[: 1 + int(row[0])]] for row in rows[n : n + m]]
    if any(len(polygon) != 1 + polygon[0] for polygon in polygons):
        raise ValueError("a face has fewer corners than it announces")
    return points.reshape(-1, 3), _fan(polygon[1:] for polygon in polygons)


_FORMATS = {
    ".obj": Format(_read_obj, _obj_comments),
    ".stl": Format(_read_stl, _stl_comments),
    ".ply": Format(read_ply, _ply_comments),
    ".vtk": Format(read_vtk, _vtk_comments),
    ".vtp": Format(read_vtp, _vtp_comments),
    ".off": Format(_read_off),
}
