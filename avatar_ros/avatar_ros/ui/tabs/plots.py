"""Curves over time on the planning page."""

from __future__ import annotations

from typing import Any

import numpy as np
from viser import uplot

_PADDING = (14, 22, 0, 0)  # so that no number on an axis is cut [px]


def plot(gui: Any, what: str, height: int, least: float, *curves: Any, bands: Any = None) -> Any:
    """An empty plot of some curves over time.

    height : [px]; least : of the range of values, so that rest is a line at the bottom
    """
    values = {
        "min": {"pad": 0, "soft": 0, "mode": 1},
        "max": {"pad": 0.1, "soft": least, "mode": 1},
    }
    return gui.add_uplot(
        tuple(np.zeros(2) for _ in range(1 + len(curves))),
        (uplot.Series(label="time [s]"), *curves),
        title=f"{what} over time [s]",
        scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=values)},
        axes=(uplot.Axis(), uplot.Axis()),
        bands=bands,
        height=height,
        padding=_PADDING,
    )
