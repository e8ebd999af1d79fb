"""CT and MR as DICOM has them: a series of files in a folder, or one file with many frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.errors import SurfaceError
from avatar_core.geometry.label_files import MAX_LABEL_BYTES

_MAGIC = 128, b"DICM"  # where, and what a file of DICOM says there
_LOOKED_AT = 5  # files of a folder, one of which has to be DICOM
# Of highdicom and pydicom, for irregular slices, missing attributes and codecs that are not there.
_UNREADABLE = (AttributeError, KeyError, NotImplementedError, RuntimeError, TypeError, ValueError)
_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])  # the patient's axes of DICOM are LPS


def is_series(folder: Path) -> bool:
    """Whether a folder seems to hold a series; opens no more than a few of its files."""
    try:
        files = sorted(path for path in folder.iterdir() if path.is_file())[:_LOOKED_AT]
        return any(_is_dicom(path) for path in files)
    except OSError:  # not to be read, or gone
        return False


def read_series(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Voxels (nx, ny, nz) of a series or of a file of many frames, and where they lie.

    Returns
    -------
    values : ndarray of float32, in Hounsfield units where the file has them
    affine : ndarray, shape (4, 4), from indices to RAS [mm]

    Raises
    ------
    SurfaceError : several series, no regular volume, too large, or highdicom is not installed
    """
    try:
        import highdicom
        from pydicom import dcmread
    except ImportError as error:
        raise SurfaceError(f"{path.name}: DICOM needs highdicom; pip install '.[dicom]'") from error
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
    return np.asarray(volume.array), _TO_RAS @ np.asarray(volume.affine, float)


def _is_dicom(path: Path) -> bool:
    at, magic = _MAGIC
    with path.open("rb") as source:
        return source.read(at + len(magic))[at:] == magic


def _require_one_volume(name: str, heads: list[Any]) -> None:
    """SurfaceError unless the files are one image of a size that can be held."""
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
    n_bytes = 4 * sum(sizes)
    if not 0 < n_bytes <= MAX_LABEL_BYTES:
        raise SurfaceError(
            f"{name}: image of {n_bytes / 1e9:.1f} GB; crop it to the organ "
            f"(limit {MAX_LABEL_BYTES / 1e9:.1f} GB)"
        )
