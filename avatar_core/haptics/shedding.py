"""Load shedding: fewer modes as soon as the machine is overloaded, more again with hysteresis.

A window of steps is *overloaded* if too many periods were missed or steps took longer than the
deadline. It is *calm* if almost none were missed and there is a margin. One overloaded window sheds
a level; a number of calm ones in a row restores one. If the machine is then overloaded again, that
number doubles. The lowest level is never shed; the force does not depend on the shown modes.
"""

from __future__ import annotations

from collections.abc import Sequence

OVERLOADED = 0.01  # fraction of periods that were missed
CALM = 0.001
ROOM = 0.8  # of the deadline
PATIENCE = 5  # calm windows before a level is restored
_LONGEST = 80  # windows


class Shedder:
    """Controller of the number of modes from one window to the next.

    Parameters
    ----------
    levels : Sequence[int]
        Numbers of modes; the largest is for a machine that is not overloaded.
    deadline : float
        Deadline of a step [s]; infinity for none.
    """

    def __init__(self, levels: Sequence[int], deadline: float = float("inf")) -> None:
        self._levels = sorted(set(levels))
        self._deadline = deadline
        self._level = len(self._levels) - 1
        self._calm = 0
        self._patience = PATIENCE
        self._restored = False  # the last change restored a level

    @property
    def modes(self) -> int:
        """Modes to show."""
        return self._levels[self._level]

    @property
    def is_shedding(self) -> bool:
        """Whether fewer modes are shown than could be."""
        return self._level < len(self._levels) - 1

    def update(self, missed: float, step_p99: float) -> int:
        """Return the number of modes after a window. Real-time safe; meant for once a window.

        Parameters
        ----------
        missed : float
            Fraction of its periods that were missed.
        step_p99 : float
            99th percentile of its steps' times [s]; NaN without steps.
        """
        if missed > OVERLOADED or step_p99 > self._deadline:
            self._shed()
        elif missed > CALM or step_p99 > ROOM * self._deadline:
            self._calm = 0
        else:
            self._calm += 1
            if self._calm >= self._patience and self.is_shedding:
                self._level, self._calm, self._restored = self._level + 1, 0, True
            elif self._calm >= self._patience and self._restored:
                self._patience, self._restored = PATIENCE, False  # the machine keeps up
        return self.modes

    def rest(self) -> int:
        """Return all modes again, after a window in which nobody looked."""
        self._level, self._calm, self._restored = len(self._levels) - 1, 0, False
        return self.modes

    def _shed(self) -> None:
        if self._restored:
            self._patience = min(2 * self._patience, _LONGEST)
        self._level, self._calm, self._restored = max(0, self._level - 1), 0, False
