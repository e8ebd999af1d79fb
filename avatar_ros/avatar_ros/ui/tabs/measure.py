"""Measuring: what a click on the organ places, and the numbers of all that was placed."""

from __future__ import annotations

from html import escape
from typing import Any

from avatar_ros.ui.actions import Actions
from avatar_ros.ui.measures import PLANE, PROBE, RULER


class MeasureTab:
    """Choice of what a click places, and a list of numbers."""

    def __init__(self, gui: Any, actions: Actions) -> None:
        mode = gui.add_dropdown("A click places", (PROBE, RULER, PLANE))
        mode.on_update(lambda event: actions.measure(event.target.value))
        gui.add_button("Clear measures").on_click(lambda _: actions.clear_measures())
        self._numbers = gui.add_html("")
        gui.add_markdown("Click on the organ. Places move with the tissue.")

    def show(self, lines: list[str]) -> None:
        """Show the numbers, one line each."""
        content = "<br>".join(escape(line) for line in lines)
        style = "margin:0 1em;font-size:14px;line-height:1.6;min-height:9em"
        whole = f'<div id="measures" style="{style}">{content}</div>'
        if self._numbers.content != whole:
            self._numbers.content = whole
