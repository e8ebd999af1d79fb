"""Files of label maps: NIfTI, NRRD as 3D Slicer writes it, and DICOM segmentations.

Nothing is loaded before its size is known.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import SurfaceError
from avatar_core.geometry.surface_formats import LABEL_MAPS

MAX_LABEL_BYTES = 2**30  # of a decompressed label map

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
    return path.name.lower().endswith(LABEL_MAPS)


def read_label_map(path: Path) -> LabelMap:
    """All layers of a file.

    Raises
    ------
    SurfaceError
        If the map is too large, or does not say where its voxels lie.
    """
    name = path.name.lower()
    reader = next(read for ending, read in _READERS.items() if name.endswith(ending))
    return reader(path)


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


def _read_dicom(path: Path) -> LabelMap:
    """A DICOM segmentation in one file: a layer for each segment, by its label."""
    try:
        import highdicom
    except ImportError as error:
        raise SurfaceError(f"{path.name}: DICOM needs highdicom; pip install '.[dicom]'") from error
    from pydicom import dcmread

    head = dcmread(path, stop_before_pixels=True)
    if str(head.get("Modality", "")) != "SEG" or "SegmentSequence" not in head:
        raise SurfaceError(f"{path.name}: DICOM, but no segmentation (SEG); give that of the organ")
    segments = len(head.SegmentSequence)
    _require_loadable(path.name, (int(head.NumberOfFrames), int(head.Rows), int(head.Columns)), 1)
    segmentation = highdicom.seg.segread(path)
    where = segmentation.get_volume_geometry(allow_missing_positions=True)
    if where is None:
        raise SurfaceError(f"{path.name}: its slices make no regular volume; save it as NIfTI")
    _require_loadable(path.name, (segments, *where.spatial_shape), 1)
    volume = segmentation.get_volume(
        combine_segments=False, rescale_fractional=False, allow_missing_positions=True
    )
    names = tuple(
        Segment(str(one.SegmentLabel), layer, 1) for layer, one in enumerate(head.SegmentSequence)
    )
    to_ras = np.diag([-1.0, -1.0, 1.0, 1.0])  # DICOM's patient axes are LPS
    values = np.moveaxis(np.asarray(volume.array) != 0, -1, 0)
    return LabelMap(values, to_ras @ np.asarray(volume.affine, float), names)


_READERS: dict[str, Callable[[Path], LabelMap]] = {
    ".nii": _read_nifti,
    ".nii.gz": _read_nifti,
    ".nrrd": _read_nrrd,
    ".dcm": _read_dicom,
}
