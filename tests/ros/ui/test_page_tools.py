"""Several tools on the planning page: all are driven, and each answer is that of its own tool."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="the extra ui is not installed")

import viser
from avatar_ros.framework.templates import stamp_bytes
from avatar_ros.ui.alerts import alerts
from avatar_ros.ui.chosen import Chosen
from avatar_ros.ui.chosen import Page as ChosenPage
from avatar_ros.ui.history import History
from avatar_ros.ui.live import Live
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.player import Player
from avatar_ros.ui.recorder import Recorder
from avatar_ros.ui.recordings import Page, Recordings
from avatar_ros.ui.shown_period import BEYOND, OTHER_BEYOND, PeriodChooser
from avatar_ros.ui.tabs.tool import ToolTab
from avatar_ros.ui.texts import frame_text, other_scenes, scene_texts, warnings
from avatar_ros.ui.tool_state import ROW, SharedToolState
from avatar_ros.ui.tools import Tools
from avatar_ros.ui.view import OrganView

from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import read_scene, shipped_scene
from avatar_core.scene.recording import Clouds, save_recording
from avatar_ros.msg import ContactState
from tests.helpers.box_organ import organ as box

pytestmark = pytest.mark.ros

NAMES = ("left", "right")
OK, OUT = ContactState.STATUS_OK, ContactState.STATUS_OUT_OF_RANGE
PLACES = np.array([[0.0, 0.1, 0.0], [0.05, 0.1, 0.0]])
INFO: Any = SimpleNamespace(l2_mean=0.01, force_mean=0.01)  # of an exact organ


@pytest.fixture
def state() -> SharedToolState:
    made = SharedToolState.make()
    made.use(PLACES)
    return made


# --- The choice of one ------------------------------------------------------------------------


@pytest.fixture
def tools(state: SharedToolState) -> Tools:
    up = np.array([0.0, 0.0, 1.0])
    organ: Any = SimpleNamespace(
        outward=lambda place: up, lifted=lambda place, clearance: place + clearance * up
    )
    made = Tools(state, History(), lambda: organ)
    made.use(NAMES, PLACES)
    return made


def test_a_drag_chooses_its_tool_and_keys_move_that_one(tools: Tools) -> None:
    assert tools.name == "left"
    tools.drag(1, np.array([0.2, 0.2, 0.2]), along_shaft=False)
    assert tools.name == "right"
    tools.nudge(np.array([1.0, 0.0, 0.0]), 0.1)
    tools.choose("left")
    tools.lift()
    np.testing.assert_allclose(tools.targets, [[0.0, 0.1, 0.03], [0.3, 0.2, 0.2]])
    tools.choose("nobody")
    assert tools.name == "left"


def test_an_undone_drag_is_that_of_the_tool_that_was_moved(tools: Tools) -> None:
    """Drags of two tools within a second are two."""
    for tool in (0, 1):
        for way in (0.1, 0.2, 0.3):
            tools.drag(tool, PLACES[tool] + way, along_shaft=False)
    tools.choose("left")
    history = tools._history
    assert history.undo() == "the place of right"
    np.testing.assert_allclose(tools.targets, [PLACES[0] + 0.3, PLACES[1]])
    assert history.undo() == "the place of left"
    np.testing.assert_allclose(tools.targets, PLACES)


def test_one_tool_has_no_name_to_be_said(tools: Tools) -> None:
    assert tools.labels == NAMES and tools.label == "left"
    tools.use(("mtml",), PLACES[:1])
    assert tools.name == "mtml" and tools.labels == ("",) and tools.label == ""


def test_a_kept_state_puts_all_tools_back_and_is_undone_as_a_whole(state: SharedToolState) -> None:
    said: list[str] = []
    nothing: Any = SimpleNamespace()
    quiet = ChosenPage(
        say=said.append,
        stop_recording=said.append,
        change_tips=lambda tips: None,
        show_material=lambda values: None,
        show_look=lambda *look: None,
    )
    chosen = Chosen(state, nothing, quiet)
    chosen.organ = SimpleNamespace(ranges={}, usable=dict)  # type: ignore[assignment]
    chosen.tools.use(NAMES, PLACES)
    kept = PLACES + 0.1
    chosen.return_to("", {}, chosen.look, kept)
    np.testing.assert_allclose(chosen.tools.targets, kept)
    chosen.undo()
    np.testing.assert_allclose(chosen.tools.targets, PLACES)
    chosen.return_to("", {}, chosen.look, kept[:1])  # of a cell of one tool
    np.testing.assert_allclose(chosen.tools.targets, [kept[0], PLACES[1]])


def test_tips_are_those_of_the_scene_that_runs(state: SharedToolState) -> None:
    nothing: Any = SimpleNamespace()
    chosen = Chosen(state, nothing, nothing)
    assert chosen.tips == (Tip(),)
    chosen.contact = {"tools": ["tool"], "scene": "leaning_punch"}
    assert chosen.tips == tuple(t.tip for t in read_scene(shipped_scene("leaning_punch")).tools)
    chosen.contact = {
        "tools": list(NAMES),
        "scene": "",
        "tip.shape": ["sphere", "flat"],
        "tip.radius": [4e-3, 2e-3],
        "tip.half_angle": 0.0,
        "tip.rounding": 0.0,
    }
    chosen.tools.use(NAMES, PLACES)
    chosen.tools.choose("right")
    assert chosen.tip == Tip("flat", 2e-3)


def test_beside_a_device_the_page_has_a_tool_of_its_own(state: SharedToolState) -> None:
    said: list[str] = []
    nothing: Any = SimpleNamespace()
    chosen = Chosen(state, nothing, nothing, only="page")
    chosen.organ = SimpleNamespace(ranges={})  # type: ignore[assignment]
    chosen.contact = {
        "tools": ["stylus", "page"],
        "scene": "",
        "tip.shape": ["sphere", "flat"],
        "tip.radius": [4e-3, 2e-3],
        "tip.half_angle": 0.0,
        "tip.rounding": 0.0,
    }
    assert chosen.moved == ("page",) and not chosen.moves_all
    assert chosen.tips == (Tip("flat", 2e-3),)
    page = Page(say=said.append, show_recording=lambda on: None, answers=lambda: True)
    recordings = Recordings(Path(), nothing, nothing, nothing, chosen, state, page)
    recordings.record(True)
    assert "record a bag" in said[0]
    chosen.only = "probe"
    assert chosen.moved == ()


# --- What is shown ----------------------------------------------------------------------------


def rows(*tools: tuple[int, float]) -> np.ndarray:
    """A period of some statuses and forces [N]."""
    out = np.zeros(len(tools), ROW)
    out["stamp"], out["tip"], out["sent_fraction"] = 5, PLACES[: len(tools)], 1.0
    out["status"] = [status for status, _ in tools]
    out["force"][:, 1] = [force for _, force in tools]
    out["touches"] = out["force"][:, 1] > 0.0
    return out


def test_numbers_are_of_their_own_tool_and_say_whose() -> None:
    chooser, now = PeriodChooser(), rows((OK, 1.0), (OK, 2.5))
    chooser.take(now)
    shown = chooser.drawn(now, 1e-3, PLACES)
    assert [one.size for one in shown] == [1.0, 2.5]
    assert frame_text(shown[1], "", None, "right")[0].startswith("Force on right <b>2.50 N</b>")
    assert frame_text(shown[1], "", None)[0].startswith("Force <b>2.50 N</b>")


def test_a_tool_beyond_the_range_is_named_and_nothing_else_is_shown_as_of_now() -> None:
    """The organ of that period lies as if it were not there, and so do the other tools' forces."""
    chooser, before, beyond = PeriodChooser(), rows((OK, 1.0), (OK, 2.0)), rows((OK, 4.0), (OUT, 0))
    for now in (before, beyond):
        assert chooser.take(now) == (now is before)
        shown = chooser.drawn(now, 1e-3, PLACES)
    assert [one.missing for one in shown] == [OTHER_BEYOND, BEYOND]
    assert all(one.is_held for one in shown) and shown[0].force[1] == 1.0
    assert alerts(INFO, shown, NAMES) == [
        f"left: No force: {OTHER_BEYOND}",
        f"right: No force: {BEYOND}",
    ]


