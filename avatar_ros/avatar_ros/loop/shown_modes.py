"""Errors and times promised for the model in use, and how many of its modes are shown."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from avatar_core.contact.haptics.shedding import Shedder
from avatar_core.vademecum.accuracy import AccuracyCurve, CurvePoint, mode_levels
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
    """The shown modes of one model; the node calls it once for each window.

    Parameters
    ----------
    model : ContactModel
    curve : points that differ in modes alone; None where none was measured
    deadline : of a step [s]; infinity for none
    """

    def __init__(self, model: Any, curve: AccuracyCurve | None, deadline: float) -> None:
        self._model = model
        self._points: dict[int, CurvePoint] = {}
        if curve is not None:
            self._points = {p.detail.modes: p for p in curve.points}
        levels = list(self._points) or list(mode_levels(model.n_modes))
        fewer = (n for n in levels if LEAST_SHOWN <= n < model.n_modes)
        self._shedder = Shedder([*fewer, model.n_modes], deadline)

    @property
    def promise(self) -> str:
        """The errors and times promised while all modes are shown, in words."""
        point = self._points.get(self._model.n_modes)
        text = f"{self._model.n_modes} modes"
        if point is not None:
            text += (
                f", displacement within {point.l2:.1%} and force within {point.force:.1%} for 95 % "
                "of touches"
            )
            if not math.isnan(point.p99):
                text += f", steps of {point.p99 * 1e6:.0f} us"
        return text

    def set_times(self, curve: AccuracyCurve) -> None:
        """Promise the same errors with times that were measured on this machine."""
        self._points = {p.detail.modes: p for p in curve.points}

    def set_deadline(self, deadline: float) -> None:
        """Leave out modes by another deadline from now on [s]."""
        self._shedder.deadline = deadline

    def update(self, statistics: LoopStatistics, watched: bool = True) -> ShownModesReport:
        """Complete a window's statistics with its modes, and choose those of the next window.

        The loop reads the new number at its next step.

        watched : a tool touches the organ, or somebody receives what is shown; else all modes are
        """
        before = self._model.n_shown
        self._describe(statistics, before)
        missed = statistics.missed / max(statistics.periods, 1)
        shedder = self._shedder
        modes = shedder.update(missed, statistics.step_p99) if watched else shedder.rest()
        self._model.show(modes)
        text = f"{modes} of {self._model.n_modes} modes shown"
        if shedder.is_shedding:
            text += (
                f": {missed:.1%} of the periods missed, 99 % of steps within "
                f"{statistics.step_p99 * 1e6:.0f} us; the force keeps all modes"
            )
        return ShownModesReport(text, shedder.is_shedding, modes != before)

    def _describe(self, statistics: LoopStatistics, shown: int) -> None:
        measured = [n for n in self._points if n <= shown]
        point = self._points[max(measured)] if measured else None  # more modes are no less accurate
        statistics.modes_shown, statistics.modes = shown, self._model.n_modes
        statistics.promised_l2 = point.l2 if point else _NAN
        statistics.promised_force = point.force if point else _NAN
        exact = self._points.get(shown)
        statistics.promised_step_p99 = exact.p99 if exact else _NAN
