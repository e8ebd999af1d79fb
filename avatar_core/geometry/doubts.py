"""Doubts about an organ before it is built: size, holes, bodies on bridges, lesions outside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import distance_transform_edt, generate_binary_structure, label

from avatar_core.errors import SurfaceError
from avatar_core.geometry.label_masks import in_ml
from avatar_core.geometry.surface import SurfaceMesh, box_points

LIVER_VOLUMES = (700e-6, 3500e-6)  # [m^3]
# Least part of the surface of a hole that is no defect of a segmentation, 30 mm wide on a liver.
_HOLE = 0.005
_DEPTH = 5e-3  # eroded depth, which cuts bridges of up to twice that [m]
_SPACING = 3e-3  # spacing of the grid of the erosion [m]
# Least part of the rest that counts as a body. At most 0.1 % splits off from any of 64 livers.
_SMALLEST_BODY = 0.02
_LEAST_INSIDE, _ALL = 0.5, 0.95  # fractions of a lesion
_SAMPLES = 32  # points along each side of a lesion's box


def doubts_of(
    organ: SurfaceMesh, inside: Sequence[SurfaceMesh] = (), has_groups: bool = False
) -> tuple[str, ...]:
    """Return notices of doubts about an organ and its lesions, one line each.

    Parameters
    ----------
    inside : Sequence[SurfaceMesh]
        Surfaces of lesions.
    has_groups : bool
        Whether clamp and accessible region are given by groups.

    Raises
    ------
    SurfaceError
        If less than half of a lesion lies in the organ.
    """
    placed = [notice for lesion in inside for notice in _placement(organ, lesion)]
    size = () if has_groups else size_notice(organ)
    return (*placed, *size, *_hole_notices(organ), *_bridge_notice(organ))


def size_notice(organ: SurfaceMesh) -> tuple[str, ...]:
    """Return a notice if the organ is smaller or larger than livers are."""
    low, high = LIVER_VOLUMES
    if low <= organ.volume <= high:
        return ()
    return (
        f"the organ holds {in_ml(1000000.0 * organ.volume)}: the default clamp suits a liver "
        f"of {1000000.0 * low:.0f} to {1000000.0 * high:,.0f} ml; give points 'clamped' and "
        "'accessible' (--groups) for another organ",
    )


def _placement(organ: SurfaceMesh, lesion: SurfaceMesh) -> tuple[str, ...]:
    """Return a notice of the part of a lesion outside the organ; nothing if it lies inside."""
    points = box_points(*lesion.bounding_box, (_SAMPLES,) * 3)
    points = points[lesion.skin.contains(points)]
    points = points if len(points) else lesion.vertices
    distance = organ.skin.signed_distance(points)
    share, reach = float(np.mean(distance < 0.0)), 1e3 * float(distance.max())
    volume = in_ml(1e6 * lesion.volume)
    if share < _LEAST_INSIDE:
        raise SurfaceError(
            f"{lesion.name}: {share:.0%} of the lesion ({volume}) lies in the organ, it reaches "
            f"{reach:.0f} mm out; check that both are of one image, or add its label to the "
            "organ's (--label 1,2)"
        )
    if share > _ALL and lesion.source_sha256 == organ.source_sha256 != "":
        return ()  # reported by its reader
    out = "" if share > _ALL else f", reaching {reach:.0f} mm out"
    return (f"lesion {lesion.name}: {volume}, inside: {share:.0%}{out}",)


def _hole_notices(organ: SurfaceMesh) -> tuple[str, ...]:
    """Return a notice of each hole that is more than a crack."""
    return tuple(
        f"a hole of {part:.1%} of the surface at ({1e3 * x:.0f}, {1e3 * y:.0f}, {1e3 * z:.0f}) mm "
        "was closed flat: part of the organ may be missing; segment the whole organ"
        for part, x, y, z in organ.skin.holes
        if part > _HOLE
    )


def _bridge_notice(organ: SurfaceMesh) -> tuple[str, ...]:
    """Return a notice if erosion by 5 mm splits the organ into bodies."""
    low, high = organ.bounding_box
    shape = np.ceil((high - low) / _SPACING).astype(int)
    points = box_points(low, low + _SPACING * shape, shape.tolist())
    inside = np.pad(organ.skin.contains(points).reshape(shape), 1)
    # from middle to middle of voxels, half a voxel more than from the surface
    away = distance_transform_edt(inside, sampling=_SPACING)
    pieces, _ = label(away > _DEPTH + 0.5 * _SPACING, generate_binary_structure(3, 3))
    sizes = np.sort(np.bincount(pieces.ravel())[1:])[::-1] / np.maximum(np.count_nonzero(pieces), 1)
    if len(sizes) < 2 or sizes[1] < _SMALLEST_BODY:
        return ()
    return (
        f"{sizes[1]:.0%} of the organ hangs on the rest by less than {2e3 * _DEPTH:.0f} mm: a "
        "second body, or a leak of the segmentation? remove it unless it belongs to the organ",
    )
