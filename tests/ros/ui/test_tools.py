"""Several tools on the planning page: which one is chosen, and what moves it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from avatar_ros.ui.history import History
from avatar_ros.ui.orientation import AXES
from avatar_ros.ui.tabs.tool import KEYS, ToolTab
from avatar_ros.ui.texts import BAND
from avatar_ros.ui.tool_state import SharedToolState
from avatar_ros.ui.tools import Tools
from viser import ViserServer

from tests.ros.helpers.page import NAMES, PLACES, UP, Noted


@pytest.fixture
def tools(state: SharedToolState) -> Tools:
    organ: Any = SimpleNamespace(
        outward=lambda place: UP, lifted=lambda place, clearance: place + clearance * UP
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
    tools.drag(0, np.array([0.5, 0.5, 0.034]), along_shaft=True)
    tools.drag(0, np.array([np.nan, 0.0, 0.0]), along_shaft=False)
    np.testing.assert_allclose(tools.targets[0], [0.0, 0.1, 0.034])


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


# --- The tab ----------------------------------------------------------------------------------


@pytest.fixture
def user() -> Noted:
    return Noted()


@pytest.fixture
def tab(server: ViserServer, user: Noted) -> Any:
    return ToolTab(server.gui, user)  # type: ignore[arg-type]


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
    assert len(tab._forces) == 0  # the curve of another tool is not gone on with
    tab._on_tool(SimpleNamespace(client=None))  # not a user's
    assert user.calls == []
    tab._tools.value = "right"  # by a user, whose choice has not been taken yet
    tab.show_tools(NAMES, "left")
    tab._on_tool(SimpleNamespace(client=object()))
    assert user.calls == [("tool", "right")]


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


def test_a_force_that_was_not_known_is_not_bridged_by_a_line(tab: Any) -> None:
    for k in range(5):
        tab.show_force(k, 50.0, 1.0)
    assert len(tab._plot.data[0]) == 5
    tab.forget_force()  # too deep, from here on
    tab.show_force(12.0, 0.0, 0.0)
    times, forces = tab._plot.data[:2]
    assert times.tolist() == [12.0] and forces.tolist() == [0.0]


def test_buttons_and_keys_move_the_tool_to_the_patients_side(
    server: ViserServer, tab: Any, user: Noted
) -> None:
    buttons = next(
        one for one in server.gui._gui_input_handle_from_uuid.values() if one.label == "1 mm"
    )
    for label, side in (("left", "L"), ("right", "R"), ("up", "S"), ("down", "I")):
        buttons.value = label
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
