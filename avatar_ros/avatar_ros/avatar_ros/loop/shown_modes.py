"""Number of shown modes of the model in use, and the errors certified for them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from avatar_core.haptics.shedding import Shedder
from avatar_core.vademecum.accuracy import AccuracyCurve, Budget, choose, mode_levels
from avatar_interfaces.msg import LoopStatistics

LEAST_SHOWN = 3  # least modes: with fewer, the organ under a tip no longer looks right
_NAN = float("nan")


@dataclass(frozen=True)
class ShownModesReport:
    """One line on the shown modes, for logs and diagnostics.

    Attributes
    ----------
    shedding : bool
        Whether modes are left out because the machine is busy.
    changed : bool
        Whether the number of modes differs from that of the last window.
    """

    text: str
    shedding: bool
    changed: bool


class ShownModes:
    """The shown modes of the loop's data; the node calls it once for each window.

    Parameters
    ----------
    data : ContactData
        Data of the loop.
    curve : AccuracyCurve, optional
        Accuracy of its cloud; None where none was measured.
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
            If no number of modes meets the budget; nothing changes then.
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
        """Return the certified errors of the modes shown while no steps are late, in words."""
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

        Parameters
        ----------
        statistics : LoopStatistics
            Message of the window, to be completed.
        watched : bool
            Whether a tool touches the organ or somebody receives the cloud; if not, all modes are
            shown.
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
        # more modes are at least as accurate
        point = self._points[max(measured)] if measured else None
        statistics.modes_shown, statistics.modes = shown, self._most
        statistics.promised_l2 = point.l2 if point else _NAN
        statistics.promised_force = point.force if point else _NAN
