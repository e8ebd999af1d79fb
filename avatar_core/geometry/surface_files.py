"""Surface file formats: each reader returns vertices and triangles, unconnected and unchecked.

Meshes give triangles in the file's coordinates. Of label maps
(:mod:`avatar_core.geometry.label_maps`) the surface of one label is made.
Nothing is checked here but that the file can be read; :mod:`avatar_core.geometry.surface` decides.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from avatar_core.common import files
from avatar_core.common.arrays import IntArray, Soup
from avatar_core.errors import SurfaceError, one_line
from avatar_core.geometry.label_files import is_label_map
from avatar_core.geometry.label_maps import surface_of_label
from avatar_core.geometry.surface_formats import MESHES, SUFFIXES
from avatar_core.geometry.vtk_files import read_polydata
from avatar_core.geometry.vtk_xml_files import read_vtp, stated_axes_of

MAX_FILE_BYTES = 4 << 30
HEADER_BYTES = 1 << 16  # of a file in which its axes are looked for


@dataclass(frozen=True)
class Format:
    """How one format of meshes is read.

    read : vertices (n, 3) and triangles (m, 3) of a file
    comments : the part of a file's head that may state its axes; None if the format has none
    """

    read: Callable[[Path], Soup]
    comments: Callable[[bytes], bytes] | None = None


def content_of(path: Path) -> bytes:
    """The file's bytes, for its hash; SurfaceError if there is no such ordinary file."""
    try:
        with files.opened(path, MAX_FILE_BYTES) as source:
            return files.content_of(source)
    except files.FileError as error:
        raise SurfaceError(
            f"cannot read {path}: {error}; check the path and its permissions"
        ) from error


def stated_axes(path: Path) -> str | None:
    """The axes that a file's header states, "RAS" or "LPS"; None if it states none.

    3D Slicer writes ``SPACE=LPS`` or ``SPACE=RAS`` into the header of STL, the comments of OBJ and
    PLY, and the title of legacy VTK, and ``LPS`` or ``RAS`` as the field ``SPACE`` of VTK's XML,
    which alone may lie behind the first ``HEADER_BYTES``. Label maps say where their voxels lie,
    and are read in RAS.

    Raises SurfaceError if there is no such ordinary file.
    """
    if is_label_map(path):
        return "RAS"
    kind = path.suffix.lower()
    comments_of = _FORMATS[kind].comments if kind in MESHES else None
    if comments_of is None:
        return None
    try:
        with files.opened(path, MAX_FILE_BYTES) as source:
            head = source.read(-1 if kind == ".vtp" else HEADER_BYTES)
    except (files.FileError, OSError) as error:
        raise SurfaceError(
            f"cannot read {path}: {error}; check the path and its permissions"
        ) from error
    found = re.search(rb"\bSPACE=(RAS|LPS)\b", comments_of(head), re.IGNORECASE)
    return found[1].decode().upper() if found else None


def _obj_comments(head: bytes) -> bytes:
    return b"\n".join(line for line in head.splitlines() if line.lstrip().startswith(b"#"))


def _ply_comments(head: bytes) -> bytes:
    lines = head.partition(b"end_header")[0].splitlines()
    return b"\n".join(line for line in lines if line.startswith(b"comment"))


def _stl_comments(head: bytes) -> bytes:
    """The line ``solid`` of a text file, the 80 bytes before the triangles of a binary one."""
    is_text = head.startswith(b"solid") and b"\0" not in head
    return head.partition(b"\n")[0] if is_text else head[:80]


def _vtk_comments(head: bytes) -> bytes:
    """The title, which is the second line."""
    return b"".join(head.splitlines()[1:2])


def _vtp_comments(content: bytes) -> bytes:
    """The field of that name; nothing of a file that is refused later, when it is read."""
    with suppress(Exception):
        return f"SPACE={stated_axes_of(content)}".encode()
    return b""


def parse(path: Path, label: int | str | None, inside: Sequence[str] = ()) -> Soup:
    """Vertices (n, 3) in the file's unit and axes, and triangles (m, 3).

    label, inside : as of :func:`avatar_core.geometry.label_maps.surface_of_label`
    """
    kind = ".nii" if path.name.lower().endswith(".nii.gz") else path.suffix.lower()
    if kind not in SUFFIXES:
        raise SurfaceError(f"{path.name}: format not supported; use {', '.join(SUFFIXES)}")
    try:
        if is_label_map(path):
            return surface_of_label(path, label, inside)
        return _FORMATS[kind].read(path)
    except SurfaceError:
        raise
    except Exception as error:  # of parsers, each with errors of its own
        raise SurfaceError(
            f"{path.name}: not a readable {kind[1:].upper()} file ({one_line(error, 80)}); "
            "export it again"
        ) from error


def _read_obj(path: Path) -> Soup:
    """Wavefront OBJ: v, and f in all its forms (a, a/b, a//c, a/b/c, -1, polygons).

    Own code because meshio refuses files whose texture and vertex counts differ, and misreads
    negative indices.
    """
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if words and words[0] == "v":
            vertices.append([float(word) for word in words[1:4]])
        elif words and words[0] == "f":
            indices = [int(word.split("/")[0]) for word in words[1:]]
            polygons.append([i - 1 if i > 0 else len(vertices) + i for i in indices])
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), _fan(polygons)


def _fan(polygons: Iterable[Iterable[int]]) -> IntArray:
    """Split polygons into triangles that share their first corner, shape (m, 3)."""
    triangles = [
        (corners[0], b, c) for corners in map(list, polygons) for b, c in pairwise(corners[1:])
    ]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _by_meshio(reader: str) -> Callable[[Path], Soup]:
    """Reader of one format by meshio (asked directly: `meshio.read` prints and exits)."""

    def read(path: Path) -> Soup:
        import meshio

        with np.errstate(over="ignore"):  # its test for binary STL overflows on text
            mesh = getattr(meshio, reader).read(str(path))
        blocks = [c.data for c in mesh.cells if c.type in ("triangle", "quad", "polygon")]
        faces = [_fan(block.tolist()) for block in blocks]
        points = np.asarray(mesh.points, dtype=np.float64)
        return points, np.vstack(faces) if faces else np.empty((0, 3), dtype=np.int64)

    return read


def _read_vtk(path: Path) -> Soup:
    """Legacy VTK: polygonal data by our own reader, which meshio cannot read, the rest by it."""
    content = path.read_bytes()
    if b"POLYDATA" in content[:1024].upper():
        return read_polydata(content)
    return _by_meshio("vtk")(path)


_FORMATS = {
    ".obj": Format(_read_obj, _obj_comments),
    ".stl": Format(_by_meshio("stl"), _stl_comments),
    ".ply": Format(_by_meshio("ply"), _ply_comments),
    ".vtk": Format(_read_vtk, _vtk_comments),
    ".vtp": Format(lambda path: read_vtp(path.read_bytes()), _vtp_comments),
    ".off": Format(_by_meshio("off")),
}
