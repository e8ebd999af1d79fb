"""Measuring: kind of place that a click adds, and the numbers of all places."""

from __future__ import annotations

from html import escape
from typing import Any

from avatar_ros.ui.measure.measures import PLANE, PROBE, RULER, TOOL, Measures


class MeasureTab:
    """Choice of the places that clicks add, and a list of numbers."""

    def __init__(self, gui: Any, measures: Measures) -> None:
        mode = gui.add_dropdown("A click places", (TOOL, PROBE, RULER, PLANE))
        mode.on_update(lambda event: setattr(measures, "mode", event.target.value))
        gui.add_button("Clear measures").on_click(lambda _: measures.clear())
        self._numbers = gui.add_html("")
        gui.add_markdown("Click on the organ; drag a dot to move it. Places move with the tissue.")

    def show(self, lines: list[str]) -> None:
        """Show the numbers, one line each."""
        content = "<br>".join(escape(line) for line in lines)
        style = "margin:0 1em;font-size:14px;line-height:1.6;min-height:9em"
        whole = f'<div id="measures" style="{style}">{content}</div>'
        if self._numbers.content != whole:
            self._numbers.content = whole
