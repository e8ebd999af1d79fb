"""Label maps: voxels with a number for each organ, of which the surface of one is made.

NIfTI volumes, and NRRD as 3D Slicer writes segmentations (``.seg.nrrd``: names of the segments in
the header, several layers where they overlap). Nothing is loaded before its size is known.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray

from avatar_core.errors import SurfaceError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Soup = tuple[FloatArray, IntArray]

MAX_LABEL_BYTES = 2**30  # of a decompressed label map
LABEL_SPACING = 2.0  # label maps finer than this are averaged to it [mm]
_MAX_LABELS = 100  # more are an image
_SLIMMEST = 100.0  # a voxel's length over its width

_NRRD_TYPES = {
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i1": ("signed char", "int8", "int8_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "f4": ("float",),
    "f8": ("double",),
}
_TO_RAS = {  # of the spaces that NRRD names, in full and in short, the signs of their axes
    "right-anterior-superior": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1),
    "ras": (1, 1, 1),
    "las": (-1, 1, 1),
    "lps": (-1, -1, 1),
}


@dataclass(frozen=True)
class Segment:
    """One segment of a file that names them: its layer and its value in there."""

    name: str
    layer: int
    value: int


@dataclass(frozen=True)
class LabelMap:
    """Layers of labels, zero outside.

    values : ndarray, shape (n_layers, nx, ny, nz)
    affine : ndarray, shape (4, 4), from indices to RAS [mm]
    segments : that the file names
    """

    values: NDArray[Any]
    affine: FloatArray
    segments: tuple[Segment, ...] = ()


def is_label_map(path: Path) -> bool:
    """Whether a file's name is that of a label map."""
    return path.name.lower().endswith((".nii", ".nii.gz", ".nrrd"))


def surface_of_label(path: Path, label: int | str | None) -> Soup:
    """Surface of one label, in RAS [mm]; the only one if None.

    Parameters
    ----------
    label : number, or the name of a segment

    Raises
    ------
    SurfaceError
        If the map is too large, is an image, or has no such label.
    """
    found = _read_nrrd(path) if path.suffix.lower() == ".nrrd" else _read_nifti(path)
    _require_voxels(path.name, found.affine)
    return _surface_of_mask(_mask_of(found, path.name, label), found.affine)


# --- files ------------------------------------------------------------------------------------


def _read_nifti(path: Path) -> LabelMap:
    """A volume in its world coordinates, which are RAS by definition."""
    import nibabel

    image: Any = nibabel.load(path)
    scaled = (image.dataobj.slope, image.dataobj.inter) != (1.0, 0.0)
    item = 8 if scaled else image.get_data_dtype().itemsize
    _require_loadable(path.name, image.shape, item)
    values = np.squeeze(np.asanyarray(image.dataobj))
    if values.ndim != 3:
        raise SurfaceError(f"{path.name}: {values.ndim} dimensions; give a 3D label map")
    return LabelMap(values[None], np.asarray(image.affine, dtype=np.float64))


def _read_nrrd(path: Path) -> LabelMap:
    """A volume with its header in the same file, as Slicer saves label maps and segmentations."""
    import nrrd

    with path.open("rb") as source:
        header = nrrd.read_header(source)
        if "data file" in header or "datafile" in header:
            raise SurfaceError(f"{path.name}: its voxels are in another file; save both in one")
        kind = _dtype(path.name, header)
        shape = [int(n) for n in header["sizes"]]
        n_bytes = _require_loadable(path.name, shape, kind.itemsize)
        content = _decoded(path.name, source.read(), header["encoding"].lower(), n_bytes)
    directions = np.asarray(header.get("space directions", np.nan), dtype=np.float64)
    directions = np.atleast_2d(directions)
    axes = np.asarray(np.isfinite(directions).all(axis=-1))
    space = str(header.get("space", "")).lower()
    if axes.sum() != 3 or directions.shape[-1] != 3 or space not in _TO_RAS:
        raise SurfaceError(
            f"{path.name}: does not say where its three axes point; save it as a segmentation "
            "(.seg.nrrd) or as NIfTI"
        )
    values = np.frombuffer(content, kind).reshape(shape, order="F")
    if len(shape) - 3 not in (0, 1) or len(axes) != len(shape):
        raise SurfaceError(f"{path.name}: {len(shape)} dimensions; give a 3D label map")
    layers = values[None] if len(shape) == 3 else np.moveaxis(values, int(np.argmin(axes)), 0)
    affine = np.eye(4)
    affine[:3, :3] = directions[axes].T
    affine[:3, 3] = header.get("space origin", np.zeros(3))
    affine[:3] *= np.array(_TO_RAS[space], float)[:, None]
    return LabelMap(layers, affine, _segments(header))


