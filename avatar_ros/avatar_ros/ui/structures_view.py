"""What lies inside the organ on the planning page, as tumours: shaded, moved with the organ."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import viser

from avatar_ros.ui import tone
from avatar_ros.ui.colours import lightness, shaded
from avatar_ros.ui.surface_view import own

STRUCTURE = (213, 94, 0)  # vermilion of Okabe and Ito, distinguishable for all
_N_SHADES = 8


class _Part(NamedTuple):
    """Triangles of one shade, and the points of the cloud that they use."""

    mesh: Any
    used: np.ndarray


class StructuresView:
    """Draws the structures of an organ, each in several shades."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._parts: list[_Part] = []

    def show(self, vertices: np.ndarray, structures: dict[str, np.ndarray]) -> None:
        """Show those of another organ, at rest; none of the last one stays."""
        for part in self._parts:
            part.mesh.remove()
        self._parts = [
            part
            for i, faces in enumerate(structures.values())
            for part in self._shades(i, vertices, faces)
        ]

    def _shades(self, number: int, vertices: np.ndarray, faces: np.ndarray) -> list[_Part]:
        light = lightness(vertices, faces)[faces].mean(axis=1)
        shade = np.minimum((_N_SHADES * light).astype(int), _N_SHADES - 1)
        seen = shaded(STRUCTURE, (np.arange(_N_SHADES) + 0.5) / _N_SHADES)
        parts = []
        for k, colour in enumerate(tone.material(seen).tolist()):
            if not (shade == k).any():
                continue
            used, local = own(faces[shade == k])
            mesh = self._server.scene.add_mesh_simple(
                f"/structures/{number}/{k}",
                vertices[used],
                local,
                color=tuple(colour),
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            parts.append(_Part(mesh, used))
        return parts

    def move(self, points: np.ndarray) -> None:
        """Move them as in a cloud, (n, 3) [m]."""
        for part in self._parts:
            part.mesh.vertices = np.ascontiguousarray(points[part.used], np.float32)
