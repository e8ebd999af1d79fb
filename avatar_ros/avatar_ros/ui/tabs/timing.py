"""How well the contact loop keeps its time."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from viser import uplot

from avatar_ros.ui.tabs.plots import plot


class TimingTab:
    """Plots of step times and of periods that came late."""

    def __init__(self, gui: Any) -> None:
        self._loop: deque[tuple[float, float, float]] = deque(maxlen=60)
        self._steps = plot(
            gui,
            "Time of a step [ms]",
            110,
            1.0,
            uplot.Series(label="99 % of steps take at most [ms]", stroke="#0072B2", width=2),
        )
        self._missed = plot(
            gui,
            "Late periods [1/s]",
            110,
            10.0,
            uplot.Series(label="late periods [1/s]", stroke="#D55E00", width=2),
        )

    def show_loop(self, now: float, step: float, missed: float) -> None:
        """Plot the 99th percentile of step times [s] and the missed periods of the last second."""
        self._loop.append((now, 1e3 * step, missed))
        times, steps, late = np.array(self._loop).T
        self._steps.data = (times.copy(), steps.copy())
        self._missed.data = (times.copy(), late.copy())