def test_what_is_limited_on_another_tool_is_not_missed() -> None:
    chooser, now = PeriodChooser(), rows((OK, 1.0), (OK, 25.0))
    now["sent_fraction"][1] = 0.8
    chooser.take(now)
    shown = chooser.drawn(now, 1e-3, PLACES)
    expected = "Force limited: the device gets 20.00 N of 25.00 N"
    assert alerts(INFO, shown, NAMES) == [f"right: {expected}"]
    assert alerts(INFO, [shown[1], shown[1]], NAMES) == [expected]  # of both: said once


def test_a_fault_of_one_tool_is_said_with_its_name() -> None:
    lost = ContactState.STATUS_LOST_TOOL
    assert warnings((), True, (OK, lost), NAMES).startswith("⚠ right: ")
    assert "right" not in warnings((), True, (lost, lost), NAMES)
    assert warnings((), True, (OK, OK), NAMES) == "All nodes answer."


def test_scenes_are_those_of_as_many_tools_and_how_to_come_to_the_others_is_said() -> None:
    one, two = scene_texts(1), scene_texts(2)
    assert "two_tools" in two and "two_tools" not in one
    assert "palpation" in one and "palpation" not in two
    assert "`avatar cell --tools left,right`" in other_scenes(1) and "two_tools" in other_scenes(1)
    assert "palpation" in other_scenes(2) and "two_tools" not in other_scenes(2)


