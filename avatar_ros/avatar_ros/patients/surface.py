"""The surface of a patient, of a file or of a message: both are checked alike."""

from __future__ import annotations

import os

from avatar_core.geometry.surface import (
    SurfaceMesh,
    keep_organ,
    orient_outward,
    read_surface,
    require_closed,
    require_plausible_size,
)
from avatar_core.geometry.surface_files import MAX_LABEL_BYTES
from avatar_ros.framework.reader import Reader
from avatar_ros.patients.builder import Order


def read_confined(order: Order, reader: Reader) -> SurfaceMesh:
    """What :func:`surface_of` gives, in the process of a reader.

    Raises AvatarError for what is no surface of an organ.
    """
    if order.vertices is not None and order.faces is not None:
        return reader.read("mesh", order.vertices.nbytes + order.faces.nbytes, surface_of, order)
    packed = order.surface.endswith((".gz", ".nii"))  # which may unpack to so much
    n_bytes = MAX_LABEL_BYTES if packed else os.path.getsize(order.surface)
    return reader.read(os.path.basename(order.surface), n_bytes, surface_of, order)


def surface_of(order: Order) -> SurfaceMesh:
    """The surface of the order's file or arrays.

    Raises SurfaceError as ``read_surface`` does.
    """
    if order.vertices is None or order.faces is None:
        return read_surface(order.surface, order.unit, order.axes)
    surface = SurfaceMesh(order.vertices, order.faces, order.name)
    surface = orient_outward(require_closed(keep_organ(surface)))
    require_plausible_size(surface)
    return surface
