"""Files of voxels: NIfTI, NRRD as 3D Slicer writes it, and DICOM; label maps and images alike.

Nothing is loaded before its size is known.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import SurfaceError
from avatar_core.geometry.dicom_files import read_segmentation, read_series
from avatar_core.geometry.surface_formats import GZIP, LABEL_MAPS, kind_of
from avatar_core.geometry.volumes import Segment, Volume, require_loadable

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
_TO_RAS = {  # signs of the axes of NRRD's spaces, in full and in short
    "right-anterior-superior": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1),
    "ras": (1, 1, 1),
    "las": (-1, 1, 1),
    "lps": (-1, -1, 1),
}
_NIFTI_MM = {1: 1e3, 2: 1.0, 3: 1e-3}  # length of the units of a header; 0, unknown, is mm
_NRRD_MM = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "": 1.0, "???": 1.0}
_APART = 0.5  # least distance of a voxel by qform and by sform that gives a notice [mm]
_OFF = 0.1  # from a whole number, at most, of a label
_EXACT = 1e-3  # from a whole number, distance below which no notice is given


def is_label_map(path: Path) -> bool:
    """Return whether a file is a label map, by its name or else by its beginning."""
    return kind_of(path) in LABEL_MAPS


def read_label_map(path: Path) -> Volume:
    """Return all layers of a file as whole numbers; NaN becomes 0, which is outside.

    Raises
    ------
    SurfaceError
        If the map is too large, does not say where its voxels lie, or holds no whole numbers.
    """
    found = _read(path, read_segmentation)
    if found.values.dtype.kind in "biu":
        return found
    values, notices = _whole(found.values, path.name)
    return replace(found, values=values, notices=found.notices + notices)


def read_image(path: Path) -> Volume:
    """Return the image of a file, or of a folder with one DICOM series.

    NaN becomes 0, or the darkest value if that is below 0.

    Raises SurfaceError like :func:`read_label_map`, and for several layers.
    """
    found = read_series(path) if path.is_dir() else _read(path, read_series)
    if len(found.values) != 1:
        raise SurfaceError(f"{path.name}: {len(found.values)} layers; give one image")
    unknown = np.isnan(found.values)
    if not unknown.any():
        return found
    if unknown.all():
        raise SurfaceError(f"{path.name}: none of its voxels is a number; save it again")
    darkest = min(np.nanmin(found.values), 0.0)
    return replace(found, values=np.where(unknown, darkest, found.values))


def _read(path: Path, read_dicom: Callable[[Path], Volume]) -> Volume:
    kind = kind_of(path)
    if kind == ".dcm":
        return read_dicom(path)
    return _read_nrrd(path) if kind == ".nrrd" else _read_nifti(path)


def _whole(values: NDArray[Any], name: str) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """Return the nearest whole numbers of labels, and a notice where they are not the same."""
    labels, worst, example = np.empty(values.shape, np.int32), 0.0, 0.0
    for k in range(values.shape[1]):  # one slice in memory at a time
        one = np.where(np.isnan(values[:, k]), 0.0, values[:, k])
        labels[:, k] = np.rint(np.clip(one, -(2.0**31), 2.0**31 - 1.0))
        off = np.abs(one - labels[:, k])
        if off.max() > worst:
            worst, example = off.max(), one.flat[np.argmax(off)]
    if worst > _OFF:
        raise SurfaceError(
            f"{name}: values like {example:.3g} are not labels; give the segmentation, "
            "resampled without interpolation (nearest neighbor)"
        )
    if worst <= _EXACT:
        return labels, ()
    return labels, (f"values like {example:.4g} are read as the nearest whole number",)


# --- NIfTI ------------------------------------------------------------------------------------


def _read_nifti(path: Path) -> Volume:
    """Return a volume of either NIfTI version, packed or not; its axes are RAS by definition."""
    import nibabel

    with path.open("rb") as file:
        source = gzip.GzipFile(fileobj=file) if file.peek().startswith(GZIP) else file
        is_second = source.read(7).endswith(b"n+2")
        source.seek(0)
        kind = nibabel.Nifti2Image if is_second else nibabel.Nifti1Image
        return _volume_of(kind.from_stream(source), path)


def _volume_of(image: Any, path: Path) -> Volume:
    """Return the volume of an image, whose voxels are loaded only if they are not too many."""
    if not (image.header["qform_code"] or image.header["sform_code"]):
        raise SurfaceError(
            f"{path.name}: does not say where its axes point (qform and sform code 0); save it "
            "again with its orientation, as 3D Slicer does"
        )
    if image.get_data_dtype().kind not in "biuf":
        raise SurfaceError(f"{path.name}: voxels of colours; save it as a label map")
    scaled = (image.dataobj.slope, image.dataobj.inter) != (1.0, 0.0)
    item = 8 if scaled else image.get_data_dtype().itemsize
    require_loadable(path.name, image.shape, item)
    values = np.squeeze(np.asanyarray(image.dataobj))
    if values.ndim != 3:
        raise SurfaceError(f"{path.name}: {values.ndim} dimensions; give a 3D label map")
    affine = np.array(image.affine, dtype=np.float64)
    mm = _NIFTI_MM.get(int(image.header["xyzt_units"]) & 7, 1.0)
    notices = _differing_forms(image, mm)
    affine[:3] *= mm
    return Volume(values[None], affine, (), notices)


def _differing_forms(image: Any, mm: float) -> tuple[str, ...]:
    """Return a notice if qform and sform are both given and place voxels differently."""
    header = image.header
    if not (header["qform_code"] and header["sform_code"]):
        return ()
    ends = np.array(np.meshgrid(*([0, n - 1] for n in image.shape[:3]))).reshape(3, -1)
    try:
        off = (header.get_qform() - header.get_sform())[:3]
    except ValueError:  # a quaternion that is none
        return ("its qform is damaged; its sform says where it lies",)
    apart = mm * float(np.linalg.norm(off[:, :3] @ ends + off[:, 3:], axis=0).max())
    if apart <= _APART:
        return ()
    return (
        f"its qform and sform place it {apart:.3g} mm apart; its sform is used: check that the "
        "organ lies where it should",
    )


# --- NRRD -------------------------------------------------------------------------------------


def _read_nrrd(path: Path) -> Volume:
    """Return a volume with its header in the same file, as Slicer saves label maps."""
    import nrrd

    with path.open("rb") as source:
        header = nrrd.read_header(source)
        if "data file" in header or "datafile" in header:
            raise SurfaceError(f"{path.name}: its voxels are in another file; save both in one")
        kind = _dtype(path.name, header)
        shape = [int(n) for n in header["sizes"]]
        n_bytes = require_loadable(path.name, shape, kind.itemsize)
        lines, skip = (
            int(header.get(f"{what} skip", header.get(f"{what}skip", 0)))
            for what in ("line", "byte")
        )
        for _ in islice(source, max(lines, 0)):
            pass
        content = _decoded(path.name, source.read(), header["encoding"].lower(), n_bytes, skip)
    directions = np.asarray(header.get("space directions", np.nan), dtype=np.float64)
    directions = np.atleast_2d(directions)
    axes = np.asarray(np.isfinite(directions).all(axis=-1))
    if axes.sum() != 3 or directions.shape[-1] != 3:
        raise _unplaced(path.name)
    values = np.frombuffer(content, kind).reshape(shape, order="F")
    if len(shape) - 3 not in (0, 1) or len(axes) != len(shape):
        raise SurfaceError(f"{path.name}: {len(shape)} dimensions; give a 3D label map")
    layers = values[None] if len(shape) == 3 else np.moveaxis(values, int(np.argmin(axes)), 0)
    affine, notices = _space(path.name, header, directions[axes])
    return Volume(layers, affine, _segments(header, len(layers)), notices)


def _dtype(name: str, header: Any) -> np.dtype[Any]:
    for kind, names in _NRRD_TYPES.items():
        if header["type"].lower() in names:
            order = ">" if header.get("endian", "little").lower() == "big" else "<"
            return np.dtype(order + kind)
    raise SurfaceError(f"{name}: voxels of type {header['type']}; save it as a label map")


def _decoded(name: str, content: bytes, encoding: str, n_bytes: int, skip: int) -> bytes:
    """Return the voxels' bytes behind those to skip; no more than announced are decompressed.

    skip : -1 for uncompressed voxels at the end of the file
    """
    is_packed = encoding in ("gzip", "gz")
    if not is_packed and encoding != "raw":
        raise SurfaceError(f"{name}: encoding {encoding}; save it with gzip or uncompressed")
    if skip < 0 and (is_packed or skip != -1):
        raise SurfaceError(f"{name}: byte skip {skip}, which is none; save it again")
    if is_packed:
        require_loadable(name, (n_bytes + skip,), 1)
        content = _inflated(content, n_bytes + skip)
    content = content[-n_bytes:] if skip == -1 else content[skip : skip + n_bytes]
    if len(content) < n_bytes:
        raise SurfaceError(f"{name}: {len(content)} of {n_bytes} bytes of voxels; save it again")
    return content


def _inflated(content: bytes, n_bytes: int) -> bytes:
    """Return the first bytes of a gzip file of one or more members."""
    found = b""
    while content and len(found) < n_bytes:
        member = zlib.decompressobj(zlib.MAX_WBITS | 16)
        found += member.decompress(content, n_bytes - len(found))
        content = member.unused_data
    return found


def _space(name: str, header: Any, directions: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the map (4, 4) from indices to RAS [mm], and a notice if the file states no origin."""
    space = str(header.get("space", "")).lower()
    units = [str(unit).strip('"') for unit in header.get("space units", [""] * 3)]
    if space not in _TO_RAS:
        raise _unplaced(name)
    if len(units) != 3 or not set(units) <= set(_NRRD_MM):
        raise SurfaceError(f"{name}: space units {' '.join(units)}; save it in mm")
    origin = np.asarray(header.get("space origin", np.full(3, np.nan)), dtype=np.float64)
    is_placed = bool(np.isfinite(origin).all())
    affine = np.eye(4)
    affine[:3, :3] = directions.T
    affine[:3, 3] = origin if is_placed else 0.0
    to_ras = np.array(_TO_RAS[space], float) * [_NRRD_MM[unit] for unit in units]
    affine[:3] *= to_ras[:, None]
    notice = "it has no space origin: its place in the patient is unknown; its corner is at 0"
    return affine, () if is_placed else (notice,)


def _unplaced(name: str) -> SurfaceError:
    return SurfaceError(
        f"{name}: does not say where its three axes point; save it as a segmentation "
        "(.seg.nrrd) or as NIfTI"
    )


def _segments(header: Any, n_layers: int) -> tuple[Segment, ...]:
    """Return the segments that Slicer names, ``Segment0_Name``, ``_LabelValue`` and ``_Layer``.

    Slicer before 4.11 writes neither value nor layer: each segment then has its own layer, filled
    with 1.
    """
    found: list[Segment] = []
    while (name := header.get(f"Segment{len(found)}_Name")) is not None:
        k = len(found)
        value = header.get(f"Segment{k}_LabelValue")
        own = k if value is None or n_layers > 1 else 0
        layer = int(header.get(f"Segment{k}_Layer", own))
        number = k + 1 if value is None else int(value)
        found.append(Segment(str(name), number, layer, 1 if value is None else number))
    return tuple(found)
