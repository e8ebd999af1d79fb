"""The tool: force on it, its motion, and recording."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from viser import uplot

from avatar_ros.ui.session.recordings import Recordings
from avatar_ros.ui.session.shown_period import ShownPeriod
from avatar_ros.ui.session.texts import BAND
from avatar_ros.ui.tabs.choices import NOTHING, set_options
from avatar_ros.ui.tools.tools import Tools
from avatar_ros.ui.view.orientation import AXES

STEP = 1e-3  # way of a key [m]
_HISTORY = 10.0  # length of the plot [s]
_LEAST_RANGE = 1.0  # smallest range of the plot [N]
_PADDING = (14, 22, 0, 0)  # so that no number on an axis is cut [px]
# keys, their function, and the side of the patient to which they move the tool; "": the normal
KEYS = {
    "J": ("Tool to the patient's right", "R"),
    "L": ("Tool to the patient's left", "L"),
    "I": ("Tool up (superior)", "S"),
    "K": ("Tool down (inferior)", "I"),
    "U": ("Press the tool in", ""),
    "O": ("Lift the tool", ""),
}


def _plot_of_force(gui: Any, has_band: bool) -> Any:
    """Plot the force with its error, with or without the band from the material's distributions."""
    curves = [
        uplot.Series(label="force [N]", stroke="#0072B2", width=2),
        uplot.Series(label="at least [N]", stroke="#D55E0080", width=1),
        uplot.Series(label="at most [N]", stroke="#D55E0080", width=1),
    ]
    bands = [uplot.Band(series=(3, 2), fill="#D55E0030")]
    if has_band:
        curves += [
            uplot.Series(label=f"{BAND}, {end} [N]", stroke="#009E73", width=1, dash=(4.0, 4.0))
            for end in ("from", "to")
        ]
        bands.append(uplot.Band(series=(5, 4), fill="#009E7320"))
    values = {
        "min": {"pad": 0, "soft": 0, "mode": 1},
        "max": {"pad": 0.1, "soft": _LEAST_RANGE, "mode": 1},  # zero force is a line at the bottom
    }
    return gui.add_uplot(
        tuple(np.zeros(2) for _ in range(1 + len(curves))),
        (uplot.Series(label="time [s]"), *curves),
        title="Force on the tool [N] over time [s]",
        scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=values)},
        axes=(uplot.Axis(), uplot.Axis()),
        legend=uplot.Legend(live=False),
        bands=tuple(bands),
        height=120,
        padding=_PADDING,
    )


class ToolTab:
    """Choice of a tool, plot of the force on it, buttons that move it, and the recording."""

    def __init__(self, gui: Any, tools: Tools, recordings: Recordings) -> None:
        self._moved, self._began = tools, time.monotonic()
        self._tools = gui.add_dropdown("Tool", (NOTHING,), visible=False)
        self._tools.on_update(self._on_tool)
        self._chosen = ""
        n = round(_HISTORY * 5)
        self._times: deque[float] = deque(maxlen=n)
        self._forces: deque[tuple[float, float, float]] = deque(maxlen=n)
        # the force, where there is no band
        self._bands: deque[tuple[float, float]] = deque(maxlen=n)
        self._plot, self._plot_of_band = _plot_of_force(gui, False), _plot_of_force(gui, True)
        self._plot_of_band.visible = False
        for name, labels in (("Depth", ("press 1 mm", "lift 1 mm")), ("1 mm to", tuple(AXES))):
            group = gui.add_button_group(name, labels)
            group.on_click(lambda event: self._nudge(event.target.value))
        gui.add_button("Lift off the organ").on_click(lambda _: tools.lift())
        jaw = gui.add_button(
            "Close or open the jaw", hint="for a tool to which the scene gives a jaw"
        )
        jaw.on_click(lambda _: tools.work_jaw())
        self._recording = gui.add_button("Record", hint="poses, forces and shapes, from rest")
        self._recording.on_click(lambda _: recordings.record(self._recording.label == "Record"))
        gui.add_markdown(
            "Click on the organ to put the tip there. Drag the tip, with Shift along its shaft; "
            "or use the keys J L I K, U to press, O to lift, G to close or open its jaw."
        )
        gui.add_command("Close or open the jaw", hotkey="G").on_trigger(lambda _: tools.work_jaw())
        for key, (label, side) in KEYS.items():
            way = -STEP if key == "U" else STEP
            command = gui.add_command(f"{label}, 1 mm", hotkey=key)
            command.on_trigger(partial(self._on_key, side, way))

    def show_tools(self, names: Sequence[str], chosen: str) -> None:
        """Offer the tools, if there are several, and show which one is chosen."""
        set_options(self._tools, list(names))
        if chosen != self._chosen:  # the list may show a newer choice, still on its way
            self._chosen = self._tools.value = chosen
            self.forget_force()  # the curve is another tool's
        if self._tools.visible != (len(names) > 1):
            self._tools.visible = len(names) > 1

    def _on_tool(self, event: Any) -> None:
        if event.client is not None:
            self._moved.choose(self._tools.value)

    def _nudge(self, label: str) -> None:
        way = -STEP if label.startswith("press") else STEP
        self._move(label if label in AXES else "", way)

    def _on_key(self, side: str, way: float, _: Any) -> None:
        self._move(side, way)

    def _move(self, side: str, way: float) -> None:
        self._moved.nudge(AXES[side] if side else None, way)

    def show_period(self, shown: ShownPeriod | None) -> None:
        """Add the force of a period to the plot; a gap if it is unknown or not the present one."""
        if shown is None or shown.missing:
            self.forget_force()
        else:
            now = time.monotonic() - self._began
            self.show_force(now, shown.size, np.nan_to_num(shown.error), shown.band)

    def show_force(
        self, now: float, force: float, error: float, band: tuple[float, float] | None = None
    ) -> None:
        """Add a point to the plot [s, N]; five per second are enough.

        band : low and high edge of the force's band [N]; shown while any point of the plot has one
        """
        self._times.append(now)
        self._forces.append((force, max(force - error, 0.0), force + error))
        self._bands.append(band or (force, force))
        has_band = any(low < high for low, high in self._bands)
        values = np.array(self._forces)
        shown, hidden = self._plot, self._plot_of_band
        if has_band:
            shown, hidden = hidden, shown
            values = np.hstack([values, np.array(self._bands)])
        shown.data = (np.array(self._times), *(row.copy() for row in values.T))
        if not shown.visible:
            shown.visible, hidden.visible = True, False

    def forget_force(self) -> None:
        """Begin another curve at the next known force, not joined to the last."""
        for history in (self._times, self._forces, self._bands):
            history.clear()

    def show_recording(self, is_on: bool) -> None:
        """Label the button with its next function."""
        self._recording.label = "Stop and save" if is_on else "Record"
