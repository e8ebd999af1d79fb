"""The organ: its file, its look, and its material."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

import numpy as np

from avatar_core.common.supports import SUPPORT
from avatar_ros.ui.scan.upload import take
from avatar_ros.ui.session.chosen import Chosen
from avatar_ros.ui.session.coloured import DISPLACEMENT, Coloured
from avatar_ros.ui.session.presets import HINTS, PRESETS, SLIDERS, source_of
from avatar_ros.ui.tabs.choices import NOTHING, set_options
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.orientation import NAMES
from avatar_ros.ui.view.view import CUT, GLASS, LOOKS, WHOLE

_AS_BUILT = "as built"
_SENT = "vademecum, surface, label map, image or recording"
_NO_PRESET = "own values"
_ABOUT = "margin:0 1em;font-size:14px;line-height:1.5"


class OrganTab:
    """Choice of the vademecum, of the look, and sliders of the material.

    load : loads a file of the library; mark_reach : draws or hides the pattern where tools reach
    store : takes name and content of a file that a browser sends
    """

    def __init__(
        self,
        gui: Any,
        chosen: Chosen,
        coloured: Coloured,
        load: Callable[[str], None],
        mark_reach: Callable[[bool], None],
        store: Callable[[str, bytes], None],
    ) -> None:
        self._gui, self._chosen, self._coloured = gui, chosen, coloured
        self._files = gui.add_dropdown("Vademecum", (NOTHING,))
        gui.add_button("Load vademecum").on_click(lambda _: load(self._files.value))
        self._damaged = gui.add_html("")
        sent = gui.add_upload_button("Send a file to the library", hint=_SENT)
        sent.on_upload(lambda _: store(*take(sent)))
        self._about = gui.add_html("")
        self._look = gui.add_dropdown("Show organ", LOOKS)
        self._side = gui.add_dropdown("Cut from", tuple(NAMES.values()), visible=False)
        self._depth = gui.add_slider(
            "Cut away [%]", min=0, max=100, step=1, initial_value=50, visible=False
        )
        for control in (self._look, self._side, self._depth):
            control.on_update(self._on_look)
        reach = gui.add_checkbox("Mark where tools reach", False)
        reach.on_update(lambda _: mark_reach(reach.value))
        self._colour = gui.add_dropdown("Colours show", (DISPLACEMENT,))
        self._colour.on_update(self._on_colour)
        self._material = gui.add_folder("Material")
        self._sliders: dict[str, Any] = {}
        self._organ: Organ | None = None
        with self._material:
            self._preset = gui.add_dropdown("Tissue", (_NO_PRESET, _AS_BUILT, *PRESETS))
            self._preset.on_update(self._on_preset)
            self._source = gui.add_markdown("")

    def offer(self, files: list[str], damaged: list[str]) -> None:
        """Offer the files of the library, with a line on each file that cannot be used."""
        set_options(self._files, files)
        set_options(self._colour, list(self._coloured.fields))
        lines = "".join(f'<div style="{_ABOUT}">⚠ {escape(line)}</div>' for line in damaged)
        if self._damaged.content != lines:
            self._damaged.content = lines

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
                if name == "young" or name.startswith(SUPPORT):  # ranges over orders of magnitude
                    # without bounds, at which a browser would choose another number by itself
                    add = partial(self._gui.add_number, step=0.1)
                else:
                    bounds = {"min": round(low / unit, 6), "max": round(high / unit, 6)}
                    step = round((high - low) / unit / 200, 6)
                    add = partial(self._gui.add_slider, **bounds, step=step)
                slider = add(label, initial_value=round(here / unit, 6), hint=HINTS[name])
                slider.on_update(partial(self._on_slider, name, unit, (low, high)))
                self._sliders[name] = slider

    def show_look(self, how: str, side: str, part: float) -> None:
        """Set the controls to how the organ is shown; as in ``Chosen.choose_look``."""
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
        for name, (low, high, _) in self._organ.ranges.items() if self._organ else ():
            if name in values and name in self._sliders:
                shown = float(np.clip(values[name], low, high)) / SLIDERS[name][1]
                self._sliders[name].value = round(shown, 6)

    def _on_slider(self, name: str, unit: float, bounds: tuple[float, float], event: Any) -> None:
        if event.client is None:  # moved by show_material, not by a user
            return
        self._no_preset()
        value = event.target.value * unit
        within = float(np.clip(value, *bounds))  # shown numbers are rounded
        self._chosen.choose_material({name: within if np.isclose(value, within) else value})

    def _no_preset(self) -> None:
        """Show that the material comes from no preset."""
        self._preset.value, self._source.content = _NO_PRESET, ""

    def _on_preset(self, event: Any) -> None:
        if event.client is None or self._organ is None or event.target.value == _NO_PRESET:
            return
        ranges = self._organ.ranges
        if event.target.value == _AS_BUILT:
            self._source.content = "The material for which the vademecum was computed."
            self._chosen.choose_material({name: here for name, (_, _, here) in ranges.items()})
            return
        young = PRESETS[event.target.value].young_modulus
        self._source.content = source_of(event.target.value)
        self._chosen.choose_material({"young": young})

    def _on_colour(self, event: Any) -> None:
        if event.client is not None:
            self._coloured.choose(event.target.value)

    def _on_look(self, event: Any) -> None:
        is_cut = self._look.value == CUT
        self._side.visible = self._depth.visible = is_cut
        if event.client is not None:
            side = next(k for k, name in NAMES.items() if name == self._side.value)
            self._chosen.choose_look(self._look.value, side, self._depth.value / 100.0)
