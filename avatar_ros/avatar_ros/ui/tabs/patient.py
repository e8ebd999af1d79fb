"""A new patient: from which surface and label, how it is held, how exactly, and how far it is."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from avatar_core.common.supports import ATTACHMENTS
from avatar_ros.ui.actions import Actions, Wanted
from avatar_ros.ui.legend import key_of_access, key_of_clamp, key_of_springs
from avatar_ros.ui.tabs.choices import NOTHING, set_options

UNITS = ("mm", "cm", "m")
STATED = "as the file states, else RAS"
AXES = (STATED, "RAS", "LPS", "LAS", "RPS")
FIDELITIES = ("interpolated", "reduced", "solved")
CLAMPED, SPRUNG = "clamp of the template", "springs where it is attached"
GUESS, FREE = "a guess", "free"
SPRINGS = (GUESS, FREE, *(f"1e{k}" for k in range(3, 11)), "clamped")  # [N/m^3]
BRUSH_RADIUS = (4.0, 40.0, 12.0)  # least, most, first [mm]
_SECTION = "margin:0 1em;font-size:13px"


class PatientTab:
    """Controls of a build and its progress.

    brushes : what a click on a preview can paint
    """

    def __init__(self, gui: Any, actions: Actions, brushes: tuple[str, ...]) -> None:
        self._gui, self._actions = gui, actions
        self._surfaces = gui.add_dropdown("Surface", (NOTHING,))
        self._label = gui.add_dropdown("Organ's label", (NOTHING,), visible=False)
        self._inside = gui.add_folder("Inside the organ", visible=False)
        self._boxes: dict[str, Any] = {}
        self._surfaces.on_update(lambda _: self._on_surface())
        self._label.on_update(lambda _: self._offer_inside())
        self._unit = gui.add_dropdown("Unit of the file", UNITS)
        self._axes = gui.add_dropdown("Axes of the file", AXES)
        self._fidelity = gui.add_dropdown("Fidelity", FIDELITIES, initial_value="reduced")
        self._tolerance = gui.add_slider(
            "Tolerance [%]", min=0.5, max=20.0, step=0.5, initial_value=3.0
        )
        self._held = gui.add_dropdown("Held by", (CLAMPED, SPRUNG))
        self._stiffness = gui.add_folder("Stiffness per area [N/m\u00b3]", visible=False)
        with self._stiffness:
            self._springs = {name: gui.add_dropdown(name, SPRINGS) for name in ATTACHMENTS}
        self._held.on_update(lambda _: self._on_held())
        gui.add_button(
            "Preview what holds it", hint="registers and meshes the organ; nothing is solved"
        ).on_click(lambda _: actions.build(self._wanted(preview=True)))
        self._preview = [
            gui.add_html(
                f'<div style="{_SECTION}">{key_of_clamp()}{key_of_access()} to tools</div>',
                visible=False,
            ),
            areas := gui.add_html("", visible=False),
            brush := gui.add_dropdown("A click paints", brushes, visible=False),
            radius := gui.add_slider(
                "Brush [mm]",
                min=BRUSH_RADIUS[0],
                max=BRUSH_RADIUS[1],
                step=1.0,
                initial_value=BRUSH_RADIUS[2],
                visible=False,
            ),
            back := gui.add_button("Back to the organ in use", visible=False),
        ]
        self._brush, self._brushes, self._areas = brush, brushes, areas
        for control in (brush, radius):
            control.on_update(lambda _: actions.brush(brush.value, radius.value / 1e3))
        back.on_click(lambda _: actions.end_preview())
        gui.add_button("Build patient").on_click(lambda _: actions.build(self._wanted()))
        self._stage = gui.add_markdown("")
        self._progress: Any = gui.add_progress_bar(0.0)
        gui.add_button("Cancel").on_click(lambda _: actions.cancel())
        self._began = {"": 0.0}

    def _wanted(self, preview: bool = False) -> Wanted:
        has_labels = bool(self._label.visible)
        return Wanted(
            self._surfaces.value,
            self._unit.value,
            "" if self._axes.value == STATED else self._axes.value,
            self._fidelity.value,
            self._tolerance.value / 100.0,
            self._label.value if has_labels else "",
            tuple(name for name, box in self._boxes.items() if box.value) if has_labels else (),
            supports=self._supports() if self._held.value == SPRUNG else (),
            preview=preview,
        )

    def _supports(self) -> tuple[str, ...]:
        chosen = {name: spring.value for name, spring in self._springs.items()}
        return tuple(
            name if value == GUESS else f"{name}={value}"
            for name, value in chosen.items()
            if value != FREE
        )

    def _on_held(self) -> None:
        self._stiffness.visible = self._held.value == SPRUNG

    def offer(self, surfaces: list[str]) -> None:
        """Offer the surfaces of the library."""
        set_options(self._surfaces, surfaces)

    def _on_surface(self) -> None:
        self.offer_labels(())  # none of the last file
        self._actions.choose_surface(self._surfaces.value)

    def offer_labels(self, labels: tuple[str, ...]) -> None:
        """Offer the labels of the chosen file; none for a file that is no label map."""
        set_options(self._label, list(labels))
        self._label.visible = bool(labels)
        self._offer_inside()

    def _offer_inside(self) -> None:
        """A box for each label but the organ's own."""
        for box in self._boxes.values():
            box.remove()
        others = [name for name in self._label.options if name not in (NOTHING, self._label.value)]
        self._inside.visible = bool(others)
        with self._inside:
            self._boxes = {name: self._gui.add_checkbox(name, False) for name in others}

    def show_preview(self, is_shown: bool, springs: Mapping[str, float] | None = None) -> None:
        """Show the controls of a preview, or hide them.

        springs : area of each [m^2]; they can be painted too
        """
        springs = springs or {}
        for control in self._preview:
            control.visible = is_shown
        sizes = ", ".join(f"{name} {1e4 * area:.0f} cm\u00b2" for name, area in springs.items())
        self._areas.content = f'<div style="{_SECTION}">{key_of_springs()}: {sizes}</div>'
        self._areas.visible = is_shown and bool(springs)
        set_options(self._brush, [*self._brushes, *springs])

    def show_progress(self, stage: str, fraction: float, error: float) -> None:
        """Show how far a stage is, and how long it takes yet at this pace."""
        now = time.monotonic()
        if stage not in self._began:
            self._began = {stage: now}
        spent = now - self._began[stage]
        left = f", {spent / fraction - spent:.0f} s left" if 0.05 < fraction < 1.0 else ""
        known = "" if np.isnan(error) else f", expected error {error:.1%}"
        part = f": {fraction:.0%}" if fraction > 0.0 else ""  # of some stages, none is known
        self._stage.content = f"{stage}{part}{left}{known}"
        self._progress.value = float(np.clip(100.0 * fraction, 0.0, 100.0))
