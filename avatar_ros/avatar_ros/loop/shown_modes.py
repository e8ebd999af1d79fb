"""How many modes of the model in use are shown, and the errors certified for them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from avatar_core.haptics.shedding import Shedder
from avatar_core.vademecum.accuracy import AccuracyCurve, Budget, choose, mode_levels
from avatar_ros.msg import LoopStatistics

LEAST_SHOWN = 3  # modes: with fewer, the organ under a tip no longer looks right
_NAN = float("nan")


@dataclass(frozen=True)
class ShownModesReport:
    """One line on the shown modes, for logs and diagnostics.

    shedding : modes are left out because the machine is busy
    changed : the number of modes differs from that of the last window
    """

    text: str
    shedding: bool
    changed: bool


class ShownModes:
    """The shown modes of the loop's data; the node calls it once for each window.

    Parameters
    ----------
    data : ContactData
    curve : of its cloud; None where none was measured
    """

    def __init__(self, data: Any, curve: AccuracyCurve | None) -> None:
        self._data, self._curve = data, curve
        self._points = {p.detail.modes: p for p in curve.points} if curve else {}
        self.keep(None)

    def keep(self, budget: Budget | None) -> None:
        """Show the modes that a budget chooses, all for None, and fewer when steps are late.

        Raises
        ------
        AccuracyError
            If no number of modes meets the budget; everything then stays as it is.
        """
        most = self._data.model.n_modes
        if budget is not None:
            most = choose(self._curve, budget).detail.modes
        self._most = most
        fewer = (n for n in mode_levels(most) if LEAST_SHOWN <= n < most)
        self._shedder = Shedder([*fewer, most], budget.deadline if budget else math.inf)
        self._data.show(most)

    @property
    def accuracy(self) -> str:
        """The errors certified for the modes that are shown unless steps are late, in words."""
        point = self._points.get(self._most)
        text = f"{self._most} modes"
        if point is not None:
            text += (
                f", displacement within {point.l2:.1%} and force within {point.force:.1%} for 95 % "
                "of touches"
            )
        return text

    def update(self, statistics: LoopStatistics, watched: bool = True) -> ShownModesReport:
        """Complete a window's statistics with its modes, and choose those of the next window.

        The loop reads the new number at its next step.

        watched : a tool touches the organ, or somebody receives what is shown; else all modes are
        """
        before = self._data.n_shown
        self._describe(statistics, before)
        missed = statistics.missed / max(statistics.periods, 1)
        shedder = self._shedder
        modes = shedder.update(missed, statistics.step_p99) if watched else shedder.rest()
        self._data.show(modes)
        text = f"{modes} of {self._most} modes shown"
        if shedder.is_shedding:
            text += (
                f": {missed:.1%} of the periods missed, 99 % of steps within "
                f"{statistics.step_p99 * 1e6:.0f} us; the force keeps all modes"
            )
        return ShownModesReport(text, shedder.is_shedding, modes != before)

    def _describe(self, statistics: LoopStatistics, shown: int) -> None:
        measured = [n for n in self._points if n <= shown]
        point = self._points[max(measured)] if measured else None  # more modes are no less accurate
        statistics.modes_shown, statistics.modes = shown, self._most
        statistics.promised_l2 = point.l2 if point else _NAN
        statistics.promised_force = point.force if point else _NAN
