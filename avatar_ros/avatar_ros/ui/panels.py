"""The panel of the planning page: choices, forces, and warnings in plain words."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import viser
from viser import uplot

from avatar_ros.ui.organ import Organ
from avatar_ros.ui.view import N_BANDS, band_shades

PANEL_WIDTH = 330  # [px]; leaves 470 of 800 for the organ
STEP = 1e-3  # of a key [m]
HISTORY = 10.0  # of the plot [s]
NOTHING = "-"
_PADDING = (14, 22, 0, 0)  # so that no number on an axis is cut [px]
FIDELITIES = ("interpolated", "reduced", "solved")

# Label and unit of each coordinate of the material, and what one shown unit is in SI.
SLIDERS = {
    "young": ("Young's modulus E [kPa]", 1e3),
    "poisson": ("Poisson's ratio nu [-]", 1.0),
    "contrast": ("Tumour, E inside / outside [-]", 1.0),
}
# Keys and the axis along which they move the tool; None: the surface normal.
KEYS = {
    "J": ("Tool to the patient's right", (-1.0, 0.0, 0.0)),
    "L": ("Tool to the patient's left", (1.0, 0.0, 0.0)),
    "I": ("Tool up (superior)", (0.0, 0.0, 1.0)),
    "K": ("Tool down (inferior)", (0.0, 0.0, -1.0)),
    "U": ("Press the tool in", None),
    "O": ("Lift the tool", None),
}


@dataclass(frozen=True)
class Actions:
    """Callbacks of the controls; called in threads of the page's server."""

    vademecum: Callable[[str], None]
    material: Callable[[str, float], None]
    scene: Callable[[str], None]
    build: Callable[[str, str, float], None]
    cancel: Callable[[], None]
    nudge: Callable[[Any, float], None]  # along an axis, None for the normal, by a distance [m]
    lift: Callable[[], None]
    record: Callable[[bool], None]


