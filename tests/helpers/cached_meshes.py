"""Meshes are filled once for all tests, and for all runs of the same code."""

from __future__ import annotations

from avatar_core.geometry import mesh
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.surface import SurfaceMesh
from tests.helpers.content import ByContent
from tests.helpers.disk_cache import cached_on_disk

plain = mesh._fill


class _Solid(ByContent):
    """A surface and the edge it is filled with."""

    def __init__(self, surface: SurfaceMesh, edge: float) -> None:
        self.surface, self.edge = surface, edge
        super().__init__(surface.vertices, surface.faces, edge)


@cached_on_disk
def _filled(solid: _Solid) -> TetMesh:
    return plain(solid.surface, solid.edge)


def fill(surface: SurfaceMesh, edge: float) -> TetMesh:
    """In the place of ``avatar_core.geometry.mesh._fill``; what it refuses is not kept."""
    return _filled(_Solid(surface, edge))
