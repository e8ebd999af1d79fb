"""DICOM: segmentations, and CT or MR as a series in a folder or one file with many frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.errors import SurfaceError
from avatar_core.geometry.volumes import Segment, Volume, require_loadable

_MAGIC = 128, b"DICM"  # place and content of DICOM's signature
_LOOKED_AT = 5  # files of a folder, one of which has to be DICOM
# Errors of highdicom and pydicom: irregular slices, missing attributes, codecs that are not there.
_UNREADABLE = (AttributeError, KeyError, NotImplementedError, RuntimeError, TypeError, ValueError)
_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])  # the patient's axes of DICOM are LPS


def read_segmentation(path: Path) -> Volume:
    """Return a segmentation (SEG) in one file, its segments named by their numbers.

    BINARY and FRACTIONAL files have a layer for each segment. A voxel of a FRACTIONAL file belongs
    to the segment from half of MaximumFractionalValue on. Voxels of a LABELMAP are numbers of
    segments, 0 outside.

    Raises SurfaceError for no segmentation, no regular volume, or without highdicom.
    """
    highdicom, dcmread = _libraries(path.name)
    head = dcmread(path, stop_before_pixels=True)
    if str(head.get("Modality", "")) != "SEG" or "SegmentSequence" not in head:
        raise SurfaceError(f"{path.name}: DICOM, but no segmentation (SEG); give the organ's")
    require_loadable(path.name, (int(head.NumberOfFrames), int(head.Rows), int(head.Columns)), 1)
    segmentation = highdicom.seg.segread(path)
    where = segmentation.get_volume_geometry(allow_missing_positions=True)
    if where is None:
        raise SurfaceError(f"{path.name}: its slices make no regular volume; save it as NIfTI")
    kind = str(head.get("SegmentationType", "BINARY"))
    names = {int(one.SegmentNumber): str(one.SegmentLabel) for one in head.SegmentSequence}
    is_labelmap = kind == "LABELMAP"
    if is_labelmap:
        names.pop(0, None)  # the background, which may be described or not
    require_loadable(path.name, (1 if is_labelmap else len(names), *where.spatial_shape), 1)
    volume = segmentation.get_volume(
        combine_segments=is_labelmap, rescale_fractional=False, allow_missing_positions=True
    )
    affine = _TO_RAS @ np.asarray(volume.affine, float)
    if is_labelmap:
        found = tuple(Segment(name, number, 0, number) for number, name in names.items())
        return Volume(np.asarray(volume.array)[None], affine, found)
    found = tuple(Segment(name, n, layer, 1) for layer, (n, name) in enumerate(names.items()))
    layers = np.moveaxis(np.asarray(volume.array), -1, 0)
    if kind != "FRACTIONAL":
        return Volume(layers != 0, affine, found)
    of = str(head.get("SegmentationFractionalType", "unknown")).lower()
    notice = f"a FRACTIONAL segmentation: voxels from half of the largest {of} on are inside"
    least = 0.5 * float(head.get("MaximumFractionalValue", 255))
    return Volume(layers >= least, affine, found, (notice,))


def is_series(folder: Path) -> bool:
    """Return whether a folder seems to hold a series; opens no more than a few of its files."""
    try:
        files = sorted(path for path in folder.iterdir() if path.is_file())[:_LOOKED_AT]
        return any(_is_dicom(path) for path in files)
    except OSError:  # unreadable, or deleted meanwhile
        return False


def read_series(path: Path) -> Volume:
    """Return the image of a series or of a file of many frames.

    Values are float32, in Hounsfield units where the file has them.

    Raises
    ------
    SurfaceError : several series, no regular volume, too large, or highdicom is not installed
    """
    highdicom, dcmread = _libraries(path.name)
    files = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.is_file())
    files = [file for file in files if _is_dicom(file)]
    heads = [dcmread(file, stop_before_pixels=True) for file in files]
    _require_one_volume(path.name, heads)
    try:
        if len(files) == 1:
            volume = highdicom.imread(files[0]).get_volume(dtype=np.float32)
        else:
            volume = highdicom.get_volume_from_series(
                [dcmread(file) for file in files], dtype=np.float32
            )
    except _UNREADABLE as error:
        reason = " ".join(str(error).split())
        raise SurfaceError(
            f"{path.name}: not one regular volume that is read here ({reason}); save it as NIfTI"
        ) from error
    return Volume(np.asarray(volume.array)[None], _TO_RAS @ np.asarray(volume.affine, float))


def _libraries(name: str) -> tuple[Any, Any]:
    """Return the module highdicom, and pydicom's reader of a file."""
    try:
        import highdicom
        from pydicom import dcmread
    except ImportError as error:
        raise SurfaceError(f"{name}: DICOM needs highdicom; pip install '.[dicom]'") from error
    return highdicom, dcmread


def _is_dicom(path: Path) -> bool:
    at, magic = _MAGIC
    with path.open("rb") as source:
        return source.read(at + len(magic))[at:] == magic


def _require_one_volume(name: str, heads: list[Any]) -> None:
    """Raise SurfaceError unless the files are one image of a size that can be held."""
    if not heads:
        raise SurfaceError(f"{name}: no DICOM file in it; give the folder of a series")
    series = {str(head.get("SeriesInstanceUID", "")) for head in heads}
    if len(series) > 1:
        raise SurfaceError(f"{name}: {len(series)} series; put one in a folder of its own")
    if str(heads[0].get("Modality", "")) == "SEG":
        raise SurfaceError(f"{name}: a segmentation, no image; build a patient from it")
    sizes = [
        int(head.get("Rows", 0)) * int(head.get("Columns", 0)) * int(head.get("NumberOfFrames", 1))
        for head in heads
    ]
    require_loadable(name, (sum(sizes),), 4)
