"""Surface file formats: each reader returns vertices and triangles, unconnected and unchecked.

OBJ, STL, PLY, VTK and OFF give triangles in the file's coordinates; NIfTI label maps are meshed.
Nothing is checked here but that the file can be read; :mod:`avatar_core.geometry.surface` decides.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray

from avatar_core.common import files
from avatar_core.errors import SurfaceError, one_line
from avatar_core.geometry.vtk_files import read_polydata

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Soup = tuple[FloatArray, IntArray]

MAX_FILE_BYTES = 4 << 30
MAX_LABEL_BYTES = 2**30  # of a decompressed label map
LABEL_SPACING = 2.0  # label maps finer than this are averaged to it [mm]
HEADER_BYTES = 1 << 16  # of a file in which its axes are looked for


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
    PLY, and the title of legacy VTK. No more than ``HEADER_BYTES`` are read.

    Raises SurfaceError if there is no such ordinary file.
    """
    comments_of = _COMMENTS.get(path.suffix.lower())
    if comments_of is None:
        return None
    try:
        with files.opened(path, MAX_FILE_BYTES) as source:
            head = source.read(HEADER_BYTES)
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


_COMMENTS: dict[str, Callable[[bytes], bytes]] = {
    ".obj": _obj_comments,
    ".ply": _ply_comments,
    ".stl": _stl_comments,
    ".vtk": _vtk_comments,
}


def parse(path: Path, label: int | None) -> Soup:
    """Vertices (n, 3) in the file's unit and axes, and triangles (m, 3)."""
    kind = ".nii" if path.name.lower().endswith(".nii.gz") else path.suffix.lower()
    if kind not in _READERS:
        raise SurfaceError(f"{path.name}: format not supported; use {', '.join(_READERS)} (.gz)")
    try:
        return _read_label_map(path, label) if kind == ".nii" else _READERS[kind](path)
    except SurfaceError:
        raise
    except Exception as error:  # parsers of five formats, each with errors of its own
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


def _read_label_map(path: Path, label: int | None) -> Soup:
    """Surface of one label of a NIfTI volume, in its world coordinates (RAS by definition)."""
    import nibabel

    image: Any = nibabel.load(path)
    _require_loadable(path, image)
    values = np.squeeze(np.asanyarray(image.dataobj))
    if values.ndim != 3:
        raise SurfaceError(f"{path.name}: {values.ndim} dimensions; give a 3D label map")
    inside = values == _chosen_label(path, values, label)
    return _surface_of_mask(inside, np.asarray(image.affine, dtype=np.float64))


def _require_loadable(path: Path, image: Any) -> None:
    """Bound the decompressed size before anything is loaded."""
    scaled = (image.dataobj.slope, image.dataobj.inter) != (1.0, 0.0)
    item = 8 if scaled else image.get_data_dtype().itemsize
    n_bytes = item * int(np.prod(image.shape, dtype=np.int64))
    if n_bytes > MAX_LABEL_BYTES:
        raise SurfaceError(
            f"{path.name}: label map of {n_bytes / 1e9:.1f} GB; crop it to the organ "
            f"(limit {MAX_LABEL_BYTES / 1e9:.1f} GB)"
        )


def _chosen_label(path: Path, values: NDArray[Any], label: int | None) -> float:
    present = np.unique(values)
    present = present[present != 0]
    if len(present) > 100:
        raise SurfaceError(f"{path.name}: an image, not a label map; give the segmentation")
    if label is None and len(present) == 1:
        return float(present[0])
    if label is None or label not in present:
        names = ", ".join(f"{value:g}" for value in present) or "none"
        raise SurfaceError(f"{path.name}: labels present: {names}; choose one with --label")
    return float(label)


def _surface_of_mask(inside: NDArray[np.bool_], affine: FloatArray) -> Soup:
    """Marching cubes on a mask averaged to 2 mm and blurred by half its coarsest voxel."""
    from scipy.ndimage import gaussian_filter

    corner, mask = _crop(inside)
    size = np.linalg.norm(affine[:3, :3], axis=0)
    factor = np.maximum(np.floor(LABEL_SPACING / size + 1e-6), 1).astype(int)
    averaged = np.pad(_block_mean(mask, factor), 3)
    filled = gaussian_filter(averaged, 0.5 * (size * factor).max() / (size * factor))
    index, faces = march(0.5 - filled)
    voxel = corner + (index - 3) * factor + (factor - 1) / 2
    vertices = voxel @ affine[:3, :3].T + affine[:3, 3]
    return vertices, faces if np.linalg.det(affine[:3, :3]) > 0 else faces[:, ::-1]


def _crop(mask: NDArray[np.bool_]) -> tuple[IntArray, NDArray[np.bool_]]:
    """First corner of the bounding box of the mask, and the mask inside it."""
    spans = []
    for axis in range(3):
        used = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
        spans.append(slice(used[0], used[-1] + 1))
    return np.array([s.start for s in spans]), mask[tuple(spans)]


def _block_mean(mask: NDArray[np.bool_], factor: IntArray) -> FloatArray:
    """Mean over blocks of factor voxels, the mask padded with outside to whole blocks."""
    padded = np.pad(mask, [(0, int(-n % f)) for n, f in zip(mask.shape, factor, strict=True)])
    blocks = [int(k) for n, f in zip(padded.shape, factor, strict=True) for k in (n // f, f)]
    return padded.reshape(blocks).mean(axis=(1, 3, 5))


def march(values: FloatArray) -> Soup:
    """Zero surface of a grid, negative inside, by marching cubes in index coordinates.

    values : ndarray, shape (nx, ny, nz). Returns vertices (n, 3) and outward faces (m, 3).
    """
    shape = values.shape
    k, j, i = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in shape[::-1]), indexing="ij")
    grid = np.column_stack([i.ravel(), j.ravel(), k.ravel()])
    vertices, faces, _ = igl.marching_cubes(values.ravel(order="F"), grid, *shape, 0.0)
    return vertices, faces


_READERS: dict[str, Callable[..., Soup]] = {
    ".obj": _read_obj,
    ".stl": _by_meshio("stl"),
    ".ply": _by_meshio("ply"),
    ".off": _by_meshio("off"),
    ".vtk": _read_vtk,
    ".nii": _read_label_map,
}
