"""A new patient: from which surface, how exactly, and how far it is."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from avatar_ros.ui.actions import Actions, Wanted
from avatar_ros.ui.tabs.choices import NOTHING, set_options

UNITS = ("mm", "cm", "m")
STATED = "as the file states, else RAS"
AXES = (STATED, "RAS", "LPS", "LAS", "RPS")
FIDELITIES = ("interpolated", "reduced", "solved")


class PatientTab:
    """Controls of a build and its progress."""

    def __init__(self, gui: Any, actions: Actions) -> None:
        self._surfaces = gui.add_dropdown("Surface", (NOTHING,))
        self._unit = gui.add_dropdown("Unit of the file", UNITS)
        self._axes = gui.add_dropdown("Axes of the file", AXES)
        self._fidelity = gui.add_dropdown("Fidelity", FIDELITIES, initial_value="reduced")
        self._tolerance = gui.add_slider(
            "Tolerance [%]", min=0.5, max=20.0, step=0.5, initial_value=3.0
        )
        gui.add_button("Build patient").on_click(
            lambda _: actions.build(
                Wanted(
                    self._surfaces.value,
                    self._unit.value,
                    "" if self._axes.value == STATED else self._axes.value,
                    self._fidelity.value,
                    self._tolerance.value / 100.0,
                )
            )
        )
        self._stage = gui.add_markdown("")
        self._progress: Any = gui.add_progress_bar(0.0)
        gui.add_button("Cancel").on_click(lambda _: actions.cancel())
        self._began = {"": 0.0}

    def offer(self, surfaces: list[str]) -> None:
        """Offer the surfaces of the library."""
        set_options(self._surfaces, surfaces)

    def show_progress(self, stage: str, fraction: float, error: float) -> None:
        """Show how far a stage is, and how long it takes yet at this pace."""
        now = time.monotonic()
        if stage not in self._began:
            self._began = {stage: now}
        spent = now - self._began[stage]
        left = f", {spent / fraction - spent:.0f} s left" if 0.05 < fraction < 1.0 else ""
        known = "" if np.isnan(error) else f", expected error {error:.1%}"
        self._stage.content = f"{stage}: {fraction:.0%}{left}{known}"
        self._progress.value = float(np.clip(100.0 * fraction, 0.0, 100.0))
