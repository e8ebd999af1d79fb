"""The contact geometry around an organ, sampled once for all tests and runs of the same code.

It follows from mesh, regions, patch and outline alone, and takes seconds whatever else is built.
"""

from __future__ import annotations

from avatar_core.contact import ball_shift
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.offsets import Offsets
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.vademecum import tip_field
from avatar_core.vademecum.tip_field import TipField
from tests.helpers.content import ByContent
from tests.helpers.disk_cache import disk_copy

# Imports never run back: a field comes from no later room.
_ROOMS = ("common", "geometry", "fem", "reduction", "shapes", "vademecum")

_smooth, _felt = tip_field.make_tip_field, ball_shift.make_felt_field


def _of_tips(organ: ByContent) -> TipField:
    return _smooth(*organ.values)


def _of_balls(organ: ByContent) -> TipField:
    return _felt(*organ.values)


_found, _found_for_balls = disk_copy(_of_tips, _ROOMS), disk_copy(_of_balls, (*_ROOMS, "contact"))


def smooth(
    mesh: TetMesh,
    regions: Regions,
    patch_radius: float,
    outline: SurfaceMesh | None = None,
    offsets: Offsets | None = None,
) -> TipField:
    """In the place of ``make_tip_field``; what it refuses is not kept, nor what has offsets."""
    if offsets is not None:
        return _smooth(mesh, regions, patch_radius, outline, offsets)
    return _found(ByContent(mesh, regions, float(patch_radius), outline))


def felt(
    mesh: TetMesh, regions: Regions, patch_radius: float, outline: SurfaceMesh | None = None
) -> TipField:
    """In the place of ``make_felt_field``, likewise."""
    return _found_for_balls(ByContent(mesh, regions, float(patch_radius), outline))