def test_a_cloud_is_drawn_with_the_tips_and_forces_of_all_tools(state: SharedToolState) -> None:
    drawn: list[Any] = []
    view: Any = SimpleNamespace(
        move=lambda *given: drawn.append(given) or 1e-3, grey=lambda held: None
    )
    live = Live(None, state, Recorder(state))  # type: ignore[arg-type]
    cloud: Any = SimpleNamespace(take=lambda: (stamp_bytes(5), np.ones((4, 6), np.float32)))
    live._cloud, live.organ = cloud, 7
    now = rows((OK, 1.0), (OK, 2.0))
    now["organ"] = 7
    state.recent[:, 0], state.all["n_recent"] = now, 1
    state.all["heard"] = time.monotonic_ns()
    shown = live.draw(view)
    ((_, tips, forces),) = drawn
    np.testing.assert_array_equal(tips, PLACES)
    assert forces[:, 1].tolist() == [1.0, 2.0] == [one.size for one in shown]
    assert live.statuses == (OK, OK)


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    made = viser.ViserServer("127.0.0.1", port, verbose=False)
    yield made
    made.stop()


def test_all_tools_are_drawn_with_their_names_and_forces(server: viser.ViserServer) -> None:
    dragged: list[tuple[int, np.ndarray]] = []
    view = OrganView(server, lambda tool, place, along: dragged.append((tool, place)))
    cube = Organ.of(box("cube"))
    view.show(cube, (Tip(), Tip("flat", 2e-3)))
    starts = cube.starts((Tip(), Tip("flat", 2e-3)))
    np.testing.assert_allclose([tool.position for tool in view._tools], starts, atol=1e-6)
    view.name_tools(NAMES, 1)
    view.place_tools(PLACES, np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 0.0]]))
    left, right = view._tools
    assert (left._text.text, right._text.text) == ("left 2.0 N", "[right]")
    assert left._arrow.visible and not right._arrow.visible
    way: Any = SimpleNamespace(start_position=(0.0, 0.0, 0.0), end_position=(0.01, 0.0, 0.0))
    right._dragged(way, False)
    ((tool, place),) = dragged
    assert tool == 1 and np.allclose(place, PLACES[1] + [0.01, 0.0, 0.0])
    view.show_tools((Tip(),), PLACES[:1])
    view.name_tools(("",), 0)
    view.place_tools(PLACES[:1], np.zeros((1, 3)))
    assert len(view._tools) == 1 and not view._tools[0]._text.visible


