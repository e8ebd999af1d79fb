"""A tool on the planning page: its tip, its shaft, its name, and the force on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from avatar_core.geometry.tip import Tip
from avatar_ros.ui.view import tone
from avatar_ros.ui.view.colours import lightness, shaded
from avatar_ros.ui.view.glb import unlit_glb
from avatar_ros.ui.view.measuring import hit
from avatar_ros.ui.view.tip_body import along_shaft, shaft_body, tip_body, turned

TOOL, SHAFT = (0, 114, 178), (150, 160, 170)
ARROW = (213, 94, 0)
HELD = (0, 0, 0)  # colour of the mark where a jaw holds tissue
LEAST_FORCE = 1e-3  # smallest force that is shown [N]
_UNSEEN = 1e-5  # smallest visible change of positions [m], turns and forces [N]
_SCALE = 0.004  # length of the arrow per force [m/N]
_BESIDE = 0.01  # distance from a tip without force to its name [m]
# labels around a tip have a quarter each: names, the largest displacement and a gap
_ANCHORS: tuple[Any, Any] = ("bottom-right", "bottom-left")
_LENGTHS = (0.012, 0.06)  # shortest and longest arrow [m]


class ToolView:
    """Draws a tool.

    number : index of the tool, from 0
    on_drag : called with the tool's number, position of its tip when the mouse took it [m], way of
        the mouse since [m], and whether along the shaft alone
    """

    def __init__(
        self,
        server: viser.ViserServer,
        number: int,
        on_drag: Callable[[int, np.ndarray, np.ndarray, bool], None],
    ) -> None:
        self._server, self._number, self._on_drag = server, number, on_drag
        self._root = f"/tools/{number}"
        self._node = server.scene.add_frame(self._root, show_axes=False)
        self._tool: Any = None
        self._arrow: Any = None
        self._mark: Any = None
        self._below = 0.0  # distance of the jaw from the tip's pose [m]
        self._text: Any = None
        self._label = ""
        self._placed: np.ndarray | None = None  # tip, turn and force in the picture
        self._taken = np.zeros((2, 3))  # tip and mouse when a drag began [m]
        # bodies of tip and shaft, upright
        self._bodies: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    def remove(self) -> None:
        """Remove the tool from the picture."""
        self._node.remove()

    def show(self, tip: Tip, position: np.ndarray, wxyz: np.ndarray) -> None:
        """Show a tool at a position [m]."""
        self._placed = None
        scene, root = self._server.scene, self._root
        body, shaft = self._bodies = tip_body(tip), shaft_body(tip)
        self._tool = scene.add_glb(
            f"{root}/body", _shaded_glb(body, TOOL), position=position, wxyz=wxyz, cast_shadow=False
        )
        scene.add_glb(f"{root}/body/shaft", _shaded_glb(shaft, SHAFT), cast_shadow=False)
        self._tool.on_drag("left")(lambda event: self._dragged(event, False))
        self._tool.on_drag("left", modifier="shift")(lambda event: self._dragged(event, True))
        self._arrow = scene.add_arrows(
            f"{root}/force",
            np.zeros((1, 2, 3)),
            tuple(tone.instance(np.array(ARROW)).tolist()),
            shaft_radius=0.0015,
            head_radius=0.004,
            head_length=0.008,
            visible=False,
        )
        self._mark, self._below = None, tip.offset
        if tip.grasp is not None:
            self._mark = scene.add_icosphere(
                f"{root}/held", tip.grasp.radius, HELD, subdivisions=2, visible=False
            )
        self._text = scene.add_label(
            f"{root}/force_number",
            "",
            visible=False,
            anchor=_ANCHORS[self._number % 2],
            font_screen_scale=1.1,
        )

    def name(self, label: str, is_chosen: bool) -> None:
        """Write a name beside the tip, the chosen tool's in brackets; empty: none."""
        text = f"[{label}]" if label and is_chosen else label
        if text != self._label:
            self._label, self._placed = text, None

    @property
    def position(self) -> np.ndarray:
        """Return the position of the tip [m]."""
        return np.array(self._tool.position)

    def distance(self, origin: np.ndarray, direction: np.ndarray) -> float:
        """Return the distance from a ray's origin to the tool [m]; infinite if it misses."""
        found = [np.inf]
        for upright, faces in self._bodies:
            points = self.position + turned(upright, np.array(self._tool.wxyz))
            met = hit(origin, direction, points, faces)
            if met is not None:
                found.append(float(np.linalg.norm(met.at(points) - origin)))
        return min(found)

    def _dragged(self, event: Any, along_shaft: bool) -> None:
        # counted from the drag's begin: a slow browser reports where it drew the tool long ago
        mouse = np.array(event.end_position)
        if event.phase == "start":
            self._taken = np.stack([self.position, mouse])
        tip, begin = self._taken
        self._on_drag(self._number, tip, mouse - begin, along_shaft)

    def place(
        self, tip: np.ndarray, wxyz: np.ndarray, force: np.ndarray, holds: bool = False
    ) -> None:
        """Show the tool at its tip [m], with the force on it [N], and whether its jaw holds tissue.

        Nothing is sent if nothing changes: a browser draws only then.
        """
        now = np.concatenate([tip, wxyz, force, [holds]])
        if self._placed is not None and np.abs(now - self._placed).max() < _UNSEEN:
            return
        self._placed = now
        self._tool.position, self._tool.wxyz = tuple(tip), wxyz
        size = float(np.linalg.norm(force))
        is_felt = size > LEAST_FORCE
        end = tip + _BESIDE * along_shaft(wxyz)
        if is_felt:
            end = tip + force * (np.clip(_SCALE * size, *_LENGTHS) / size)
            self._arrow.points = np.stack([tip, end])[None]
        _set(self._arrow, "visible", is_felt)
        if self._mark is not None:
            self._mark.position = tuple(tip - self._below * along_shaft(wxyz))
            _set(self._mark, "visible", holds)
        words = [self._label, "holds" if holds else "", f"{size:.1f} N" if is_felt else ""]
        text = " ".join(word for word in words if word)
        if text:
            self._text.position = tuple(end)
            _set(self._text, "text", text)
        _set(self._text, "visible", bool(text))


def _set(node: Any, name: str, value: Any) -> None:
    """Change a property of a node, and send it only if it differs."""
    if getattr(node, name) != value:
        setattr(node, name, value)


def _shaded_glb(body: tuple[np.ndarray, np.ndarray], colour: tuple[int, int, int]) -> bytes:
    vertices, faces = body
    return unlit_glb(vertices, faces, shaded(colour, lightness(vertices, faces)))
