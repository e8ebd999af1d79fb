"""Probe, ruler, plane and shortest gap as the planning page draws them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser

from avatar_ros.ui.view import tone
from avatar_ros.ui.view.measuring import normal_of

_BLUE, _BLACK, _GREEN = (0, 114, 178), (20, 20, 20), (0, 158, 115)
_ANCHORS: dict[str, Any] = {"ruler": "center-right", "gap": "top-left"}  # anchors of numbers
_DOT = 0.002  # radius [m]
_UNSEEN = 1e-5  # smallest visible change [m]
_PLANE_OPACITY = 0.35
_TWO = np.array([[0, 1, 2], [0, 2, 3]])
_NOWHERE = np.zeros((1, 2, 3), np.float32)


class MeasuresView:
    """Dots, lines and the plane; all hidden until they are placed.

    on_drag : called with the dot that a user drags, and origin [m] and direction of the ray to it
    """

    def __init__(
        self, server: viser.ViserServer, on_drag: Callable[[int, np.ndarray, np.ndarray], None]
    ) -> None:
        scene = server.scene
        self._server = server
        self._dots = [
            scene.add_icosphere(
                f"/measures/dot/{i}", _DOT, color=colour, visible=False, cast_shadow=False
            )
            for i, colour in enumerate((_BLUE, _BLACK, _BLACK, _GREEN, _GREEN, _GREEN))
        ]
        for i, dot in enumerate(self._dots):
            dot.on_drag("left")(partial(_dragged, on_drag, i))
        self._lines = {
            name: scene.add_line_segments(
                f"/measures/{name}",
                _NOWHERE,
                colour,
                thickness=2.5,
                thickness_units="screen",
                visible=False,
            )
            for name, colour in (("ruler", _BLACK), ("gap", _BLUE))
        }
        self._numbers = {
            name: scene.add_label(
                f"/measures/{name}/number", "", anchor=anchor, font_screen_scale=0.9
            )
            for name, anchor in _ANCHORS.items()
        }
        self._plane = scene.add_mesh_simple(
            "/measures/plane",
            np.zeros((4, 3), np.float32),
            _TWO,
            color=tuple(tone.material(np.array(_GREEN)).tolist()),
            opacity=_PLANE_OPACITY,
            side="double",
            cast_shadow=False,
            visible=False,
        )

    def dots(self, first: int, places: list[np.ndarray], n: int) -> None:
        """Show the dots ``first`` to ``first + n - 1`` at places [m]; hide those without one."""
        for i in range(n):
            dot = self._dots[first + i]
            _set(dot, "visible", i < len(places))
            if i < len(places) and np.abs(places[i] - dot.position).max() > _UNSEEN:
                dot.position = tuple(places[i])

    def line(self, name: str, ends: np.ndarray | None) -> None:
        """Show a line between two ends, shape (2, 3) [m], with its length."""
        line, number = self._lines[name], self._numbers[name]
        _set(line, "visible", ends is not None)
        if ends is None or np.abs(ends - line.points[0]).max() < _UNSEEN:
            return
        line.points = ends[None].astype(np.float32)
        number.position = tuple(ends.mean(axis=0))
        _set(number, "text", f"{1e3 * np.linalg.norm(ends[1] - ends[0]):.1f} mm")

    def plane(self, corners: np.ndarray | None, size: float) -> None:
        """Show the plane through three points, shape (3, 3), as a square of a side ``size`` [m]."""
        _set(self._plane, "visible", corners is not None)
        if corners is None:
            return
        normal = normal_of(corners)
        along = corners[1] - corners[0]
        along /= np.linalg.norm(along)
        across, middle = np.cross(normal, along), corners.mean(axis=0)
        square = [
            middle + 0.5 * size * (s * along + t * across)
            for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        if np.abs(np.array(square) - self._plane.vertices).max() > _UNSEEN:
            self._plane.vertices = np.array(square, np.float32)


def _dragged(on_drag: Callable[[int, np.ndarray, np.ndarray], None], dot: int, event: Any) -> None:
    eye = np.array(event.client.camera.position)
    on_drag(dot, eye, np.array(event.end_position) - eye)


def _set(node: Any, name: str, value: Any) -> None:
    if getattr(node, name) != value:
        setattr(node, name, value)
