"""An image such as CT or MR in three planes along its voxels, in grey by window and level.

It stays as it was acquired: it is not deformed with the organ.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from avatar_core.errors import SurfaceError
from avatar_core.geometry.label_files import read_image

MOST = 256  # voxels that are kept along an axis, evenly spaced
_AIR = -500.0  # an image with lower values is CT in Hounsfield units
_CT = (40.0, 400.0)  # level and window of soft tissue
_SHEAR = 1e-2  # cosine between two axes of voxels, above which planes are no rectangles
_NAMES = ("sagittal", "coronal", "axial")  # names of planes square to R, A and S


class Scan(NamedTuple):
    """Voxels and their position.

    values : ndarray, shape (nx, ny, nz)
    affine : ndarray, shape (4, 4), from indices to RAS [m]
    level, window : middle and width of the grey scale at first, in units of the values
    low, high : smallest and largest value
    notices : omissions and contradictions of its file, one line each
    """

    values: np.ndarray
    affine: np.ndarray
    level: float
    window: float
    low: float
    high: float
    notices: tuple[str, ...] = ()

    @property
    def planes(self) -> tuple[str, ...]:
        """Name the planes square to the voxels' axes, each name once, by the nearest of R, A, S."""
        axes = np.abs(self.affine[:3, :3]) / np.linalg.norm(self.affine[:3, :3], axis=0)
        return tuple(_NAMES[k] for k in linear_sum_assignment(axes.T, maximize=True)[1])


class Slice(NamedTuple):
    """A plane of an image.

    grey : ndarray of uint8, shape (rows, columns)
    middle : ndarray, shape (3,) [m]
    turn : ndarray, shape (3, 3), directions along columns, along rows and of the normal
    width, height : extent [m]
    """

    grey: np.ndarray
    middle: np.ndarray
    turn: np.ndarray
    width: float
    height: float


def read_scan(path: str | Path) -> Scan:
    """Read the image of a NIfTI, NRRD or DICOM file, or of a folder with a series of DICOM.

    Raises SurfaceError for a file that is none, holds several images, or whose axes are sheared.
    """
    path = Path(path)
    image = read_image(path)
    values, affine = image.values[0], image.affine.copy()
    step = np.maximum(-(-np.array(values.shape) // MOST), 1)
    values = values[:: step[0], :: step[1], :: step[2]]
    kind = np.int16 if np.can_cast(values.dtype, np.int16) else np.float32
    values = np.ascontiguousarray(values, kind)
    affine[:3, :3] *= step
    affine[:3] *= 1e-3
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    if np.abs(axes.T @ axes - np.eye(3)).max() > _SHEAR:
        raise SurfaceError(f"{path.name}: its axes are not square to one another; resample it")
    low, high = float(values.min()), float(values.max())
    if low < _AIR:
        return Scan(values, affine, *_CT, low, high, image.notices)
    dark, light = np.percentile(values[::2, ::2, ::2], (1.0, 99.0))
    if not light > dark:
        dark, light = low, max(high, low + 1.0)
    level, window = float(dark + light) / 2.0, float(light - dark)
    return Scan(values, affine, level, window, low, high, image.notices)


def slice_of(scan: Scan, axis: int, part: float, level: float, window: float) -> Slice:
    """Return the plane square to an axis of the voxels, at a part of the way along it.

    level, window : middle and width of the range from black to white
    """
    n = scan.values.shape[axis]
    k = min(int(part * n), n - 1)
    across, down = (a for a in range(3) if a != axis)
    plane = np.take(scan.values, k, axis=axis).T.astype(np.float32)  # rows along `down`
    grey = np.clip((plane - (level - 0.5 * window)) / max(window, 1e-9), 0.0, 1.0)
    index = 0.5 * (np.array(scan.values.shape, float) - 1.0)
    index[axis] = k
    columns, rows = scan.affine[:3, across], scan.affine[:3, down]
    u, v = columns / np.linalg.norm(columns), rows / np.linalg.norm(rows)
    return Slice(
        np.round(255.0 * grey).astype(np.uint8),
        scan.affine[:3, :3] @ index + scan.affine[:3, 3],
        np.column_stack([u, v, np.cross(u, v)]),
        float(np.linalg.norm(columns)) * plane.shape[1],
        float(np.linalg.norm(rows)) * plane.shape[0],
    )
