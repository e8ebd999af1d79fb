"""Label maps: voxels with a number for each organ, of which the surface of one is made.

Segments may have names, and several layers where they overlap;
:mod:`avatar_core.geometry.label_files` reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray, IntArray, Soup
from avatar_core.errors import SurfaceError
from avatar_core.geometry.label_files import LabelMap, Segment, read_label_map

LABEL_SPACING = 2.0  # label maps finer than this are averaged to it [mm]
_MAX_LABELS = 100  # more are an image
_SLIMMEST = 100.0  # a voxel's length over its width


def labels_of(path: str | Path) -> tuple[str, ...]:
    """What can be chosen of a label map: names of its segments, or its numbers; for the user.

    Raises SurfaceError as :func:`surface_of_label` of a file that is none.
    """
    path = Path(path)
    found = read_label_map(path)
    if found.segments:
        return tuple(one.name for one in found.segments)
    return tuple(f"{value:g}" for value in _present(found.values[0], path.name))


def surface_of_label(path: Path, label: int | str | None, inside: Sequence[str] = ()) -> Soup:
    """Surface of one label, in RAS [mm]; the only one if None.

    Parameters
    ----------
    label : number, or the name of a segment
    inside : further labels that belong to it, as tumours of an organ that were cut out of it

    Raises
    ------
    SurfaceError
        If the map is too large, is an image, or has no such label.
    """
    found = read_label_map(path)
    _require_voxels(path.name, found.affine)
    mask = _mask_of(found, path.name, label)
    for other in inside:
        mask = mask | _mask_of(found, path.name, other)
    return _surface_of_mask(mask, found.affine)


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


def _present(values: NDArray[Any], name: str) -> NDArray[Any]:
    """The numbers of a map but zero, sorted; SurfaceError of an image."""
    present = np.unique(values)
    present = present[present != 0]
    if len(present) > _MAX_LABELS:
        raise SurfaceError(f"{name}: an image, not a label map; give the segmentation")
    return present


def _chosen_label(values: NDArray[Any], name: str, label: int | str | None) -> float:
    present = _present(values, name)
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
