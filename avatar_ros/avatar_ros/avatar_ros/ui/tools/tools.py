"""The tools of the planning page: names, targets, and the chosen one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Lock
from typing import Any

import numpy as np

from avatar_ros.ui.tools.history import History
from avatar_ros.ui.tools.tool_state import SharedToolState
from avatar_ros.ui.tools.way import LIFT, way_around, way_to
from avatar_ros.ui.view.organ import Organ

OVER = 2e-3  # height over the surface of a tip that is put there [m]
_NEAR = 0.01  # distance to a point of the way from which the next one is aimed at [m]


class Tools:
    """The tools of the contact node, in its order; each change of a place can be undone.

    Parameters
    ----------
    state : shared state of their places
    history : history of the changes
    organ : returns the organ that is shown, None before the first

    Attributes
    ----------
    names : names of all tools; none until the contact node was asked
    chosen : index of the tool that keys and buttons move, and whose numbers are shown
    """

    def __init__(
        self, state: SharedToolState, history: History, organ: Callable[[], Organ | None]
    ) -> None:
        self._state, self._history, self._organ = state, history, organ
        self.names: tuple[str, ...] = ()
        self.chosen = 0
        self._ways: dict[int, list[np.ndarray]] = {}  # points yet to pass, by tool
        self._lock = Lock()  # controls call in threads
        state.use(np.zeros((1, 3)))  # one tool is drawn until then

    @property
    def name(self) -> str:
        """Return the chosen tool's name; empty before the contact node was asked."""
        return self.names[self.chosen] if self.names else ""

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the names as labels: a single tool has none."""
        return self.names if len(self.names) > 1 else ("",)

    @property
    def label(self) -> str:
        """Return the chosen tool's label."""
        return self.labels[self.chosen]

    def use(self, names: Sequence[str], targets: np.ndarray) -> None:
        """Begin with other tools and targets, shape (n, 3) [m]; while no driver runs."""
        self.names, self.chosen = tuple(names), 0
        self._ways = {}
        self._state.use(targets)
        self._history.forget()

    def choose(self, name: str) -> None:
        """Choose a tool; an unknown name changes nothing."""
        if name in self.names:
            self.chosen = self.names.index(name)

    @property
    def targets(self) -> np.ndarray:
        """Return a copy of the targets, shape (n, 3) [m]."""
        return np.array(self._state.each["target"])

    def put_all(self, targets: np.ndarray) -> None:
        """Send all tools to places, shape (n, 3) [m]; this cannot be undone."""
        with self._lock:
            self._ways = {}
            self._state.each["target"] = targets

    def put(self, tool: int, target: np.ndarray) -> None:
        """Send a tool to a place, shape (3,) [m], around the organ; this cannot be undone."""
        organ, here = self._organ(), self._state.sent[tool]
        self._follow(tool, [target] if organ is None else way_to(organ, here, target))

    def _follow(self, tool: int, way: list[np.ndarray]) -> None:
        with self._lock:
            self._state.each["target"][tool], self._ways[tool] = way[0], way[1:]

    def drag(self, tool: int, begin: np.ndarray, way: np.ndarray, along_shaft: bool) -> None:
        """Choose a tool, and move it from the drag's begin as the mouse moved; shape (3,) each [m].

        Along the shaft, the upward part of the mouse's way counts.
        """
        organ = self._organ()
        if organ is None or not np.isfinite(way).all():
            return
        self.chosen = tool
        self._move([begin + (way[2] * organ.outward(begin) if along_shaft else way)], "drag")

    def nudge(self, axis: Any, way: float) -> None:
        """Move the chosen tool along an axis, None for the surface's normal, by a distance [m]."""
        organ, target = self._organ(), self.targets[self.chosen]
        if axis is None and organ is not None:
            axis = organ.outward(target)
        if axis is not None:
            self._move([target + way * np.asarray(axis)], "nudge")

    def lift(self) -> None:
        """Move the chosen tool off the organ."""
        organ = self._organ()
        if organ is not None:
            self._move([organ.lifted(self.targets[self.chosen], LIFT)], "lift")

    def work_jaw(self) -> None:
        """Close or open the jaw of the chosen tool, if it has one."""
        self._state.each["shut"][self.chosen] ^= 1

    def put_over(self, place: np.ndarray, normal: np.ndarray, offset: float) -> None:
        """Move the chosen tool over a clicked place of the surface, around the organ; [m].

        offset : distance of the tip's lowest point from its pose [m]
        """
        organ, here = self._organ(), self._state.sent[self.chosen]
        if organ is not None:
            there = place + (offset + OVER) * normal
            self._move(way_around(organ, here, there, normal), "click")

    def advance(self) -> None:
        """Aim at the next point of each way whose last one was reached; called for every frame."""
        with self._lock:
            left = np.linalg.norm(self._state.sent - self._state.each["target"], axis=1)
            for tool, way in list(self._ways.items()):
                if not way:
                    del self._ways[tool]
                elif left[tool] < _NEAR:
                    self._state.each["target"][tool] = way.pop(0)

    def _move(self, way: list[np.ndarray], how: str) -> None:
        tool, before = self.chosen, self.targets[self.chosen]
        whose = self.label or "the tool"
        self._history.note(f"{how} {tool}", f"the place of {whose}", lambda: self.put(tool, before))
        self._follow(tool, way)
