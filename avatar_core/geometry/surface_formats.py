"""Formats of files that may hold an organ's surface, by their suffixes.

Commands, messages and folder searches take the names from here, so help texts need no reader.
:mod:`avatar_core.geometry.surface_files` reads meshes, and :mod:`avatar_core.geometry.label_files`
label maps.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path

from avatar_core.common import files

MESHES = (".obj", ".stl", ".ply", ".vtk", ".vtp", ".off")
LABEL_MAPS = (".nii", ".nii.gz", ".nrrd", ".dcm")  # for DICOM, segmentations
SUFFIXES = (*MESHES, *LABEL_MAPS)

MESH_NAMES = ", ".join(suffix[1:].upper() for suffix in MESHES)
LABEL_MAP_NAMES = ", ".join(LABEL_MAPS)
MAX_FILE_BYTES = 4 << 30

# First bytes of files whose names tell no format, e.g. the UIDs that DICOM is stored under.
_BEGINNINGS = {
    ".nii": rb".{344}n\+1\0|.{4}n\+2\0",
    ".ply": rb"ply\s",
    ".stl": rb"(?i)\s*solid\s",
    ".vtk": rb"# vtk DataFile",
    ".vtp": rb"\s*<(\?xml|VTKFile)",
    ".off": rb"(ST)?C?N?OFF\s",
    ".obj": rb"(.*\n)?v\s+[-+.\d]",
    ".nrrd": rb"NRRD",
    ".dcm": rb".{128}DICM",
}
_LOOKED_AT = 1 << 12  # bytes of a file
GZIP = b"\x1f\x8b"  # with which its files begin
BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # of UTF-8, with which some programs begin texts


def kind_of(path: Path) -> str:
    """Return the suffix of a file's format, by its name or else its first bytes; "" if unknown."""
    name = path.name.lower()
    by_name = next((suffix for suffix in SUFFIXES if name.endswith(suffix)), "")
    if by_name:
        return by_name
    try:
        with files.opened(path, MAX_FILE_BYTES) as source:
            head = source.read(_LOOKED_AT).removeprefix(BYTE_ORDER_MARK)
            size = source.seek(0, 2)
    except (files.FileError, OSError):
        return ""
    is_packed = head.startswith(GZIP)
    if is_packed:
        head = _inflated(head)
    for suffix, beginning in _BEGINNINGS.items():
        if re.match(beginning, head, re.DOTALL):
            packed = f"{suffix}.gz"
            return suffix if not is_packed else packed if packed in SUFFIXES else ""
    n_triangles = int.from_bytes(head[80:84], "little")
    return ".stl" if n_triangles and size == 84 + 50 * n_triangles else ""


def _inflated(head: bytes) -> bytes:
    """Return the decompressed beginning of a gzip file; empty if it is damaged."""
    try:
        return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(head, _LOOKED_AT)
    except zlib.error:
        return b""
