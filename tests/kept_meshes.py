"""Meshes of surfaces that are not recorded: filled once for all tests and runs of the same code."""

from __future__ import annotations

import hashlib

import numpy as np

from avatar_core.geometry import mesh
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.surface import SurfaceMesh

from .stored import stored

_plain = mesh._fill


class _Solid:
    """A surface and the edge it is filled with, told by their content."""

    def __init__(self, surface: SurfaceMesh, edge: float) -> None:
        self.surface, self.edge = surface, edge
        shape = hashlib.sha256(np.ascontiguousarray(surface.vertices))
        shape.update(np.ascontiguousarray(surface.faces))
        self._text = f"{shape.hexdigest()} {edge!r}"

    def __repr__(self) -> str:
        return self._text

    def __eq__(self, other: object) -> bool:
        return repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(self._text)


@stored
def _filled(solid: _Solid) -> TetMesh:
    return _plain(solid.surface, solid.edge)


def kept(surface: SurfaceMesh, edge: float) -> TetMesh:
    """In the place of ``avatar_core.geometry.mesh._fill``; what it refuses is not kept."""
    return _filled(_Solid(surface, edge))
