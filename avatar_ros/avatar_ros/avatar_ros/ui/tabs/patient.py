"""A new patient: surface and labels, supports, accuracy, and progress of the build."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from avatar_core.common.supports import ATTACHMENTS
from avatar_ros.ui.patient.new_patient import NewPatient
from avatar_ros.ui.session.requests import Wanted
from avatar_ros.ui.tabs.choices import NOTHING, set_options
from avatar_ros.ui.view.legend import key_of_access, key_of_clamp, key_of_missed, key_of_springs

ORGAN, INSIDE = "organ", "inside it"
ROLES = (NOTHING, ORGAN, INSIDE)
_HINT = (
    "several labels can form the organ; structures inside are shown, and are as stiff as the organ"
)
UNITS = ("mm", "cm", "m")
STATED = "as the file states, else RAS"
AXES = (STATED, "RAS", "LPS", "LAS", "RPS")
FIDELITIES = ("interpolated", "reduced", "solved")
CLAMPED, SPRUNG = "clamp of the template", "springs where it is attached"
GUESS, FREE = "a guess", "free"
SPRINGS = (GUESS, FREE, *(f"1e{k}" for k in range(3, 11)), "clamped")  # [N/m^3]
BRUSH_RADIUS = (4.0, 40.0, 12.0)  # smallest, largest, first [mm]
_SECTION = "margin:0 1em;font-size:13px"


class PatientTab:
    """Controls of a build and its progress.

    load : loads a file of the library; brushes : regions that a click on a preview can paint
    """

    def __init__(
        self, gui: Any, new: NewPatient, load: Callable[[str], None], brushes: tuple[str, ...]
    ) -> None:
        self._gui, self._new, self._load = gui, new, load
        self._surfaces = gui.add_dropdown("Surface", (NOTHING,))
        self._labels = gui.add_folder("Labels of the file", visible=False)
        self._roles: dict[str, Any] = {}
        self._surfaces.on_update(lambda _: self._on_surface())
        self._unit = gui.add_dropdown("Unit of the file", UNITS)
        self._axes = gui.add_dropdown("Axes of the file", AXES)
        self._fidelity = gui.add_dropdown("Fidelity", FIDELITIES, initial_value="reduced")
        self._tolerance = gui.add_slider(
            "Tolerance [%]", min=0.5, max=20.0, step=0.5, initial_value=3.0
        )
        self._first = gui.add_checkbox(
            "Interpolate first",
            initial_value=False,
            hint="an interpolated organ in seconds, replaced by the better one when ready; "
            "only with the clamp of the template",
        )
        self._held = gui.add_dropdown("Held by", (CLAMPED, SPRUNG))
        self._stiffness = gui.add_folder("Stiffness per area [N/m\u00b3]", visible=False)
        with self._stiffness:
            self._springs = {name: gui.add_dropdown(name, SPRINGS) for name in ATTACHMENTS}
        self._held.on_update(lambda _: self._on_held())
        gui.add_button(
            "Preview what holds it", hint="registers and meshes the organ; nothing is solved"
        ).on_click(lambda _: self._ask(preview=True))
        self._preview = [
            gui.add_html(
                f'<div style="{_SECTION}">{key_of_clamp()}{key_of_access()} to tools '
                f"{key_of_missed()}</div>",
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
            control.on_update(lambda _: new.brush(brush.value, radius.value / 1e3))
        back.on_click(lambda _: new.end_preview())
        gui.add_button("Build patient").on_click(lambda _: self._ask())
        self._stage = gui.add_markdown("")
        self._progress: Any = gui.add_progress_bar(0.0, visible=False)
        self._cancel = gui.add_button("Cancel", visible=False)
        self._cancel.on_click(lambda _: new.cancel())
        self._built = ""
        self._use = gui.add_button("", visible=False, hint="replaces the organ in use")
        self._use.on_click(lambda _: self._on_use())
        self._is_first_used = False
        self._began = {"": 0.0}

    def _ask(self, preview: bool = False) -> None:
        if self._surfaces.value == NOTHING:
            self._stage.content = "choose a surface"
        elif self._roles and not self._named(ORGAN):
            self._stage.content = "choose which labels are the organ, one or several"
        else:
            self._new.build(self._wanted(preview))

    def _named(self, role: str) -> tuple[str, ...]:
        """Return the labels of a role."""
        return tuple(name for name, one in self._roles.items() if one.value == role)

    def _wanted(self, preview: bool = False) -> Wanted:
        has_labels = bool(self._roles)
        is_stated = has_labels or self._axes.value == STATED
        return Wanted(
            self._surfaces.value,
            "" if has_labels else self._unit.value,
            "" if is_stated else self._axes.value,
            self._fidelity.value,
            self._tolerance.value / 100.0,
            ",".join(self._named(ORGAN)),
            self._named(INSIDE),
            supports=self._supports() if self._held.value == SPRUNG else (),
            preview=preview,
            interpolated_first=self._first.value and self._held.value == CLAMPED and not preview,
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
        """Offer the surfaces of the library; none is chosen before a user does."""
        set_options(self._surfaces, [NOTHING, *surfaces])

    def _on_surface(self) -> None:
        self.offer_labels(())  # removes those of the last file
        self._new.choose_surface(self._surfaces.value)

    def offer_labels(self, labels: tuple[str, ...]) -> None:
        """Offer a role for each label of the chosen file, none for a file that is no label map."""
        for role in self._roles.values():
            role.remove()
        only = ORGAN if len(labels) == 1 else NOTHING
        with self._labels:
            self._roles = {
                name: self._gui.add_dropdown(name, ROLES, initial_value=only, hint=_HINT)
                for name in labels
            }
        self._labels.visible = bool(labels)
        self._unit.visible = self._axes.visible = not labels  # a label map states them

    def show_preview(self, is_shown: bool, springs: Mapping[str, float] | None = None) -> None:
        """Show or hide the controls of a preview.

        springs : area of each [m^2]; they can be painted too
        """
        springs = springs or {}
        for control in self._preview:
            control.visible = is_shown
        sizes = ", ".join(f"{name} {1e4 * area:.0f} cm\u00b2" for name, area in springs.items())
        self._areas.content = f'<div style="{_SECTION}">{key_of_springs()}: {sizes}</div>'
        self._areas.visible = is_shown and bool(springs)
        set_options(self._brush, [*self._brushes, *springs])

    def _on_use(self) -> None:
        self._use.visible = False
        self._is_first_used = self._progress.visible  # the better organ is still being built
        self._load(self._built)

    def begin(self) -> None:
        """Show that a build or a preview begins; it can be cancelled."""
        self._is_first_used = False
        self._use.visible = False
        self._progress.visible = self._cancel.visible = True
        self.show_progress("begins", 0.0, float("nan"))

    def offer_first(self, file: str) -> None:
        """Offer the interpolated organ while a better one is being built."""
        self._built, self._use.label, self._use.visible = file, f"Use {file} so far", True

    def end(self, how: str, file: str = "") -> None:
        """Show that a build or a preview has ended, and offer the file that was built.

        If the interpolated organ is in use, the better one takes its place.
        """
        self._progress.visible = self._cancel.visible = False
        self._stage.content = how
        self._built, self._use.label = file, f"Use {file}"
        self._use.visible = bool(file) and not self._is_first_used
        if file and self._is_first_used:
            self._load(file)

    def show_progress(self, stage: str, fraction: float, error: float) -> None:
        """Show the progress of a stage, and its remaining time at this pace."""
        now = time.monotonic()
        if stage not in self._began:
            self._began = {stage: now}
        spent = now - self._began[stage]
        left = f", {spent / fraction - spent:.0f} s left" if 0.05 < fraction < 1.0 else ""
        known = "" if np.isnan(error) else f", expected error {error:.1%}"
        part = f": {fraction:.0%}" if fraction > 0.0 else ""  # some stages have none
        self._stage.content = f"{stage}{part}{left}{known}"
        self._progress.animated = fraction <= 0.0
        self._progress.value = float(np.clip(100.0 * fraction, 0.0, 100.0)) or 100.0
