"""Gaps in the mask of an organ: lesions cut out of it, cavities, and the border of its image.

Masks are ndarrays of bool, shape (nx, ny, nz), with a border of voxels that are all outside.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label as components

from avatar_core.common.arrays import FloatArray, IntArray

Mask = NDArray[np.bool_]
Box = tuple[slice, slice, slice]

_ENCLOSED = 0.5  # touched fraction of a part's surface above which the organ encloses it
_CAVITY = 1.0  # smallest cavity in a notice [ml]
# DICOM leaves out empty slices, so a cropped image touches round ends. Their outermost slice has
# 0.33 of the area of the next one; a cut end has more than 0.6. A cut end also has a part of the
# largest section, and more where both ends touch, as then the image was cropped.
_BLUNT, _WIDE, _WIDE_OF_CROPPED = 0.6, 0.05, 0.2
_SIDES = (("left", "right"), ("posterior", "anterior"), ("inferior", "superior"))


def box_of(mask: Mask) -> Box:
    """Return the bounding box of a mask."""
    box = [slice(None)] * 3
    for axis in (2, 1, 0):  # each axis within the box of those before
        used = mask[tuple(box)].any(axis=tuple(a for a in range(3) if a != axis))
        where = np.flatnonzero(used)
        box[axis] = slice(int(where[0]), int(where[-1]) + 1)
    return box[0], box[1], box[2]


def around(boxes: Sequence[Box]) -> Box:
    """Return the smallest box that holds all boxes."""
    x, y, z = (
        slice(min(side.start for side in sides), max(side.stop for side in sides))
        for sides in zip(*boxes, strict=True)
    )
    return x, y, z


def cavities(organ: Mask) -> tuple[IntArray, int]:
    """Return the cavity number of each voxel, shape (nx, ny, nz), and how many cavities there are.

    The number is 0 outside cavities.
    """
    number, n = components(~organ)
    number[number == number[0, 0, 0]] = 0
    return number, n


def filled(organ: Mask, part: Mask) -> tuple[Mask, float]:
    """Return the organ filled where its mask leaves out a part, for example a lesion.

    A piece of the part belongs to the organ if the organ touches half of its surface. That holds
    where a lesion was cut out of the organ's label. If the part fills half of a cavity, the rest of
    the cavity is filled too.

    Returns
    -------
    organ : Mask
    share : float
        Fraction of the part that lies in this organ.
    """
    cavity, n = cavities(organ)
    in_part, whole = (np.bincount(one.ravel(), minlength=n + 1) for one in (cavity[part], cavity))
    organ = organ | _belonging(in_part, whole)[cavity]
    piece, n = components(part & ~organ)
    organ = organ | _belonging(*_faces(piece, organ | (cavity > 0), n + 1))[piece]
    return organ, float(np.count_nonzero(part & organ) / np.count_nonzero(part))


def _belonging(some: IntArray, every: IntArray) -> Mask:
    """Return whether each count is at least half of the whole, by number; 0 does not belong."""
    return (some >= _ENCLOSED * every) & (np.arange(len(every)) > 0)


def left_out(
    organ: Mask, cavity: IntArray, layers: Iterable[tuple[Sequence[str], IntArray]], ml: float
) -> tuple[dict[str, float], list[str]]:
    """Return the labels that are cut out of the organ, and cavities that no label fills.

    cavity : ndarray of int, see :func:`cavities`
    layers : names of labels, and the number of each voxel's label: 0 for none, 1 for the first name
    ml : volume of a voxel [ml]

    Returns
    -------
    enclosed : dict[str, float]
        Volumes [ml] of labels that fill holes of the organ, by name.
    notices : list[str]
        Labels that the organ encloses in part, and cavities.
    """
    is_hollow = cavity > 0
    enclosed: dict[str, float] = {}
    notices = []
    for names, number in layers:
        number = np.where(organ, 0, number)
        hidden, volume = (
            np.bincount(of.ravel(), minlength=len(names) + 1) for of in (number[cavity > 0], number)
        )
        touching, surface = _faces(number, organ, len(names) + 1)
        is_large, is_hidden = ml * volume >= _CAVITY, _belonging(hidden, volume)
        beside = (_belonging(touching, surface) | (ml * hidden >= _CAVITY)) & ~is_hidden
        beside[0] = False
        enclosed |= {names[k - 1]: ml * volume[k] for k in np.flatnonzero(is_hidden & is_large)}
        notices += [
            f"label {names[k - 1]}, {in_ml(ml * volume[k])}, is cut out of the organ, which is "
            "hollow there; add it to the organ's label after a comma, or name it as a lesion"
            for k in np.flatnonzero(beside & is_large)
        ]
        is_hollow &= number == 0
    sizes = ml * np.bincount(components(is_hollow)[0].ravel())[1:]
    notices += [
        f"the organ has a cavity of {in_ml(size)} that no label fills; check the segmentation"
        for size in sizes
        if size >= _CAVITY
    ]
    return enclosed, notices


def cut_off(organ: Mask, shape: Sequence[int], box: Box, affine: FloatArray) -> list[str]:
    """Return notices of ends of the organ at the border of its image.

    shape, affine : of the image, to RAS [mm]
    box : box of the organ's mask without its border
    """
    inner = organ[1:-1, 1:-1, 1:-1]
    notices = []
    for axis, (side, n) in enumerate(zip(box, shape, strict=True)):
        ends = [way for way, there in ((1, side.stop == n), (-1, side.start == 0)) if there]
        one, other = (a for a in range(3) if a != axis)
        face = np.linalg.norm(np.cross(affine[:3, one], affine[:3, other]))
        areas = face * inner.sum(axis=(one, other))
        wide = (_WIDE if len(ends) < 2 else _WIDE_OF_CROPPED) * areas.max()
        for way in ends:
            outer = areas[::-way][0]
            if outer < max(wide, _BLUNT * areas[::-way][:2][-1]):
                continue
            outward = way * affine[:3, axis]
            k = int(np.argmax(np.abs(outward)))
            notices.append(
                f"the image ends inside the organ, on its {_SIDES[k][int(outward[k] > 0)]} side "
                f"({outer / 100:.0f} cm2): the rest of it is missing"
            )
    return notices


def in_ml(volume: float) -> str:
    """Return a volume [ml] in words."""
    return f"{volume:,.0f} ml" if volume >= 10.0 else f"{volume:.2g} ml"


def _faces(piece: NDArray[np.integer], organ: Mask, n: int) -> tuple[IntArray, IntArray]:
    """Return how many voxel faces each of n pieces has on the organ, and in all."""
    touching, surface = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for axis in range(3):
        pieces, organs = (np.moveaxis(of, axis, 0) for of in (piece, organ))
        for one, other in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            ends = (pieces[one] > 0) & (pieces[one] != pieces[other])
            surface += np.bincount(pieces[one][ends], minlength=n)
            touching += np.bincount(pieces[one][ends & organs[other]], minlength=n)
    return touching, surface
