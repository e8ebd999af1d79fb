"""The panel of the planning page: warnings, numbers, legend and views, and below them the tabs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

import viser

from avatar_ros.ui.measure.measures import Measures
from avatar_ros.ui.patient.new_patient import NewPatient
from avatar_ros.ui.patient.preview_view import BRUSHES
from avatar_ros.ui.plan.plan import Plan
from avatar_ros.ui.scan.library import Found
from avatar_ros.ui.scan.scan_view import ScanView
from avatar_ros.ui.server.index_page import TITLE, WARNING
from avatar_ros.ui.session.chosen import Chosen
from avatar_ros.ui.session.coloured import Coloured
from avatar_ros.ui.session.player import Player
from avatar_ros.ui.session.recordings import Recordings
from avatar_ros.ui.tabs.inside import InsideTab
from avatar_ros.ui.tabs.measure import MeasureTab
from avatar_ros.ui.tabs.organ import OrganTab
from avatar_ros.ui.tabs.patient import PatientTab
from avatar_ros.ui.tabs.plan import PlanTab
from avatar_ros.ui.tabs.recordings import RecordingsTab
from avatar_ros.ui.tabs.scan import ScanTab
from avatar_ros.ui.tabs.scene import SceneTab
from avatar_ros.ui.tabs.tool import ToolTab
from avatar_ros.ui.view.legend import DISPLACEMENT, legend
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.orientation import NAMES
from avatar_ros.ui.view.view import OrganView

PANEL_WIDTH = 350  # [px]; leaves 450 of 800 for the organ
BESIDE = "tool"
VIEWS = {**{letter: letter for letter in NAMES}, BESIDE: BESIDE}  # view of each button
_CUBE = "position:fixed;left:14px;bottom:10px;z-index:5;pointer-events:none;line-height:0"
_BANNER = (
    "position:fixed;left:14px;top:10px;max-width:52vw;z-index:6;pointer-events:none;"
    "font-size:15px;font-weight:600"
)
_ALERT = f"padding:6px 12px;margin-bottom:6px;border-radius:4px;color:#fff;background:{WARNING}"


class Panels:
    """Controls and readouts of the page; each tab gets the parts of the page that it works on.

    load : loads a file of the library; mark_reach : draws or hides the pattern where tools reach
    store : takes name and content of a file that a browser sends
    """

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        chosen: Chosen,
        view: OrganView,
        coloured: Coloured,
        measures: Measures,
        plan: Plan,
        player: Player,
        recordings: Recordings,
        scan: ScanView,
        new_patient: NewPatient,
        load: Callable[[str], None],
        mark_reach: Callable[[bool], None],
        store: Callable[[str, bytes], None],
    ) -> None:
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label(TITLE)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        self._banner = gui.add_html("")
        self._state = gui.add_html("")
        self._cell, self._news = "starting ...", ""
        self._readout = gui.add_html("")
        self._bar = gui.add_html(legend(DISPLACEMENT, 1.0))
        views = gui.add_button_group("View from", tuple(VIEWS))
        views.on_click(lambda event: view.turn_to(VIEWS[event.target.value]))
        tabs = gui.add_tab_group()
        with tabs.add_tab("Tool"):
            self.tool = ToolTab(gui, chosen.tools, recordings)
            self.recordings = RecordingsTab(gui, recordings, player)
        with tabs.add_tab("Organ"):
            self.organ = OrganTab(gui, chosen, coloured, load, mark_reach, store)
            self.inside = InsideTab(gui, view)
            self.scan = ScanTab(gui, scan)
        with tabs.add_tab("Measure"):
            self.measure = MeasureTab(gui, measures)
        with tabs.add_tab("Plan"):
            self.plan = PlanTab(gui, plan, chosen)
        with tabs.add_tab("Patient"):
            self.patient = PatientTab(gui, new_patient, load, tuple(BRUSHES))
        with tabs.add_tab("Scene"):
            self.scene = SceneTab(gui, chosen)
        for number, side in enumerate(VIEWS.values(), 1):
            name = NAMES.get(side, "beside the tool")
            command = gui.add_command(f"View: {name}", hotkey=str(number))  # type: ignore[arg-type]
            command.on_trigger(partial(self._on_view, view, side))
        undo = gui.add_command("Undo the last change", hotkey="Z", modifier="cmd/ctrl")
        undo.on_trigger(lambda _: chosen.undo())
        self._cubes: dict[int, Any] = {}

    def _on_view(self, view: OrganView, side: str, _: Any) -> None:
        view.turn_to(side)

    def show_cube(self, client: Any, drawing: str) -> None:
        """Show in one browser the cube with the direction of view."""
        content = f'<div style="{_CUBE}">{drawing}</div>'
        if client.client_id not in self._cubes:
            self._cubes[client.client_id] = client.gui.add_html(content)
        else:
            self._cubes[client.client_id].content = content

    def forget_client(self, client: Any) -> None:
        """Forget a browser that has left."""
        self._cubes.pop(client.client_id, None)

    def offer(self, found: Found) -> None:
        """Offer the files of the library."""
        self.recordings.offer(found.recordings)
        self.organ.offer(found.vademecums, found.damaged)
        self.scan.offer(found.images)
        self.patient.offer(found.surfaces)

    def show_organ(self, organ: Organ) -> None:
        """Show name, certificate and material of another organ."""
        self.organ.show_organ(organ)
        self.inside.show(tuple(organ.structures))

    def show_cell(self, text: str) -> None:
        """Show the state of the cell, one line each."""
        self._cell = text
        self._show_state()

    def say(self, text: str) -> None:
        """Show the outcome of a request."""
        self._news = text
        self._show_state()

    def _show_state(self) -> None:
        lines = [f"<b>{escape(self._news)}</b>"] if self._news else []
        lines += [escape(line) for line in self._cell.splitlines() if line]
        content = "<br>".join(lines)
        _set(self._state, f'<div id="state" role="status" style="{_STATE}">{content}</div>')

    def show_numbers(self, content: str) -> None:
        """Show the numbers of a period, as HTML of a constant height, so that the controls stay."""
        _set(self._readout, f'<div id="numbers" style="{_NUMBERS}">{content}</div>')

    def show_alerts(self, alerts: list[str]) -> None:
        """Show alerts over the picture."""
        lines = "".join(f'<div style="{_ALERT}">⚠ {escape(text)}</div>' for text in alerts)
        _set(self._banner, f'<div id="alerts" role="alert" style="{_BANNER}">{lines}</div>')

    def show_scale(self, content: str) -> None:
        """Show another legend."""
        _set(self._bar, content)


_STATE = "height:4.4em;overflow:auto;margin:0 1em;font-size:13px;line-height:1.45"
_NUMBERS = "height:8.8em;overflow:hidden;margin:0 1em;font-size:14px;line-height:1.5"


def _set(handle: Any, content: str) -> None:
    """Send HTML only if it has changed."""
    if handle.content != content:
        handle.content = content
