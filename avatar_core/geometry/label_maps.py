"""Label maps: voxels that hold the number of an organ. One organ's surface is made from them.

Segments may have names, and several layers where they overlap;
:mod:`avatar_core.geometry.label_files` reads them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from pathlib import Path
from shlex import quote

import igl
import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray, IntArray, Soup
from avatar_core.errors import SurfaceError
from avatar_core.geometry.label_files import read_label_map
from avatar_core.geometry.label_masks import (
    Box,
    around,
    box_of,
    cavities,
    cut_off,
    filled,
    in_ml,
    left_out,
)
from avatar_core.geometry.skin import signed_volume
from avatar_core.geometry.volumes import Segment, Volume

LABEL_SPACING = 2.0  # label maps finer than this are averaged to it [mm]
_FEWEST = 8  # voxels along each side of a label, to which it is averaged at most
_MAX_LABELS = 100  # more are an image
_SLIMMEST = 100.0  # a voxel's length over its width
_VOLUME_ERROR = 2e-3  # volume error of a surface, relative to its voxels
_MOST_LEVELS = 6  # levels that are tried for it,
_LEVELS = (0.1, 0.9)  # between these


def labels_of(path: str | Path) -> tuple[str, ...]:
    """Return the labels of a map, as names of its segments or as numbers.

    Raises SurfaceError like :func:`surface_of_label` if the file is no label map.
    """
    path = Path(path)
    return tuple(one.name for one in _segments(read_label_map(path), path.name))


def surface_of_label(
    path: Path,
    label: int | str | None,
    inside: Sequence[str] = (),
    is_organ: bool = True,
    mm: float = 1.0,
) -> tuple[Soup, tuple[str, ...]]:
    """Return the surface of labels, in RAS and the file's unit, and notices.

    label : number or name of a segment, or several with commas between; the only segment if None
    inside : further labels, such as tumours. Gaps that they fill in the organ's label belong to the
        organ.
    is_organ : whether notices report the labels read, cavities, and ends at the image's border
    mm : length of the file's unit [mm]

    Raises
    ------
    SurfaceError
        If the map is too large, is an image, or lacks the label. Also if a label that was not given
        fills a hole of the organ.
    """
    found = read_label_map(path)
    affine = np.diag([mm, mm, mm, 1.0]) @ found.affine
    _require_voxels(path.name, affine)
    segments = _segments(found, path.name)
    chosen = [_chosen(segments, path.name, one) for one in (label, *inside)]
    box = around([_box_of(found, path.name, one) for some in chosen for one in some])
    organ, *parts = (np.pad(_mask_in(box, found, some), 1) for some in chosen)
    ml = 1e-3 * abs(float(np.linalg.det(affine[:3, :3])))  # volume of a voxel
    lines = [_read(chosen[0], organ, ml)]
    for one, part in zip(chosen[1:], parts, strict=True):
        organ, share = filled(organ, part)
        lines.append(f"{_read(one, part, ml)}, inside: {share:.0%}")
    notices = list(found.notices)
    if is_organ:
        notices.append(f"read {'; '.join(lines)}")
        holes, gaps = left_out(organ, cavities(organ)[0], _numbered(found, segments, box), ml)
        _require_whole(path.name, lines[0], chosen[0], holes)
        notices += gaps
        notices += cut_off(organ, found.values.shape[1:], box, affine)
    vertices, faces = _surface_of_mask(
        organ[1:-1, 1:-1, 1:-1], affine, np.array([side.start for side in box])
    )
    if len(faces) == 0:
        raise SurfaceError(f"{path.name}: {lines[0]}, is too small to have a surface")
    return (vertices / mm, faces), tuple(notices)


def _require_voxels(name: str, affine: FloatArray) -> None:
    """Raise SurfaceError if voxels are much longer than wide: a blur would take hours."""
    size = np.linalg.norm(affine[:3, :3], axis=0)
    if not (np.isfinite(affine).all() and 0.0 < size.max() <= _SLIMMEST * size.min()):
        sizes = " x ".join(f"{length:.3g}" for length in size)
        raise SurfaceError(f"{name}: voxels of {sizes} mm are no organ's; save it again")


# --- the label --------------------------------------------------------------------------------


def _segments(found: Volume, name: str) -> tuple[Segment, ...]:
    """Return the segments of a map; without names, one for each number but zero.

    Raises SurfaceError if the file is an image.
    """
    if found.segments:
        return found.segments
    if len(found.values) > 1:
        raise SurfaceError(f"{name}: several layers without names; save it as .seg.nrrd again")
    present: set[int] = set()
    for one in found.values[0].T:  # slice by slice: all values at once are sorted in seconds
        present |= set(np.unique(one).tolist())
        if len(present) > _MAX_LABELS + 1:
            raise SurfaceError(f"{name}: an image, not a label map; give the segmentation")
    return tuple(Segment(str(value), int(value), 0, int(value)) for value in sorted(present - {0}))


def _chosen(segments: Sequence[Segment], name: str, label: int | str | None) -> tuple[Segment, ...]:
    """Return the segments of a label, which may name several with commas between."""
    if label is None:
        found = [segments] if len(segments) == 1 else [()]
    elif fitting := _fitting(segments, str(label)):
        found = [fitting]
    else:
        found = [_fitting(segments, one.strip()) for one in str(label).split(",")]
    if any(len(fitting) != 1 for fitting in found):
        names = ", ".join(map(str, segments)) or "none"
        is_plain = all(one.name == str(one.number) for one in segments)
        is_name = label is not None and not str(label).replace(",", "").strip("- ").isdecimal()
        hint = ", without names" if is_plain and is_name else ""
        raise SurfaceError(
            f"{name}: labels present: {names}{hint}; choose with --label, several with commas"
        )
    return tuple(dict.fromkeys(fitting[0] for fitting in found))


def _fitting(segments: Sequence[Segment], label: str) -> Sequence[Segment]:
    """Return the segments of that name, in any case if none matches exactly, or that number."""
    found = [one for one in segments if one.name == label]
    found = found or [one for one in segments if one.name.lower() == label.lower()]
    return found or [one for one in segments if str(one.number) == label]


def _box_of(found: Volume, name: str, one: Segment) -> Box:
    """Return the bounding box of a segment; only one mask of a whole map is in memory at a time."""
    if not one.layer < len(found.values):
        raise SurfaceError(f"{name}: no layer {one.layer}, of {one.name}; save it again")
    mask = found.values[one.layer] == one.value
    if not mask.any():
        raise SurfaceError(f"{name}: the segment {one.name} is empty")
    return box_of(mask)


def _mask_in(box: Box, found: Volume, chosen: Sequence[Segment]) -> NDArray[np.bool_]:
    """Return the voxels of a box that lie in any of the segments."""
    return reduce(np.logical_or, (found.values[one.layer][box] == one.value for one in chosen))


def _numbered(
    found: Volume, segments: Sequence[Segment], box: Box
) -> Iterator[tuple[list[str], NDArray[np.int16]]]:
    """Yield the segments of each layer in a box with a border, as :func:`left_out` takes them."""
    for layer in range(len(found.values)):
        own = sorted((one for one in segments if one.layer == layer), key=lambda one: one.value)
        if own:
            values = np.pad(found.values[layer][box], 1)
            known = np.array([one.value for one in own])
            at = np.minimum(np.searchsorted(known, values), len(own) - 1).astype(np.int16)
            yield [one.name for one in own], np.where(known[at] == values, at + 1, 0)


def _read(chosen: Sequence[Segment], mask: NDArray[np.bool_], ml: float) -> str:
    """Return a text with the labels that were read and their volume.

    ml : volume of a voxel
    """
    return f"label {' + '.join(map(str, chosen))}, {in_ml(ml * np.count_nonzero(mask))}"


def _require_whole(
    name: str, read: str, chosen: Sequence[Segment], holes: dict[str, float]
) -> None:
    """Raise SurfaceError if other labels fill holes of the organ.

    holes : their volumes [ml]
    """
    if holes:
        cut = ", ".join(f"label {one} ({in_ml(volume)})" for one, volume in holes.items())
        every = quote(",".join([*(one.name for one in chosen), *holes]))
        raise SurfaceError(
            f"{name}: {read}, is hollow where others were cut out of it: {cut}; give all (--label "
            f"{every}), or name the lesion (--tumour-label {quote(next(iter(holes)))})"
        )


# --- its surface ------------------------------------------------------------------------------


def _surface_of_mask(inside: NDArray[np.bool_], affine: FloatArray, corner: IntArray) -> Soup:
    """Run marching cubes on a mask averaged to 2 mm and blurred by half its coarsest voxel.

    The blur draws round surfaces in: at a level of one half, a ball of 5 mm would lose a fifth of
    its volume. The level is the one at which the surface holds the volume of the mask.

    corner : index of the mask's first voxel in the map
    """
    from scipy.ndimage import gaussian_filter

    size = np.linalg.norm(affine[:3, :3], axis=0)
    factor = np.floor(LABEL_SPACING / size + 1e-6).astype(int)
    factor = np.clip(factor, 1, np.maximum(np.array(inside.shape) // _FEWEST, 1))
    averaged = np.pad(_block_mean(inside, factor), 3)
    smooth = gaussian_filter(averaged, 0.5 * (size * factor).max() / (size * factor))
    index, faces = _at_volume(smooth, float(averaged.sum()))
    voxel = corner + (index - 3) * factor + (factor - 1) / 2
    vertices = voxel @ affine[:3, :3].T + affine[:3, 3]
    return vertices, faces if np.linalg.det(affine[:3, :3]) > 0 else faces[:, ::-1]


def _at_volume(values: FloatArray, wanted: float) -> Soup:
    """Return the surface of a level that holds a volume [voxels]: from one half on, by secants."""
    levels, volumes = [0.5], []
    for _ in range(_MOST_LEVELS):
        vertices, faces = march(levels[-1] - values)
        if not len(faces):
            break
        volumes.append(signed_volume(vertices, faces))
        if abs(volumes[-1] - wanted) < _VOLUME_ERROR * wanted:
            break
        slope = -wanted / 0.5  # slope for a mask so small that the blur leaves a cone
        if len(volumes) > 1 and volumes[-1] != volumes[-2]:
            slope = (volumes[-1] - volumes[-2]) / (levels[-1] - levels[-2])
        levels.append(float(np.clip(levels[-1] + (wanted - volumes[-1]) / slope, *_LEVELS)))
    return vertices, faces


def _block_mean(mask: NDArray[np.bool_], factor: IntArray) -> FloatArray:
    """Return mean over blocks of factor voxels, the mask padded with outside to whole blocks."""
    padded = np.pad(mask, [(0, int(-n % f)) for n, f in zip(mask.shape, factor, strict=True)])
    blocks = [int(k) for n, f in zip(padded.shape, factor, strict=True) for k in (n // f, f)]
    return padded.reshape(blocks).mean(axis=(1, 3, 5))


def march(values: FloatArray) -> Soup:
    """Return the zero surface of a grid, negative inside, by marching cubes in index coordinates.

    values : ndarray, shape (nx, ny, nz). Returns vertices (n, 3) and outward faces (m, 3).
    """
    shape = values.shape
    k, j, i = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in shape[::-1]), indexing="ij")
    grid = np.column_stack([i.ravel(), j.ravel(), k.ravel()])
    vertices, faces, _ = igl.marching_cubes(values.ravel(order="F"), grid, *shape, 0.0)
    return vertices, faces