class Panels:
    """Controls and readouts of the page."""

    def __init__(self, server: viser.ViserServer, actions: Actions) -> None:
        self._server, self._gui, self._actions = server, server.gui, actions
        self._times: deque[float] = deque(maxlen=round(HISTORY * 5))
        self._forces: deque[tuple[float, float]] = deque(maxlen=round(HISTORY * 5))
        self._loop: deque[tuple[float, float, float]] = deque(maxlen=60)
        self._gui.configure_theme(show_logo=False, show_share_button=False)
        self._gui.set_panel_label("avatar planning page")
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(PANEL_WIDTH)
        self.warnings = self._gui.add_markdown("starting ...")
        self.readout = self._gui.add_markdown("")
        self._bar = self._gui.add_html(colour_bar(1e-3))
        self.news = self._gui.add_markdown("")
        tabs = self._gui.add_tab_group()
        for label, fill in (
            ("Tool", self._fill_tool),
            ("Organ", self._fill_organ),
            ("Patient", self._fill_patient),
            ("Scene", self._fill_scene),
            ("Timing", self._fill_timing),
        ):
            with tabs.add_tab(label):
                fill()
        self._add_keys()

    def _fill_tool(self) -> None:
        self._force_plot = self._plot(
            "Force on the tool [N]",
            120,
            uplot.Series(label="force [N]", stroke="#0072B2", width=2),
            uplot.Series(label="error, 9 of 10 [N]", stroke="#D55E00", width=2, dash=(6, 4)),
        )
        for labels in (("press 1 mm", "lift 1 mm"), ("right", "left", "up", "down")):
            group = self._gui.add_button_group("Tool" if len(labels) == 2 else "1 mm", labels)
            group.on_click(lambda event: self._nudge(event.target.value))
        self._gui.add_button("Lift off the organ").on_click(lambda _: self._actions.lift())
        self._recording = self._gui.add_button("Record")
        self._recording.on_click(lambda _: self._actions.record(self._recording.label == "Record"))
        self._gui.add_markdown(
            "Drag the blue tool, or use the keys J L I K, U to press, O to lift."
        )

    def _nudge(self, label: str) -> None:
        axis = {
            "right": (-1.0, 0.0, 0.0),
            "left": (1.0, 0.0, 0.0),
            "up": (0.0, 0.0, 1.0),
            "down": (0.0, 0.0, -1.0),
        }.get(label)
        self._actions.nudge(axis, -STEP if label.startswith("press") else STEP)

    def _add_keys(self) -> None:
        for key, (label, axis) in KEYS.items():
            way = -STEP if key == "U" else STEP
            command = self._gui.add_command(f"{label}, 1 mm", hotkey=key)  # type: ignore[arg-type]
            command.on_trigger(partial(self._on_key, axis, way))

    def _on_key(self, axis: Any, way: float, _: Any) -> None:
        self._actions.nudge(axis, way)

    def _on_slider(self, name: str, unit: float, bounds: tuple[float, float], event: Any) -> None:
        if event.client is None:  # not moved by a user, but by show_material
            return
        self._actions.material(name, float(np.clip(event.target.value * unit, *bounds)))

    def _fill_organ(self) -> None:
        self._files = self._gui.add_dropdown("Vademecum", (NOTHING,))
        self._gui.add_button("Load vademecum").on_click(
            lambda _: self._actions.vademecum(self._files.value)
        )
        self._about = self._gui.add_markdown("")
        self._sliders: dict[str, Any] = {}
        self._material = self._gui.add_folder("Material")

    def _fill_patient(self) -> None:
        self._surfaces = self._gui.add_dropdown("Surface", (NOTHING,))
        self._fidelity = self._gui.add_dropdown("Fidelity", FIDELITIES, initial_value="reduced")
        self._tolerance = self._gui.add_slider(
            "Tolerance [%]", min=0.5, max=20.0, step=0.5, initial_value=3.0
        )
        self._gui.add_button("Build patient").on_click(
            lambda _: self._actions.build(
                self._surfaces.value, self._fidelity.value, self._tolerance.value / 100.0
            )
        )
        self.stage = self._gui.add_markdown("")
        self._progress: Any = self._gui.add_progress_bar(0.0)
        self._gui.add_button("Cancel").on_click(lambda _: self._actions.cancel())

    def _fill_scene(self) -> None:
        self._scenes = self._gui.add_dropdown("Scene", (NOTHING,))
        self._scene_text = self._gui.add_markdown("")
        self._scenes.on_update(lambda _: self._describe_scene())
        self._gui.add_button("Switch to scene").on_click(
            lambda _: self._actions.scene(self._scenes.value)
        )
        self._scene_texts: dict[str, str] = {}

    def _fill_timing(self) -> None:
        self._step_plot = self._plot(
            "Time of a step [ms]",
            110,
            uplot.Series(label="step, 99 of 100 [ms]", stroke="#0072B2", width=2),
        )
        self._missed_plot = self._plot(
            "Missed periods [1/s]",
            110,
            uplot.Series(label="missed periods [1/s]", stroke="#D55E00", width=2),
        )

    def _plot(self, what: str, height: int, *curves: Any) -> Any:
        """An empty plot of some curves over time; height [px]."""
        return self._gui.add_uplot(
            tuple(np.zeros(2) for _ in range(1 + len(curves))),
            (uplot.Series(label="time [s]"), *curves),
            title=f"{what} over time [s]",
            scales={"x": uplot.Scale(time=False)},
            axes=(uplot.Axis(), uplot.Axis()),
            height=height,
            padding=_PADDING,
        )

    # --- What the node shows -----------------------------------------------------------------

    def offer(self, files: list[str], surfaces: list[str]) -> None:
        """Offer the files of the library."""
        _set_options(self._files, files)
        _set_options(self._surfaces, surfaces)

    def choose_file(self, file: str) -> None:
        """Show a file as the chosen one, if it is offered."""
        files: Any = self._files
        if file in files.options:
            files.value = file

    def offer_scenes(self, texts: dict[str, str]) -> None:
        """Offer scenes by name, with their descriptions."""
        self._scene_texts = texts
        _set_options(self._scenes, list(texts))
        self._describe_scene()

    def _describe_scene(self) -> None:
        self._scene_text.content = self._scene_texts.get(self._scenes.value, "")

    def show_organ(self, organ: Organ) -> None:
        """Show name and certificate, and a slider for each coordinate of the vademecum."""
        self._about.content = organ.summary()
        for slider in self._sliders.values():
            slider.remove()
        self._sliders = {}
        with self._material:
            for name, (low, high, here) in organ.ranges.items():
                label, unit = SLIDERS[name]
                slider = self._gui.add_slider(
                    label,
                    min=round(low / unit, 6),
                    max=round(high / unit, 6),
                    step=round((high - low) / unit / 200, 6),
                    initial_value=round(here / unit, 6),
                )
                slider.on_update(partial(self._on_slider, name, unit, (low, high)))
                self._sliders[name] = slider

    def show_material(self, values: dict[str, float]) -> None:
        """Set the sliders to the values in force, by coordinate [SI]."""
        for name, value in values.items():
            if name in self._sliders:
                slider = self._sliders[name]
                shown = float(np.clip(value / SLIDERS[name][1], slider.min, slider.max))
                slider.value = round(shown, 6)

    def show_scale(self, top: float) -> None:
        """Show the colour bar up to a displacement [m]."""
        content = colour_bar(top)
        if self._bar.content != content:
            self._bar.content = content

    def show_force(self, now: float, force: float, error: float) -> None:
        """Add a point to the plot of the force [s, N]; five per second are enough."""
        self._times.append(now)
        self._forces.append((force, error))
        values = np.array(self._forces)
        self._force_plot.data = (np.array(self._times), values[:, 0].copy(), values[:, 1].copy())

    def show_loop(self, now: float, step: float, missed: float) -> None:
        """Plot the 99th percentile of step times [s] and the missed periods of the last second."""
        self._loop.append((now, 1e3 * step, missed))
        values = np.array(self._loop)
        self._step_plot.data = (values[:, 0].copy(), values[:, 1].copy())
        self._missed_plot.data = (values[:, 0].copy(), values[:, 2].copy())

    def show_progress(self, stage: str, fraction: float, error: float) -> None:
        """Show how far the build of a patient is."""
        known = "" if np.isnan(error) else f", error {error:.1%}"
        self.stage.content = f"{stage}: {fraction:.0%}{known}"
        self._progress.value = float(np.clip(100.0 * fraction, 0.0, 100.0))

    def show_recording(self, is_on: bool) -> None:
        """Label the button with what it does next."""
        self._recording.label = "Stop and save" if is_on else "Record"


def colour_bar(top: float) -> str:
    """The colour bar with its displacements, as HTML."""
    shades = [f"rgb({r},{g},{b})" for r, g, b in band_shades().tolist()]
    stops = ", ".join(
        f"{shade} {100 * i / N_BANDS:g}% {100 * (i + 1) / N_BANDS:g}%"
        for i, shade in enumerate(shades)
    )
    ticks = "".join(f"<span>{1e3 * top * i / 5:g}</span>" for i in range(6))
    return (
        '<div id="colour-bar" style="margin:0 1em;font-size:12px">displacement [mm]'
        f'<div style="height:12px;background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{ticks}</div></div>'
    )


def _set_options(dropdown: Any, options: list[str]) -> None:
    wanted = tuple(options) or (NOTHING,)
    if tuple(dropdown.options) != wanted:
        before = dropdown.value
        dropdown.options = wanted
        dropdown.value = before if before in wanted else wanted[0]