def _dtype(name: str, header: Any) -> np.dtype[Any]:
    for kind, names in _NRRD_TYPES.items():
        if header["type"].lower() in names:
            order = ">" if header.get("endian", "little").lower() == "big" else "<"
            return np.dtype(order + kind)
    raise SurfaceError(f"{name}: voxels of type {header['type']}; save it as a label map")


def _decoded(name: str, content: bytes, encoding: str, n_bytes: int) -> bytes:
    """The voxels' bytes; no more than announced are decompressed."""
    if encoding in ("gzip", "gz"):
        content = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(content, n_bytes)
    elif encoding != "raw":
        raise SurfaceError(f"{name}: encoding {encoding}; save it with gzip or uncompressed")
    if len(content) < n_bytes:
        raise SurfaceError(f"{name}: {len(content)} of {n_bytes} bytes of voxels; save it again")
    return content[:n_bytes]


def _segments(header: Any) -> tuple[Segment, ...]:
    """The segments that Slicer names, ``Segment0_Name``, ``_LabelValue`` and ``_Layer``."""
    found: list[Segment] = []
    while (name := header.get(f"Segment{len(found)}_Name")) is not None:
        key = f"Segment{len(found)}_"
        layer, value = header.get(f"{key}Layer", 0), header.get(f"{key}LabelValue", 1)
        found.append(Segment(str(name), int(layer), int(value)))
    return tuple(found)


def _require_loadable(name: str, shape: Sequence[int], item: int) -> int:
    """Bytes of an array; SurfaceError if they are too many."""
    n_bytes = item * int(np.prod(np.array(shape, dtype=object)))
    if not 0 < n_bytes <= MAX_LABEL_BYTES:
        raise SurfaceError(
            f"{name}: label map of {n_bytes / 1e9:.1f} GB; crop it to the organ "
            f"(limit {MAX_LABEL_BYTES / 1e9:.1f} GB)"
        )
    return n_bytes


def _require_voxels(name: str, affine: FloatArray) -> None:
    """SurfaceError unless voxels are as long as wide, to some extent: a blur would take hours."""
    size = np.linalg.norm(affine[:3, :3], axis=0)
    if not (np.isfinite(affine).all() and 0.0 < size.max() <= _SLIMMEST * size.min()):
        sizes = " x ".join(f"{length:.3g}" for length in size)
        raise SurfaceError(f"{name}: voxels of {sizes} mm are no organ's; save it again")


# --- the label --------------------------------------------------------------------------------


def _mask_of(found: LabelMap, name: str, label: int | str | None) -> NDArray[np.bool_]:
    """Where the label is, shape (nx, ny, nz)."""
    if found.segments:
        chosen = _chosen_segment(found.segments, name, label)
        if not chosen.layer < len(found.values):
            raise SurfaceError(f"{name}: no layer {chosen.layer}, of {chosen.name}; save it again")
        mask = found.values[chosen.layer] == chosen.value
        if not mask.any():
            raise SurfaceError(f"{name}: the segment {chosen.name} is empty")
        return np.asarray(mask)
    if len(found.values) > 1:
        raise SurfaceError(f"{name}: several layers without names; save it as .seg.nrrd again")
    return np.asarray(found.values[0] == _chosen_label(found.values[0], name, label))


def _chosen_segment(segments: Sequence[Segment], name: str, label: int | str | None) -> Segment:
    fitting = [one for one in segments if label is None or one.name == str(label)]
    fitting = fitting or [one for one in segments if one.name.lower() == str(label).lower()]
    fitting = fitting or [one for one in segments if one.value == _number(label)]
    if len(fitting) != 1:
        names = ", ".join(f"{one.name} ({one.value})" for one in segments)
        raise SurfaceError(f"{name}: labels present: {names}; choose one by name with --label")
    return fitting[0]


def _chosen_label(values: NDArray[Any], name: str, label: int | str | None) -> float:
    present = np.unique(values)
    present = present[present != 0]
    if len(present) > _MAX_LABELS:
        raise SurfaceError(f"{name}: an image, not a label map; give the segmentation")
    if label is None and len(present) == 1:
        return float(present[0])
    number = _number(label)
    if number is None or number not in present:
        names = ", ".join(f"{value:g}" for value in present) or "none"
        hint = "" if label is None or number is not None else ", without names"
        raise SurfaceError(f"{name}: labels present: {names}{hint}; choose one with --label")
    return float(number)


def _number(label: int | str | None) -> int | None:
    return int(label) if label is not None and str(label).lstrip("-").isdecimal() else None


# --- its surface ------------------------------------------------------------------------------


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
