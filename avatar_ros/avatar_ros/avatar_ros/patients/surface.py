"""The surface of a patient, from a file or from a message, with the same checks."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from avatar_core.geometry.label_files import is_label_map
from avatar_core.geometry.surface import (
    SurfaceMesh,
    keep_organ,
    orient_outward,
    read_surface,
    require_closed,
    require_plausible_size,
)
from avatar_core.geometry.tumour import read_tumour
from avatar_core.geometry.volumes import MAX_VOXEL_BYTES
from avatar_ros.framework.reader import Reader
from avatar_ros.patients.protocol import PatientRequest


def read_confined(request: PatientRequest, reader: Reader) -> SurfaceMesh:
    """Return :func:`surface_of`, read in the process of a reader.

    Raises AvatarError for anything but the surface of an organ.
    """
    if request.vertices is not None and request.faces is not None:
        return reader.read(
            "mesh", request.vertices.nbytes + request.faces.nbytes, surface_of, request
        )
    # label maps may unpack to MAX_VOXEL_BYTES
    packed = is_label_map(Path(request.surface))
    n_bytes = MAX_VOXEL_BYTES if packed else os.path.getsize(request.surface)
    return reader.read(os.path.basename(request.surface), n_bytes, surface_of, request)


def read_inside(request: PatientRequest, reader: Reader) -> tuple[SurfaceMesh, ...]:
    """Read the structures inside the organ, by their labels, in the process of a reader."""
    name = os.path.basename(request.surface)
    return tuple(
        reader.read(name, MAX_VOXEL_BYTES, structure_of, request, label) for label in request.inside
    )


def structure_of(request: PatientRequest, label: str) -> SurfaceMesh:
    """Return the surface of one label, named after it."""
    found = read_tumour(request.surface, request.unit, request.axes, label)
    return replace(found, name=f"label {label}" if label.isdecimal() else label)


def surface_of(request: PatientRequest) -> SurfaceMesh:
    """Return the surface of the request's file or arrays.

    Raises SurfaceError as ``read_surface`` does.
    """
    if request.vertices is None or request.faces is None:
        return read_surface(
            request.surface, request.unit, request.axes, request.label, request.inside
        )
    surface = SurfaceMesh(request.vertices, request.faces, request.name)
    surface = orient_outward(require_closed(keep_organ(surface)))
    require_plausible_size(surface)
    return surface
