"""A patient's surface before anything is solved, with the patterns of clamp and access."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser

from avatar_ros.patients.protocol import ACCESSIBLE, CLAMPED, FIRST_SPRING, FREE
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
        self._root = server.scene.add_frame(_ROOT, show_axes=False, visible=False)

    def show(self, points: np.ndarray, faces: np.ndarray, regions: np.ndarray) -> None:
        """Show a surface; points (n, 3) [m], faces (m, 3), regions (m,) of the faces."""
        with self._server.atomic():
            marks = Marks(regions == CLAMPED, regions >= FIRST_SPRING, regions == ACCESSIBLE)
            self._surface.show(points, faces, marks)
            self._root.visible = True
            self._set_aside(True)

    def hide(self) -> None:
        """Show the organ in use again."""
        self._root.visible = False
        self._set_aside(False)
