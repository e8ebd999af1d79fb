"""Structures inside the organ on the planning page, e.g. tumours: shaded, moved with the organ."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import viser

from avatar_ros.ui.view import tone
from avatar_ros.ui.view.colours import lightness, shaded
from avatar_ros.ui.view.surface_view import own

STRUCTURE = (213, 94, 0)  # vermilion of Okabe and Ito, distinguishable for all
FLESH = (150, 40, 45)  # colour of a cut's walls
_N_SHADES = 8


class _Part(NamedTuple):
    """Triangles of one shade of a structure, and the points of the cloud that they use."""

    name: str
    shade: int
    mesh: Any
    used: np.ndarray


class StructuresView:
    """Draws the structures of an organ, each in several shades."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._parts: list[_Part] = []

    def show(self, vertices: np.ndarray, structures: dict[str, np.ndarray]) -> None:
        """Show the structures of another organ, at rest, in place of the last ones."""
        for part in self._parts:
            part.mesh.remove()
        self._parts = [
            part
            for i, (name, faces) in enumerate(structures.items())
            for part in self._shades(i, name, vertices, faces)
        ]

    def style(self, name: str, is_seen: bool, colour: tuple[int, int, int], opacity: float) -> None:
        """Show a structure in a colour, 0 to 255, or hide it."""
        colours = _shades_of(colour)
        with self._server.atomic():
            for part in self._parts:
                if part.name == name:
                    part.mesh.visible = is_seen
                    part.mesh.color = tuple(colours[part.shade])
                    part.mesh.opacity = None if opacity >= 1.0 else opacity

    def _shades(
        self, number: int, name: str, vertices: np.ndarray, faces: np.ndarray
    ) -> list[_Part]:
        light = lightness(vertices, faces)[faces].mean(axis=1)
        shade = np.minimum((_N_SHADES * light).astype(int), _N_SHADES - 1)
        parts = []
        for k, colour in enumerate(_shades_of(STRUCTURE)):
            if not (shade == k).any():
                continue
            used, local = own(faces[shade == k])
            mesh = self._server.scene.add_mesh_simple(
                f"/structures/{number}/{k}",
                vertices[used],
                local,
                color=np.array(colour),
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            parts.append(_Part(name, k, mesh, used))
        return parts

    def move(self, points: np.ndarray) -> None:
        """Move the structures as in a cloud, (n, 3) [m]."""
        for part in self._parts:
            part.mesh.vertices = np.ascontiguousarray(points[part.used], np.float32)


def _shades_of(colour: tuple[int, int, int]) -> list[list[int]]:
    """Return the sent colours for the shades of a colour, from dark to light."""
    seen = shaded(colour, (np.arange(_N_SHADES) + 0.5) / _N_SHADES)
    return [[int(x) for x in row] for row in tone.material(seen)]
