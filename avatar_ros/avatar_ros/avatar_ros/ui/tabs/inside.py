"""Structures inside the organ: name, visibility, colour and opacity of each."""

from __future__ import annotations

from functools import partial
from typing import Any

from avatar_ros.ui.view.structures_view import STRUCTURE
from avatar_ros.ui.view.view import OrganView


class InsideTab:
    """A row of controls for each structure of the vademecum in use."""

    def __init__(self, gui: Any, view: OrganView) -> None:
        self._gui, self._view = gui, view
        self._folder = gui.add_folder("Inside the organ", expand_by_default=False, visible=False)
        self._rows: list[Any] = []

    def show(self, names: tuple[str, ...]) -> None:
        """List the structures of another organ."""
        for row in self._rows:
            row.remove()
        self._rows = []
        self._folder.visible = bool(names)
        with self._folder:
            for name in names:
                is_seen = self._gui.add_checkbox(f"Show {name}", True)
                colour = self._gui.add_rgb(f"{name}: colour", STRUCTURE)
                opacity = self._gui.add_slider(
                    f"{name}: opacity [%]", min=10, max=100, step=5, initial_value=100
                )
                row = (is_seen, colour, opacity)
                for control in row:
                    control.on_update(partial(self._on_change, name, row))
                self._rows += row

    def _on_change(self, name: str, row: tuple[Any, Any, Any], _: Any) -> None:
        is_seen, colour, opacity = (control.value for control in row)
        self._view.style(name, is_seen, colour, opacity / 100.0)