def test_tools_are_offered_only_where_there_are_several(server: viser.ViserServer) -> None:
    chosen: list[str] = []
    tab = ToolTab(server.gui, SimpleNamespace(tool=chosen.append))  # type: ignore[arg-type]
    tab.show_tools((), "")
    tab.show_tools(("tool",), "tool")
    assert not tab._tools.visible
    tab.show_tools(NAMES, "right")
    assert tab._tools.visible and tab._tools.options == NAMES and tab._tools.value == "right"
    tab.show_force(0.0, 1.0, 0.1)
    tab.show_tools(NAMES, "right")
    assert len(tab._forces) == 1
    tab.show_tools(NAMES, "left")
    assert len(tab._forces) == 0  # the curve of another tool is not gone on with
    tab._on_tool(SimpleNamespace(client=None))  # not a user's
    assert chosen == []
    tab._tools.value = "right"  # by a user, whose choice has not been taken yet
    tab.show_tools(NAMES, "left")
    tab._on_tool(SimpleNamespace(client=object()))
    assert chosen == ["right"]


# --- Recordings -------------------------------------------------------------------------------


def test_no_recording_begins_while_any_tool_touches(state: SharedToolState, tools: Tools) -> None:
    said: list[str] = []
    chosen: Any = SimpleNamespace(organ=object(), tools=tools, moves_all=True)
    nothing: Any = SimpleNamespace()
    recorder = Recorder(state)
    page = Page(say=said.append, show_recording=lambda on: None, answers=lambda: True)
    recordings = Recordings(Path(), recorder, nothing, nothing, chosen, state, page)
    state.recent[:, 0], state.all["n_recent"] = rows((OK, 0.0), (OK, 2.0)), 1
    recordings.record(True)
    assert said == ["lift right off the organ first: a recording starts at rest"]
    assert not recorder.is_on
    recordings._begin(True)
    assert said[-1].startswith("not recorded: right touched the organ again")


class AtOnce:
    """Reads in this process."""

    def read(self, name: str, size: int, read: Any, *arguments: Any) -> Any:
        return read(*arguments)


def test_a_recording_of_two_tools_is_played_with_both(tmp_path: Path) -> None:
    from avatar_core.scene.file import write_scene
    from avatar_core.scene.recording import Periods as RecordedPeriods
    from avatar_core.scene.recording import Recording

    cube = replace(Organ.of(box("cube")), id="a" * 64)
    n, number = 60, np.arange(60)
    force, tip = np.zeros((n, 2, 3)), np.tile(PLACES, (n, 1, 1))
    force[:, 0, 1], force[:, 1, 1] = 1.0, 0.1 * number
    tip[:, 1, 2] = 1e-4 * number
    status = np.zeros((n, 2), np.uint8)
    status[45:, 0] = OUT
    periods = RecordedPeriods(
        number=number,
        stamp=number * 1_000_000,
        tip=tip,
        turn=np.zeros((n, 2, 3)),
        status=status,
        force=force,
        error=np.full((n, 2), 0.1),
        sent_fraction=np.ones((n, 2)),
    )
    clouds = Clouds(number[::20], np.zeros((3, *cube.vertices.shape), np.float32))
    scene = write_scene(read_scene(shipped_scene("two_tools")))
    made = Recording(cube.id, cube.name, scene, 1000.0, True, periods, clouds)
    save_recording(made, tmp_path / "recording-2.h5")
    player = Player(tmp_path, AtOnce())  # type: ignore[arg-type]
    assert "is of 2 tools, the cell has 1" in player.open("recording-2.h5", cube, 1)
    assert player.open("recording-2.h5", cube, 2) == ""
    player.seek(1.0)
    played = player.state(cube)
    assert played is not None
    left, right = played.shown
    assert left.size == 1.0 and right.size == pytest.approx(4.0)
    np.testing.assert_allclose([left.tip, right.tip], tip[40])
    assert not left.missing and not right.missing
