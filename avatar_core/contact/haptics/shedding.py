"""How many modes to show while a machine is busy: fewer at once, more again with patience.

A window of steps is *overloaded* if too many periods were missed or steps took longer than the
deadline, *calm* if next to none were and there is room. One overloaded window sheds a level, a row
of calm ones takes one back; if that one was too many, the next row must be twice as long. The last
level is never shed, and the near field is on every level: under a tip the organ looks right even
then, and the force does not depend on what is shown.
"""

from __future__ import annotations

from collections.abc import Sequence

OVERLOADED = 0.01  # part of the periods that were missed
CALM = 0.001
ROOM = 0.8  # of the deadline
PATIENCE = 5  # calm windows before a level is taken back
_LONGEST = 80  # windows


class Shedder:
    """Chooses among numbers of modes, from one window to the next.

    Parameters
    ----------
    levels : numbers of modes, the last is shown when there is room
    deadline : of a step [s]; infinity for none
    """

    def __init__(self, levels: Sequence[int], deadline: float = float("inf")) -> None:
        self._levels = sorted(set(levels))
        self.deadline = deadline
        self._level = len(self._levels) - 1
        self._calm = 0
        self._patience = PATIENCE
        self._regained = False  # the last change took a level back

    @property
    def modes(self) -> int:
        """Modes to show."""
        return self._levels[self._level]

    @property
    def is_shedding(self) -> bool:
        """Whether fewer modes are shown than could be."""
        return self._level < len(self._levels) - 1

    def update(self, missed: float, step_p99: float) -> int:
        """Modes to show after a window.

        Parameters
        ----------
        missed : part of its periods that were missed
        step_p99 : 99th percentile of its steps' times [s]; NaN of none
        """
        if missed > OVERLOADED or step_p99 > self.deadline:
            self._shed()
        elif missed > CALM or step_p99 > ROOM * self.deadline:
            self._calm = 0
        else:
            self._calm += 1
            if self._calm >= self._patience and self.is_shedding:
                self._level, self._calm, self._regained = self._level + 1, 0, True
            elif self._calm >= self._patience and self._regained:
                self._patience, self._regained = PATIENCE, False  # it was not too many
        return self.modes

    def _shed(self) -> None:
        if self._regained:
            self._patience = min(2 * self._patience, _LONGEST)
        self._level, self._calm, self._regained = max(0, self._level - 1), 0, False
