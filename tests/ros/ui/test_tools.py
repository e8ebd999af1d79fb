"""Several tools on the planning page: the chosen one, and its motion."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viser import ViserServer

from avatar_ros.ui.session.shown_period import ShownPeriod
from avatar_ros.ui.session.texts import BAND
from avatar_ros.ui.tabs.tool import KEYS, ToolTab
from avatar_ros.ui.tools.history import History
from avatar_ros.ui.tools.tool_state import SharedToolState
from avatar_ros.ui.tools.tools import OVER, Tools
from avatar_ros.ui.tools.way import way_around
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.orientation import AXES
from tests.helpers.box_organ import UP as UP_OF_BOX
from tests.ros.helpers.page import NAMES, PLACES, UP, Noted


@pytest.fixture
def tools(state: SharedToolState) -> Tools:
    organ: Any = SimpleNamespace(
        outward=lambda place: UP,
        lifted=lambda place, clearance: place + clearance * UP,
        vertices=np.zeros((0, 3)),
        faces=np.zeros((0, 3), int),
    )
    made = Tools(state, History(), lambda: organ)
    made.use(NAMES, PLACES)
    return made


def test_a_drag_chooses_its_tool_and_keys_move_that_one(tools: Tools) -> None:
    assert tools.name == "left"
    tools.drag(1, PLACES[1], 0.2 - PLACES[1], along_shaft=False)
    assert tools.name == "right"
    tools.nudge(np.array([1.0, 0.0, 0.0]), 0.1)
    tools.choose("left")
    tools.lift()
    np.testing.assert_allclose(tools.targets, [[0.0, 0.1, 0.03], [0.3, 0.2, 0.2]])
    tools.choose("nobody")
    assert tools.name == "left"
    tools.drag(0, PLACES[0], np.array([0.5, 0.5, 0.034]), along_shaft=True)
    tools.drag(0, PLACES[0], np.array([np.nan, 0.0, 0.0]), along_shaft=False)
    np.testing.assert_allclose(tools.targets[0], [0.0, 0.1, 0.034])


def test_an_undone_drag_is_that_of_the_tool_that_was_moved(tools: Tools) -> None:
    """Drags of two tools within a second are two changes."""
    for tool in (0, 1):
        for way in (0.1, 0.2, 0.3):
            tools.drag(tool, PLACES[tool], np.full(3, way), along_shaft=False)
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


def tools_at(state: SharedToolState, organ: Organ, place: np.ndarray) -> tuple[Tools, History]:
    """Return one tool, and the history of its places."""
    history = History()
    tools = Tools(state, history, lambda: organ)
    tools.use(("tool",), place[None])
    return tools, history


def gone(tools: Tools) -> list[np.ndarray]:
    """Return the places that a tool passes if it reaches each target at once."""
    passed = [tools.targets[0]]
    for _ in range(12):
        tools.advance()
        if not np.array_equal(passed[-1], tools.targets[0]):
            passed.append(tools.targets[0])
    return passed


def inside(organ: Organ, places: np.ndarray, deep: float = 0.0) -> bool:
    """Return whether straight ways between places pass the box, deeper than this [m]."""
    ways = [np.linspace(a, b, 200) for a, b in itertools.pairwise(places)]
    low, high = organ.vertices.min(axis=0) + deep, organ.vertices.max(axis=0) - deep
    return any(((low < one) & (one < high)).all() for way in ways for one in way)


@pytest.mark.parametrize(
    ("end", "normal"),
    [
        ((0.1, -0.002, 0.1), -UP_OF_BOX),
        ((0.202, 0.1, 0.1), AXES["R"]),
        ((0.13, 0.202, 0.1), UP_OF_BOX),
    ],
    ids=["opposite", "beside", "near"],
)
def test_a_tool_goes_around_the_organ_and_not_through_it(
    cube: Organ, end: tuple[float, float, float], normal: Any
) -> None:
    start = np.array([0.1, 0.202, 0.1])
    way = way_around(cube, start, np.array(end), np.array(normal))
    np.testing.assert_allclose(way[-1], end)
    assert not inside(cube, np.array([start, *way]))
    assert (len(way) == 3) == (end[1] > 0.2)


@pytest.mark.parametrize("deep", [-2e-3, 8e-3], ids=["over", "pressed"])
@pytest.mark.parametrize("far", [True, False])
def test_an_undone_change_of_place_leads_around_the_organ(
    state: SharedToolState, cube: Organ, deep: float, far: bool
) -> None:
    """A kept state is restored by the same method: as deep as it was, no deeper on the way."""
    begin = np.array([0.05, 0.2 - deep, 0.1])
    there = begin + ([0.145, -0.1, 0.0] if far else [0.0, 5e-3, 0.0])
    tools, history = tools_at(state, cube, begin)
    tools.drag(0, begin, there - begin, along_shaft=False)
    np.testing.assert_array_equal(tools.targets[0], there)
    history.undo()
    passed = gone(tools)
    np.testing.assert_array_equal(passed[-1], begin)
    assert not inside(cube, np.array([there, *passed]), max(deep, 5e-3) + 1e-6)
    assert (len(passed) > 1) == far


def test_a_click_sends_the_chosen_tool_over_its_place(state: SharedToolState, cube: Organ) -> None:
    tools, _ = tools_at(state, cube, np.array([0.1, 0.21, 0.1]))
    place = np.array([0.12, 0.2, 0.1])
    tools.put_over(place, UP_OF_BOX, offset=3e-3)
    passed = gone(tools)
    np.testing.assert_allclose(passed[-1], place + (3e-3 + OVER) * UP_OF_BOX)
    assert max(height for _, height, _ in passed) > 0.225  # not along the tissue
    tools.put_over(np.array([0.1, 0.2, 0.1]), UP_OF_BOX, offset=3e-3)
    tools.nudge(np.array([1.0, 0.0, 0.0]), 0.1)  # a user who goes elsewhere
    there = tools.targets
    tools.advance()
    np.testing.assert_array_equal(tools.targets, there)


# --- The tab ----------------------------------------------------------------------------------


@pytest.fixture
def user() -> Noted:
    return Noted()


@pytest.fixture
def tab(server: ViserServer, user: Noted) -> Any:
    return ToolTab(server.gui, user, user)  # type: ignore[arg-type]


def test_tools_are_offered_only_where_there_are_several(tab: Any, user: Noted) -> None:
    tab.show_tools((), "")
    tab.show_tools(("tool",), "tool")
    assert not tab._tools.visible
    tab.show_tools(NAMES, "right")
    assert tab._tools.visible and tab._tools.options == NAMES and tab._tools.value == "right"
    tab.show_force(0.0, 1.0, 0.1)
    tab.show_tools(NAMES, "right")
    assert len(tab._forces) == 1
    tab.show_tools(NAMES, "left")
    assert len(tab._forces) == 0  # the curve of another tool is not continued
    tab._on_tool(SimpleNamespace(client=None))  # not a user's
    assert user.calls == []
    tab._tools.value = "right"  # by a user, whose choice has not been taken yet
    tab.show_tools(NAMES, "left")
    tab._on_tool(SimpleNamespace(client=object()))
    assert user.calls == [("choose", "right")]


def test_the_plot_has_the_band_for_as_long_as_it_shows_one(tab: Any) -> None:
    plain, wide = tab._plot, tab._plot_of_band
    tab.show_force(0.0, 1.0, 0.1)
    assert plain.visible and not wide.visible and len(plain.data) == 4
    tab.show_force(0.2, 1.5, 0.1, (1.0, 2.5))
    assert wide.visible and not plain.visible
    assert [row.tolist() for row in wide.data[4:]] == [[1.0, 1.0], [1.0, 2.5]]
    assert sum(BAND in series["label"] for series in wide.series) == 2
    for k in range(60):
        tab.show_force(0.4 + k, 1.0, 0.1)
    assert plain.visible and not wide.visible


@pytest.mark.parametrize("gap", [None, ShownPeriod.without_force(PLACES[0], "too deep")])
def test_a_force_that_was_not_known_is_not_bridged_by_a_line(
    tab: Any, gap: ShownPeriod | None
) -> None:
    felt = ShownPeriod(PLACES[0], 2.0 * UP, 0.5, 1e-3)
    for _ in range(5):
        tab.show_period(felt)
    times, forces, least, most = tab._plot.data
    assert np.all(np.diff(times) >= 0.0) and times[0] >= 0.0
    np.testing.assert_allclose([forces, least, most], np.outer([2.0, 1.5, 2.5], np.ones(5)))
    tab.show_period(gap)  # too deep, or a recording plays
    tab.show_period(felt._replace(force=np.zeros(3)))
    assert tab._plot.data[1].tolist() == [0.0]


def test_buttons_and_keys_move_the_tool_to_the_patients_side(
    server: ViserServer, tab: Any, user: Noted
) -> None:
    buttons = next(
        one for one in server.gui._gui_input_handle_from_uuid.values() if one.label == "1 mm to"
    )
    for side in "RLAPSI":  # letters that stand around the organ too
        buttons.value = side
        assert user.calls.pop() == ("nudge", AXES[side], 1e-3)
    keys = {one.label: one for one in server.gui._command_handle_from_uuid.values()}
    for label, side in KEYS.values():
        (pressed,) = keys[f"{label}, 1 mm"]._impl.trigger_cb
        pressed(None)
        _, axis, way = user.calls.pop()
        assert axis == (AXES[side] if side else None)
        assert (way < 0.0) == ("Press" in label)
        for word, expected in (("right", "R"), ("left", "L")):
            assert (word in label) == (side == expected)
