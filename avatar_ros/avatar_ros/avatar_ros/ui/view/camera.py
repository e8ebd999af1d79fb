"""The camera of each browser: standard views, a cube that shows the direction, and a scale."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import viser

from avatar_ros.ui.view.orientation import (
    AXES,
    FOV,
    Pose,
    basis,
    cube,
    scale_bar,
    seen_letters,
    standard_view,
    view_beside,
)

FIRST = "A"
_LINE = (150, 150, 150)
_NEAR = 0.001  # [m]
_UNDER = 0.06  # distance from the scale to its number, in lengths of the scale


class _Nodes(NamedTuple):
    """Nodes that are drawn for one browser."""

    line: Any
    length: Any
    letters: dict[str, Any]


class Cameras:
    """Turns all cameras; each shows its own cube and scale.

    on_cube : called with a browser and the drawing of its cube
    tips : of the tools [m], beside which numbers are; letters avoid them at the next turn
    """

    def __init__(self, server: viser.ViserServer, on_cube: Callable[[Any, str], None]) -> None:
        self._server, self._on_cube = server, on_cube
        self._centre, self._size = np.zeros(3), 0.2
        self._vertices = np.zeros((1, 3))  # vertices of the organ [m]
        self.tips = np.zeros((0, 3))
        self._nodes: dict[int, _Nodes] = {}
        self._lock = Lock()
        server.on_client_connect(self._connected)
        server.on_client_disconnect(self._left)

    def show(self, vertices: np.ndarray) -> None:
        """Place letters around another organ, and show its first view."""
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self._centre, self._size = 0.5 * (low + high).astype(float), float((high - low).max())
        self._vertices = vertices
        first = standard_view(FIRST, self._centre, self._size)
        camera = self._server.initial_camera
        camera.near, camera.fov = _NEAR, FOV
        camera.position, camera.look_at = first.position, first.look_at
        camera.up = tuple(first.up)
        self.turn_to(FIRST)
        for client in self._server.get_clients().values():
            if client.client_id in self._nodes:
                self._moved(client, client.camera)

    def turn_to(self, side: str) -> None:
        """Show a standard view of the organ, as "A", in every browser."""
        self._turn(partial(standard_view, side, self._centre, self._size))

    def turn_beside(self, outward: np.ndarray) -> None:
        """Show the view from the side of a surface's normal, in every browser."""
        self._turn(partial(view_beside, outward, self._centre, self._size))

    def _turn(self, view: Callable[[float], Pose]) -> None:
        """Turn the camera of every browser, with the view for its picture's aspect."""
        for client in self._server.get_clients().values():
            turn_camera(client, view(client.camera.aspect))

    def _connected(self, client: Any) -> None:
        line = client.scene.add_line_segments(
            "/scale/bar",
            np.zeros((1, 2, 3), np.float32),
            _LINE,
            thickness=4.0,
            thickness_units="screen",
        )
        length = client.scene.add_label("/scale/length", "", anchor="top-center")
        letters = {
            letter: client.scene.add_label(
                f"/orientation/{letter}",
                letter,
                anchor="center-center",
                font_screen_scale=1.3,
                visible=False,
            )
            for letter in AXES
        }
        self._nodes[client.client_id] = _Nodes(line, length, letters)
        client.camera.on_update(lambda camera: self._moved(client, camera))

    def _left(self, client: Any) -> None:
        self._nodes.pop(client.client_id, None)

    def _moved(self, client: Any, camera: Any) -> None:
        nodes = self._nodes.get(client.client_id)
        if nodes is None:
            return
        with self._lock:  # calls come in threads, and the last picture must show the last pose
            self._draw(client, nodes, camera)

    def _draw(self, client: Any, nodes: _Nodes, camera: Any) -> None:
        pose, fov = pose_of(camera), camera.fov
        length, ends = scale_bar(pose, fov, self._size)
        bar = ends.mean(axis=0)
        seen = seen_letters(self._vertices, pose, fov, bar, self.tips, camera.aspect)
        with client.atomic():
            nodes.line.points = ends[None].astype(np.float32)
            nodes.length.position = tuple(bar - _UNDER * length * basis(pose)[1])
            _set(nodes.length, "text", f"{1e3 * length:g} mm")
            for letter, label in nodes.letters.items():
                _set(label, "visible", letter in seen)
                if letter in seen:
                    label.position = tuple(seen[letter])
        self._on_cube(client, cube(pose))


def _set(node: Any, name: str, value: Any) -> None:
    """Change a property of a node, and send it only if it differs."""
    if getattr(node, name) != value:
        setattr(node, name, value)


def pose_of(camera: Any) -> Pose:
    """Return the pose of a browser's camera."""
    return Pose(np.array(camera.position), np.array(camera.look_at), np.array(camera.up_direction))


def turn_camera(client: Any, pose: Pose) -> None:
    """Turn the camera of a browser."""
    camera = client.camera
    with client.atomic():
        camera.up_direction = pose.up
        camera.position = pose.position
        camera.look_at = pose.look_at
