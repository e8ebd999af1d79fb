"""A patient's surface before the solve, with the patterns of clamp and access."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from avatar_ros.patients.protocol import ACCESSIBLE, CLAMPED, FIRST_SPRING, FREE
from avatar_ros.ui.view.colours import MISSED
from avatar_ros.ui.view.surface_view import Marks, SurfaceView

BRUSHES = {"nothing": None, "clamp": CLAMPED, "access": ACCESSIBLE, "neither": FREE}
_ROOT = "/preview"


class PreviewView:
    """Draws into a viser server, while the organ in use is set aside.

    set_aside : hides the organ in use, or shows it again
    """

    def __init__(self, server: viser.ViserServer, set_aside: Callable[[bool], None]) -> None:
        self._server, self._set_aside = server, set_aside
        self._surface = SurfaceView(server, _ROOT)
        self._surface.mark_reach(True)
        self._missed: Any = None
        self._root = server.scene.add_frame(_ROOT, show_axes=False, visible=False)

    def show(
        self,
        points: np.ndarray,
        faces: np.ndarray,
        regions: np.ndarray,
        missed: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Show a surface; points (n, 3) [m], faces (m, 3), regions (m,) of the faces.

        missed : points [m] and faces of parts of the organ that the surface does not reach
        """
        with self._server.atomic():
            marks = Marks(regions == CLAMPED, regions >= FIRST_SPRING, regions == ACCESSIBLE)
            self._surface.show(points, faces, marks)
            self._mark(*missed)
            self._root.visible = True
            self._set_aside(True)

    def _mark(self, points: np.ndarray, faces: np.ndarray) -> None:
        if self._missed is not None:
            self._missed.remove()
        self._missed = len(faces) and self._server.scene.add_mesh_simple(
            f"{_ROOT}/missed", points.astype(np.float32), faces, color=MISSED, side="double"
        )
        self._missed = self._missed or None

    def hide(self) -> None:
        """Show the organ in use again."""
        self._root.visible = False
        self._set_aside(False)
