"""The planning page: press an organ in the browser with the mouse, simulated at 1 kHz.

Needs the extra ``ui``, whose viser serves the page. :mod:`avatar_ros.ui.tools.tool_driver`, another
process, sends all tools' poses and reads the answers. Clouds are shown 30 times a second. Neither
the page nor its users can delay the contact loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

try:
    import viser
except ImportError as error:
    raise SystemExit("planning_ui: viser is missing; pip install '.[ui]'") from error

from avatar_core.common.processes import free_at_once
from avatar_core.errors import AvatarError
from avatar_core.vademecum.storage import parse_vademecum
from avatar_interfaces.msg import ContactState, LoopStatistics, VademecumFile, VademecumInfo
from avatar_ros.framework import qos
from avatar_ros.framework.announced import Announced
from avatar_ros.framework.managed_node import ManagedNode, run
from avatar_ros.framework.parameters import ParameterError, values
from avatar_ros.framework.reader import Reader
from avatar_ros.loop.settings import MATERIAL, TIP
from avatar_ros.ui.measure.measures import TOOL, Measures, Now
from avatar_ros.ui.measure.measures_view import MeasuresView
from avatar_ros.ui.panels import Panels
from avatar_ros.ui.patient.new_patient import NewPatient
from avatar_ros.ui.patient.preview_view import PreviewView
from avatar_ros.ui.plan.plan import Plan, PlanNow
from avatar_ros.ui.scan import upload
from avatar_ros.ui.scan.library import Library
from avatar_ros.ui.scan.scan_view import ScanView
from avatar_ros.ui.server.guard import Guard, guarded
from avatar_ros.ui.server.pacing import Pacing, paced
from avatar_ros.ui.session.alerts import alerts, alerts_of_switch
from avatar_ros.ui.session.chosen import Chosen, Page
from avatar_ros.ui.session.coloured import Coloured
from avatar_ros.ui.session.force_band import NewestBand
from avatar_ros.ui.session.live import Live
from avatar_ros.ui.session.player import Played, Player
from avatar_ros.ui.session.presets import material_text
from avatar_ros.ui.session.recorder import Recorder
from avatar_ros.ui.session.recordings import Page as RecordingsPage
from avatar_ros.ui.session.recordings import Recordings
from avatar_ros.ui.session.requests import Requests
from avatar_ros.ui.session.shown_period import ShownPeriod
from avatar_ros.ui.session.texts import frame_text, plain, warnings
from avatar_ros.ui.settings import PLANNING_UI
from avatar_ros.ui.tools.tool_state import SharedToolState, ToolDriverProcess, organ_number
from avatar_ros.ui.view.display import RATE
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.view import GLASS, WHOLE, OrganView

FRAME = "organ"
_PLOT_FRAMES = 6  # frames between two points of the plots, and between two sets of measures
_CUT_FRAMES = 3  # frames between two redraws of a cut that is dragged
_POLL_FRAMES = 30  # frames between two checks of library and nodes
_TIP = tuple(parameter.name for parameter in TIP)
_FOLLOWED = (*MATERIAL, "uncertainty")  # parameters of the contact node that are read once a second
_OF_CONTACT = (*_TIP, *_FOLLOWED, "rate", "tools", "frame_id", "scene", "cloud", "cloud_divisor")


class PlanningNode(ManagedNode):
    """Serves the page and connects it with the cell."""

    def __init__(self) -> None:
        self._server: viser.ViserServer | None = None
        self._state = SharedToolState.make()
        self._driver = ToolDriverProcess(self._state)
        self._recorder = Recorder(self._state)
        self._lines: list[str] = []  # shown numbers
        self._measured: list[str] = []
        self._alerts: list[str] = []
        self._reader = Reader(1 << 30)  # reads organs, for which the page waits
        self._files = Reader(1 << 30)  # reads files that users choose, in separate threads
        self._live = Live(self, self._state, self._recorder)
        self._band = NewestBand(self, self._state.force_of)
        self._was_missing, self._is_to_restore = True, False
        self._frame, self._frame_id = 0, FRAME
        self._missed = 0.0  # fraction of the periods
        self._announced: list[Announced] = []
        self._statistics: Any = None
        self._timer: Any = None
        super().__init__("planning_ui", PLANNING_UI)

    # --- Transitions -------------------------------------------------------------------------

    def configure(self) -> None:
        """Start the page with its parts, and subscribe the cell's topics."""
        value = values(self, PLANNING_UI)
        folder = Path(value["library_dir"]).expanduser()
        if not folder.is_dir():
            raise ParameterError(f"parameter library_dir: {folder} is not a directory")
        self._library = Library(folder.resolve(), self._reader)
        guard = Guard(value["host"], value["token"])
        pacing = Pacing()
        with guarded(guard, pacing.note), paced(pacing):
            self._server = server = viser.ViserServer(value["host"], value["port"], verbose=False)
        upload.bound(server)
        self._requests = Requests(self)
        self._chosen = chosen = Chosen(
            self._state,
            self._requests,
            Page(
                say=self._say,
                stop_recording=lambda why: self._recordings.stop(why),
                change_tips=lambda tips: self._view.change_tips(tips),
                show_material=lambda values: self._panels.organ.show_material(values),
                show_look=self._show_look,
            ),
            value["tool"],
        )
        self._view = OrganView(
            server,
            chosen.tools.drag,
            lambda *given: self._panels.show_cube(*given),
            chosen.drag_cut,
        )
        self._coloured = Coloured(
            self._view,
            chosen,
            self._say,
            lambda field: self._panels.organ.show_colours(field),
            self._in_executor,
        )
        self._measures = Measures(MeasuresView(server, self._drag_dot))
        server.scene.on_click()(self._click)
        self._plan = Plan(
            self._library.folder,
            self._plan_now,
            chosen.return_to,
            lambda labels: self._panels.plan.offer(labels),
            self._say,
        )
        self._player = Player(self._library.folder, self._files)
        self._recordings = Recordings(
            self._library.folder,
            self._recorder,
            self._player,
            self._requests,
            chosen,
            self._state,
            RecordingsPage(
                say=self._say,
                show_recording=lambda on: self._panels.tool.show_recording(on),
                answers=lambda: self._live.answers,
            ),
        )
        self._scan = ScanView(
            server,
            self._library.folder,
            self._files,
            lambda *given: self._panels.scan.show_scan(*given),
            self._say,
            self._view.turn_to,
        )
        self._new_patient = NewPatient(
            self._library.folder,
            self._files,
            self._requests,
            lambda: self._panels.patient,
            PreviewView(server, self._view.set_aside),
            self._choose_built,
            self._say,
        )
        self._panels = Panels(
            server,
            chosen=chosen,
            view=self._view,
            coloured=self._coloured,
            measures=self._measures,
            plan=self._plan,
            player=self._player,
            recordings=self._recordings,
            scan=self._scan,
            new_patient=self._new_patient,
            load=lambda name: self._requests.load_vademecum(name, self._say),
            mark_reach=lambda on: self._in_executor(lambda: self._view.mark_reach(on)),
            store=partial(upload.receive, self._library.folder, self._files, self._say),
        )
        server.on_client_disconnect(self._panels.forget_client)
        self._panels.scene.offer(len(chosen.tools.labels))
        self._announced = [
            Announced(self, VademecumInfo, "vademecum_info", self._take_frame),
            Announced(
                self, VademecumFile, "vademecum", self._take_organ, lambda _, why: self._say(why)
            ),
        ]
        self._statistics = self.create_subscription(
            LoopStatistics, "statistics", self._take_statistics, qos.STATISTICS
        )
        self.get_logger().info(f"planning page at {guard.address(server.get_port())}")

    def activate(self) -> None:
        """Start to update the page."""
        self._timer = self.create_timer(1.0 / RATE, self._show)

    def deactivate(self) -> None:
        """Stop updating the page, recording and moving tools."""
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        self._recorder.drop()
        self._driver.end()

    def clean_up(self) -> None:
        """Remove all topics and stop the page."""
        if self._statistics is not None:
            self.destroy_subscription(self._statistics)
        for announced in self._announced:
            announced.close()
        self._announced, self._statistics = [], None
        self._live.close()
        self._band.close()
        if self._server is not None:
            self._requests.close()
            self._reader.close()
            self._files.close()
            self._server.stop()
            self._server = None

    @property
    def _organ(self) -> Organ | None:
        """Return the organ that is shown."""
        return self._chosen.organ

    # --- From the cell -----------------------------------------------------------------------

    def _take_frame(self, info: VademecumInfo) -> None:
        if info.header.frame_id != self._frame_id:
            self._frame_id = info.header.frame_id
            self._driver.end()  # restarts with the new frame
            self._listen_to_clouds()

    def _listen_to_clouds(self) -> None:
        if self._organ is not None:
            self._live.listen(self._frame_id, len(self._organ.vertices))

    def _take_organ(self, message: VademecumFile) -> None:
        if self._organ is not None and self._organ.id == message.id:
            self._say(f"{self._organ.name} is shown")
            return
        try:
            data = bytes(message.data)
            name = "the announced vademecum"
            organ = Organ.of(self._reader.read(name, len(data), parse_vademecum, data, name))
        except AvatarError as error:
            self._say(str(error))
            return
        self._recordings.stop("the organ changed")
        self._chosen.forget(GLASS if organ.structures else WHOLE)
        self._chosen.tools.put_all(organ.starts(self._chosen.tips))
        self._player.close()
        self._new_patient.end_preview()
        self._scan.forget()
        self._view.show(organ, self._chosen.tips)
        self._measures.show_organ(organ, self._chosen.tip)
        self._live.forget()
        self._band.forget()
        self._coloured.forget()
        self._panels.show_organ(organ)
        self._chosen.organ, self._live.organ = organ, organ_number(organ.id)
        self._lines, self._measured, self._alerts = [], [], []
        self._listen_to_clouds()
        self._requests.parameters_of_contact(tuple(MATERIAL), self._chosen.note_contact)
        self._plan.show_organ(organ)
        self._say(f"{organ.name} is shown")

    def _take_statistics(self, window: LoopStatistics) -> None:
        self._missed = window.missed / max(window.periods, 1)

    def _show(self) -> None:
        """Update the page; called for every frame, whose messages are sent together."""
        if self._server is not None:
            with self._server.atomic():
                self._show_frame()

    def _show_frame(self) -> None:
        organ = self._organ
        self._frame += 1
        if self._frame % _POLL_FRAMES == 1:
            self._poll_cell()
        if organ is None or not self._live.is_listening:
            return
        self._follow_choice()
        if self._frame % _CUT_FRAMES == 0:
            self._chosen.settle()
            self._scan.follow(organ, self._view.points)
        if self._recorder.is_full:
            self._recordings.stop("a recording holds no more")
        self._band.take()
        played = self._player.state(organ)
        if played is not None:
            self._live.pause()
            self._show_played(organ, played)
            return
        shown = self._live.draw(self._view)
        self._place_tools(shown)
        self._show_numbers(organ, shown, self._chosen.values(organ), self._chosen.given)

    def _follow_choice(self) -> None:
        """Show which tool is chosen, and subscribe the band of its force."""
        tools = self._chosen.tools
        tools.advance()
        self._band.follow(tools.chosen, tools.name)
        self._view.name_tools(tools.labels, tools.chosen)
        self._panels.tool.show_tools(tools.names, tools.name)

    def _place_tools(self, shown: Sequence[ShownPeriod]) -> None:
        forces = [(not one.missing) * one.force for one in shown]
        holds = [one.holds for one in shown]
        self._view.place_tools(np.array([one.tip for one in shown]), np.array(forces), holds)

    def _show_played(self, organ: Organ, played: Played) -> None:
        """Update the page from a recording that plays."""
        largest = self._view.move(played.cloud)
        self._view.grey(any(one.missing for one in played.shown))
        self._place_tools(played.shown)
        self._panels.recordings.show(self._player.part)
        drawn = [one._replace(largest=largest) for one in played.shown]
        self._show_numbers(organ, drawn, played.material, played.given)

    def _show_numbers(
        self,
        organ: Organ,
        shown: Sequence[ShownPeriod],
        material: dict[str, float],
        given: dict[str, float],
    ) -> None:
        """Show the chosen tool's numbers, for a material by coordinate [SI], and all alerts."""
        tools, is_live = self._chosen.tools, not self._player.is_on
        mine = shown[tools.chosen]
        if is_live and not mine.missing:
            mine = mine._replace(band=self._band.of(mine.size))
        n_kept = self._recorder.n_periods if self._recorder.is_on else None
        numbers = frame_text(mine, material_text(organ, material), n_kept, tools.label)
        self._panels.show_numbers("<br>".join(numbers))
        switching = alerts_of_switch(
            self._requests.switching, self._chosen.scene_name, self._recorder.is_on
        )
        over = [*self._new_patient.alerts(organ.name), *self._player.alerts, *self._scan.alerts]
        self._alerts = [*switching, *over, *alerts(organ.info, given, shown, tools.labels)]
        self._panels.show_alerts(self._alerts)
        self._panels.show_scale(self._coloured.legend())
        if self._frame % _PLOT_FRAMES == 0:
            self._measured = self._measure(mine, material)
            self._panels.tool.show_period(mine if is_live else None)
        self._lines = [*map(plain, numbers), *self._measured]

    def _measure(self, mine: ShownPeriod, material: dict[str, float]) -> list[str]:
        """Draw the measures around the chosen tool, and list them in lines."""
        self._measures.change_tip(self._chosen.tip)
        measured = self._measures.lines(Now(self._view.points, mine.tip, material["young"]))
        self._panels.measure.show(measured)
        return measured

    def _poll_cell(self) -> None:
        """Check which nodes run, the files of the library, and that the tool driver runs."""
        missing, statuses = self._requests.missing, self._live.statuses
        tools, has_organ = self._chosen.tools, self._organ is not None
        self._panels.show_cell(warnings(missing, has_organ, statuses, tools.labels, self._missed))
        self._panels.scene.show_scene(self._chosen.scene_name)
        self._offer_files()
        self._drive()
        if "patient_interpolation" in missing:
            self._requests.builder_is_missing()
        if "contact" in missing:
            if not self._was_missing:
                self._recordings.stop("the contact node ended")
            self._was_missing = True
        elif self._was_missing or not tools.names:  # an answer may be lost
            self._was_missing = False
            self._requests.parameters_of_contact(_OF_CONTACT, self._on_contact_started)
        elif self._is_to_restore and statuses and ContactState.STATUS_NO_MODEL not in statuses:
            self._is_to_restore = False
            self._chosen.send_again()
        else:  # other programs set these too, e.g. `avatar calibrate --set`
            self._requests.parameters_of_contact(_FOLLOWED, self._chosen.follow_contact)

    def _on_contact_started(self, values: dict[str, Any]) -> None:
        """Take over the parameters of a contact node that was started or restarted."""
        self._requests.contact_started()
        self._chosen.contact, self._is_to_restore = values, True
        self._use_tools(self._chosen.moved)
        self._view.change_tips(self._chosen.tips)
        self._chosen.show_material()

    def _use_tools(self, names: tuple[str, ...]) -> None:
        """Move these tools of the contact node; if their number changes, from starting places."""
        tools, organ = self._chosen.tools, self._organ
        if not names:
            self._say(f"the contact node has no tool '{self._chosen.only}': set the page's `tool`")
            return
        if names != tools.names:
            self._driver.end()
            targets = tools.targets
            if len(names) != len(targets):
                self._chosen.scene = ""  # it had another number of tools
                self._player.close()
                self._live.forget()
                tips = self._chosen.tips
                targets = np.zeros((len(tips), 3)) if organ is None else organ.starts(tips)
                self._view.show_tools(tips, targets)
            tools.use(names, targets)
            self._panels.scene.offer(len(self._chosen.contact["tools"]))
        self._drive()

    def _drive(self) -> None:
        """Start the driver of the tools' poses, once tools and organ are known."""
        names = self._chosen.tools.names
        if self._organ is not None and names:
            every = self._chosen.contact["tools"]
            self._driver.ensure_running(names, every, self._frame_id)

    # --- From the page -----------------------------------------------------------------------

    def _say(self, text: str) -> None:
        if self._server is not None:
            self._panels.say(text)

    def _click(self, event: Any) -> None:
        """Handle a click: put the tool on the organ, or measure; on a preview, paint."""
        ray, view = (np.array(event.ray_origin), np.array(event.ray_direction)), self._view
        if self._new_patient.is_previewing:
            self._new_patient.paint(*ray)
        elif (place := view.clicked(*ray)) is not None:
            is_measured = self._measures.mode != TOOL
            taken = self._measures.click if is_measured else self._chosen.put_tool
            self._say(taken(place, view.points))

    def _drag_dot(self, dot: int, origin: np.ndarray, direction: np.ndarray) -> None:
        self._measures.drag(dot, origin, direction, self._view.points, self._view.faces)

    def _in_executor(self, do: Callable[[], None]) -> None:
        """Run in the thread that draws the organ: controls call from several threads."""
        assert self.executor is not None  # the executor runs this node
        self.executor.create_task(do)

    def _offer_files(self) -> None:
        try:
            self._panels.offer(self._library.offer())
        except OSError as error:  # e.g. a network folder that is no longer mounted
            self._say(f"the library cannot be read: {error.strerror}")

    def _choose_built(self, file: str) -> None:
        """Offer a patient that was built; the organ in use stays."""
        self._offer_files()
        self._panels.organ.choose_file(file)

    # --- The plan ----------------------------------------------------------------------------

    def _show_look(self, how: str, side: str, part: float) -> None:
        self._view.look(how, side, part)
        self._panels.organ.show_look(how, side, part)

    def _plan_now(self) -> PlanNow | None:
        organ, chosen = self._organ, self._chosen
        if organ is None:
            return None
        return PlanNow(
            organ,
            tuple((x, y, z) for x, y, z in chosen.tools.targets.tolist()),
            chosen.scene,
            chosen.values(organ),
            chosen.look,
            tuple(self._lines),
            tuple(self._alerts),
            self._view.points,
            self._coloured.scale,
            self._not_now(),
            chosen.given,
        )

    def _not_now(self) -> str:
        """Return why the picture is not the present state; empty if it is."""
        if self._player.is_on:
            return "a recording is shown: go back to now, and keep the present state"
        if self._new_patient.is_previewing:
            return "a preview is shown, not the organ in use: end the preview first"
        return ""


def main() -> int:
    """Run the node; return the exit code."""
    free_at_once()  # recordings and images come and go
    return run(PlanningNode)


if __name__ == "__main__":
    raise SystemExit(main())
