"""The tools of the planning page: their names, where each is to go, and which one is chosen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from avatar_ros.ui.history import History
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.tool_state import SharedToolState

_LIFT = 0.03  # off the organ [m]


class Tools:
    """Those of the contact node, in its order; each change of a place can be undone.

    Parameters
    ----------
    state : where their places are
    history : of the changes
    organ : gives the one that is shown, None before the first

    Attributes
    ----------
    names : of all; none until the contact node was asked
    chosen : place in the list of the one that keys and buttons move, and whose numbers are shown
    """

    def __init__(
        self, state: SharedToolState, history: History, organ: Callable[[], Organ | None]
    ) -> None:
        self._state, self._history, self._organ = state, history, organ
        self.names: tuple[str, ...] = ()
        self.chosen = 0
        state.use(np.zeros((1, 3)))  # so many are drawn until then

    @property
    def name(self) -> str:
        """Of the chosen one; empty before the contact node was asked."""
        return self.names[self.chosen] if self.names else ""

    @property
    def labels(self) -> tuple[str, ...]:
        """Names where they have to be said: of one tool alone, it is not."""
        return self.names if len(self.names) > 1 else ("",)

    @property
    def label(self) -> str:
        """Of the chosen one."""
        return self.labels[self.chosen]

    def use(self, names: Sequence[str], targets: np.ndarray) -> None:
        """Other tools, and where they are to go, shape (n, 3) [m]; while no driver runs."""
        self.names, self.chosen = tuple(names), 0
        self._state.use(targets)
        self._history.forget()

    def choose(self, name: str) -> None:
        """Choose one; a name that is none of theirs changes nothing."""
        if name in self.names:
            self.chosen = self.names.index(name)

    @property
    def targets(self) -> np.ndarray:
        """Where all are to go, shape (n, 3) [m]; a copy."""
        return np.array(self._state.each["target"])

    def put_all(self, targets: np.ndarray) -> None:
        """Send all to places, which cannot be undone, shape (n, 3) [m]."""
        self._state.each["target"] = targets

    def put(self, tool: int, target: np.ndarray) -> None:
        """Send one to a place, which cannot be undone, shape (3,) [m]."""
        self._state.each["target"][tool] = target

    def drag(self, tool: int, target: np.ndarray, along_shaft: bool) -> None:
        """Choose a tool, and move it to where the mouse is, or as far along its shaft as the mouse
        moved up."""
        organ = self._organ()
        if organ is None or not np.isfinite(target).all():
            return
        self.chosen = tool
        if along_shaft:
            here = self._state.sent[tool]
            target = here + float((target - here)[2]) * organ.outward(here)
        self._move(target, "drag")

    def nudge(self, axis: Any, way: float) -> None:
        """Move the chosen tool along an axis, None for the surface's normal, by a distance [m]."""
        organ, target = self._organ(), self.targets[self.chosen]
        if axis is None and organ is not None:
            axis = organ.outward(target)
        if axis is not None:
            self._move(target + way * np.asarray(axis), "nudge")

    def lift(self) -> None:
        """Move the chosen tool off the organ."""
        organ = self._organ()
        if organ is not None:
            self._move(organ.lifted(self.targets[self.chosen], _LIFT), "lift")

    def _move(self, target: np.ndarray, how: str) -> None:
        tool, before = self.chosen, self.targets[self.chosen]
        whose = self.label or "the tool"
        self._history.note(f"{how} {tool}", f"the place of {whose}", lambda: self.put(tool, before))
        self.put(tool, target)
