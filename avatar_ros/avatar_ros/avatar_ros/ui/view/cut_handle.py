"""The plane that cuts an organ open, with an arrow by which a user moves it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.surface_view import Plane
from avatar_ros.ui.view.tip_body import turn_to

_BESIDE = 0.6  # distance from its centre to the arrow, relative to the organ's size
_SIZE = 0.25  # size of the arrow relative to the organ's
_MOVED = 1e-3  # change of the part from which the handle is put elsewhere


def cut_heights(organ: Organ, normal: np.ndarray) -> tuple[float, float]:
    """Return where a plane of a normal cuts away nothing of an organ, and all of it [m]."""
    heights = organ.vertices @ normal
    return float(heights.max()), float(heights.min())


class CutHandle:
    """One handle; ``on_cut`` is called with the part of the organ's width beyond the plane."""

    def __init__(self, server: viser.ViserServer, on_cut: Callable[[float], None]) -> None:
        self._server, self._on_cut = server, on_cut
        self._handle: Any = None
        self._shown: tuple[str, tuple[float, ...]] | None = None  # organ and normal
        self._heights = (0.0, 1.0)  # heights of the plane where nothing is cut away, and all [m]
        self._normal = np.zeros(3)

    def show(self, organ: Organ, normal: np.ndarray, part: float) -> Plane:
        """Put the handle where a part is cut away from the side of a normal; return the plane."""
        self._heights, self._normal = cut_heights(organ, normal), normal
        first, last = self._heights
        height = first + part * (last - first)
        place = organ.centre + (height - float(organ.centre @ normal)) * normal
        side = np.roll(np.abs(normal), 1)  # square to the normal, which is an axis
        place = place + _BESIDE * organ.size * side
        shown = (organ.id, tuple(normal.tolist()))
        if self._handle is None or self._shown != shown:
            self.hide()
            self._shown = shown
            self._handle = self._server.scene.add_transform_controls(
                "/organ/cut",
                scale=_SIZE * organ.size,
                active_axes=(False, False, True),
                disable_rotations=True,
                disable_sliders=True,
                depth_test=False,
                wxyz=turn_to(normal),
                position=tuple(place),
            )
            self._handle.on_update(lambda _: self._moved())
        elif abs(self._part() - part) > _MOVED:  # not while the user holds it there
            self._handle.position = tuple(place)
        return Plane(height * normal, normal)

    def hide(self) -> None:
        """Hide the handle: no plane cuts."""
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    def _part(self) -> float:
        first, last = self._heights
        height = float(np.array(self._handle.position) @ self._normal)
        return float(np.clip((height - first) / (last - first), 0.0, 1.0))

    def _moved(self) -> None:
        if self._handle is not None:
            self._on_cut(self._part())
