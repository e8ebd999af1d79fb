"""The organ: which file, how it is looked at, and its material."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from avatar_core.common.supports import SUPPORT
from avatar_ros.ui.actions import Actions
from avatar_ros.ui.coloured import DISPLACEMENT, FIELDS
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.orientation import NAMES
from avatar_ros.ui.presets import HINTS, PRESETS, SLIDERS, source_of
from avatar_ros.ui.tabs.choices import NOTHING, set_options
from avatar_ros.ui.view import CUT, GLASS, WHOLE

_AS_BUILT = "as built"
_NO_PRESET = "as the sliders say"
_ABOUT = "margin:0 1em;font-size:14px;line-height:1.5"


class OrganTab:
    """Choice of the vademecum, of the look, and sliders of the material."""

    def __init__(self, gui: Any, actions: Actions) -> None:
        self._gui, self._actions = gui, actions
        self._files = gui.add_dropdown("Vademecum", (NOTHING,))
        gui.add_button("Load vademecum").on_click(lambda _: actions.vademecum(self._files.value))
        self._about = gui.add_html("")
        self._look = gui.add_dropdown("Show organ", (WHOLE, GLASS, CUT))
        self._side = gui.add_dropdown("Cut from", tuple(NAMES.values()), visible=False)
        self._depth = gui.add_slider(
            "Cut away [%]", min=0, max=100, step=1, initial_value=50, visible=False
        )
        for control in (self._look, self._side, self._depth):
            control.on_update(self._on_look)
        reach = gui.add_checkbox("Mark where tools reach", False)
        reach.on_update(lambda _: actions.mark_reach(reach.value))
        self._colour = gui.add_dropdown("Colours show", FIELDS)
        self._colour.on_update(self._on_colour)
        self._material = gui.add_folder("Material")
        self._sliders: dict[str, Any] = {}
        self._organ: Organ | None = None
        with self._material:
            self._preset = gui.add_dropdown("Tissue", (_NO_PRESET, _AS_BUILT, *PRESETS))
            self._preset.on_update(self._on_preset)
            self._source = gui.add_markdown("")

    def offer(self, files: list[str]) -> None:
        """Offer the files of the library."""
        set_options(self._files, files)

    def choose_file(self, file: str) -> None:
        """Show a file as the chosen one, if it is offered."""
        if file in self._files.options:
            self._files.value = file

    def show_organ(self, organ: Organ) -> None:
        """Show name and certificate, and a slider for each coordinate of the vademecum."""
        self._organ = organ
        self._about.content = f'<div style="{_ABOUT}">{organ.summary()}</div>'
        self._look.value = GLASS if organ.structures else WHOLE
        self._colour.value = DISPLACEMENT
        self._no_preset()
        for slider in self._sliders.values():
            slider.remove()
        self._sliders = {}
        with self._material:
            for name, (low, high, here) in organ.ranges.items():
                label, unit = SLIDERS[name]
                bounds = {"min": round(low / unit, 6), "max": round(high / unit, 6)}
                if name == "young" or name.startswith(SUPPORT):  # over orders of magnitude
                    add, step = self._gui.add_number, 0.1
                else:
                    add, step = self._gui.add_slider, round((high - low) / unit / 200, 6)
                slider = add(
                    label,
                    **bounds,
                    step=step,
                    initial_value=round(here / unit, 6),
                    hint=HINTS[name],
                )
                slider.on_update(partial(self._on_slider, name, unit, (low, high)))
                self._sliders[name] = slider

    def show_look(self, how: str, side: str, part: float) -> None:
        """Set the controls to how the organ is shown; as of ``Actions.look``."""
        self._look.value, self._side.value = how, NAMES[side]
        self._depth.value = round(100.0 * part)
        self._side.visible = self._depth.visible = how == CUT

    def show_colours(self, field: str) -> None:
        """Set the control to the field that is drawn, of ``FIELDS``."""
        self._colour.value = field

    def show_material(self, values: dict[str, float]) -> None:
        """Set the sliders to the values in force, by coordinate [SI]."""
        preset, young = PRESETS.get(self._preset.value), values.get("young")
        if young is not None and preset is not None and preset.young_modulus != young:
            self._no_preset()
        for name, value in values.items():
            if name in self._sliders:
                slider = self._sliders[name]
                shown = float(np.clip(value / SLIDERS[name][1], slider.min, slider.max))
                slider.value = round(shown, 6)

    def _on_slider(self, name: str, unit: float, bounds: tuple[float, float], event: Any) -> None:
        if event.client is None:  # not moved by a user, but by show_material
            return
        self._no_preset()
        self._actions.material({name: float(np.clip(event.target.value * unit, *bounds))})

    def _no_preset(self) -> None:
        """The material is that of no source."""
        self._preset.value, self._source.content = _NO_PRESET, ""

    def _on_preset(self, event: Any) -> None:
        if event.client is None or self._organ is None or event.target.value == _NO_PRESET:
            return
        ranges = self._organ.ranges
        if event.target.value == _AS_BUILT:
            self._source.content = "The material for which the vademecum was computed."
            self._actions.material({name: here for name, (_, _, here) in ranges.items()})
            return
        young = PRESETS[event.target.value].young_modulus
        self._source.content = source_of(event.target.value)
        self._actions.material({"young": young})

    def _on_colour(self, event: Any) -> None:
        if event.client is not None:
            self._actions.colours(event.target.value)

    def _on_look(self, event: Any) -> None:
        is_cut = self._look.value == CUT
        self._side.visible = self._depth.visible = is_cut
        if event.client is not None:
            side = next(k for k, name in NAMES.items() if name == self._side.value)
            self._actions.look(self._look.value, side, self._depth.value / 100.0)
