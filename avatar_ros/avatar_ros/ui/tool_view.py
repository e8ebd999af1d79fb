"""The tool on the planning page: its tip, its shaft, and the force on it with its number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from avatar_core.geometry.tip import Tip
from avatar_ros.ui import tone
from avatar_ros.ui.colours import lightness, shaded
from avatar_ros.ui.glb import unlit_glb
from avatar_ros.ui.tip_body import shaft_body, tip_body

TOOL, SHAFT = (0, 114, 178), (150, 160, 170)
ARROW = (213, 94, 0)
LEAST_FORCE = 1e-3  # that is shown [N]
_UNSEEN = 1e-5  # change of positions [m], turns and forces [N] that nobody sees
_SCALE = 0.004  # length of the arrow per force [m/N]
_LENGTHS = (0.012, 0.06)  # of the arrow, at least and at most [m]


class ToolView:
    """Draws the tool; ``on_drag`` gets where a user drags its tip to [m], and whether along the
    shaft alone."""

    def __init__(
        self, server: viser.ViserServer, on_drag: Callable[[np.ndarray, bool], None]
    ) -> None:
        self._server, self._on_drag = server, on_drag
        self._tool: Any = None
        self._arrow: Any = None
        self._number: Any = None
        self._placed: np.ndarray | None = None  # tip, turn and force that are seen

    def show(self, tip: Tip, position: np.ndarray, wxyz: np.ndarray) -> None:
        """Show a tool at a position [m]."""
        self._placed = None
        scene = self._server.scene
        body, shaft = tip_body(tip), shaft_body(tip)
        self._tool = scene.add_glb(
            "/tools/tool", _shaded_glb(body, TOOL), position=position, wxyz=wxyz, cast_shadow=False
        )
        scene.add_glb("/tools/tool/shaft", _shaded_glb(shaft, SHAFT), cast_shadow=False)
        self._tool.on_drag("left")(lambda event: self._dragged(event, False))
        self._tool.on_drag("left", modifier="shift")(lambda event: self._dragged(event, True))
        self._arrow = scene.add_arrows(
            "/tools/force",
            np.zeros((1, 2, 3)),
            tuple(tone.instance(np.array(ARROW)).tolist()),
            shaft_radius=0.0015,
            head_radius=0.004,
            head_length=0.008,
            visible=False,
        )
        self._number = scene.add_label(
            "/tools/force_number", "", visible=False, anchor="bottom-center", font_screen_scale=1.1
        )

    @property
    def is_shown(self) -> bool:
        return self._tool is not None

    @property
    def position(self) -> np.ndarray:
        """Of the tip [m]."""
        return np.array(self._tool.position)

    def _dragged(self, event: Any, along_shaft: bool) -> None:
        way = np.array(event.end_position) - np.array(event.start_position)
        self._on_drag(self.position + way, along_shaft)

    def place(self, tip: np.ndarray, wxyz: np.ndarray, force: np.ndarray) -> None:
        """Show the tool at its tip [m], with the force on it [N].

        Nothing is sent where nothing changes: a browser draws only then.
        """
        now = np.concatenate([tip, wxyz, force])
        if self._placed is not None and np.abs(now - self._placed).max() < _UNSEEN:
            return
        self._placed = now
        self._tool.position, self._tool.wxyz = tuple(tip), wxyz
        size = float(np.linalg.norm(force))
        is_felt = size > LEAST_FORCE
        if is_felt:
            end = tip + force * (np.clip(_SCALE * size, *_LENGTHS) / size)
            self._arrow.points = np.stack([tip, end])[None]
            self._number.position = tuple(end)
            text = f"{size:.1f} N"
            if self._number.text != text:
                self._number.text = text
        if self._arrow.visible != is_felt:
            self._arrow.visible = self._number.visible = is_felt


def _shaded_glb(body: tuple[np.ndarray, np.ndarray], colour: tuple[int, int, int]) -> bytes:
    vertices, faces = body
    return unlit_glb(vertices, faces, shaded(colour, lightness(vertices, faces)))
