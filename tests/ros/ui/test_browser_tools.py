"""The page of a cell with two tools, in a real browser: both are moved, pressed and recorded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_ros.ui.view.organ import Organ
from tests.ros.helpers.browser import (
    beside_pose,
    choose,
    drag_there,
    force_of,
    look_beside,
    news,
    open_tab,
    press,
    pressed,
    until,
)
from tests.ros.helpers.page import NAMES

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def contact() -> list[str]:
    return ["-p", "tools:=[left,right]", "-p", "scene:=two_tools"]


def take(page: Any, tool: str) -> None:
    """Choose a tool, and wait until its numbers are shown."""
    open_tab(page, "Tool")
    choose(page, "Tool", tool)
    until(page, lambda: f"orce on {tool}" in page.inner_text("#numbers"), f"numbers of {tool}")


def lift_both(page: Any) -> None:
    for name in NAMES:
        take(page, name)
        press(page, "Lift off the organ")
        until(page, lambda name=name: f"on {name} 0.00 N" in page.inner_text("body"), "it is off")


def test_a_tool_is_chosen_in_the_list_or_by_dragging_it(
    page: Any, shown: Organ, shots: Path
) -> None:
    page.get_by_label("Tool", exact=True).wait_for()  # once the contact node was asked
    take(page, "left")
    page.mouse.click(60, 700)  # nothing is there, and the list takes no more keys
    look_beside(page)
    take(page, "right")
    pressed(page, 0.5, "right")
    drag_there(page, beside_pose(shown), shown.above(0.020), shown.above(-0.002))  # the left one
    until(page, lambda: force_of(page, "left") > 0.05, "a force on the tool that is dragged")
    page.mouse.up()
    assert page.get_by_label("Tool", exact=True).input_value() == "left"
    page.wait_for_timeout(2000)
    page.screenshot(path=shots / "two.png")
    take(page, "right")
    until(page, lambda: force_of(page, "right") > 0.05, "the other tool goes on pressing")
    lift_both(page)


def test_a_kept_state_brings_both_back(page: Any, folder: Path) -> None:
    for name in NAMES:
        take(page, name)
        pressed(page, 0.5, name)
    open_tab(page, "Plan")
    press(page, "Keep this state")
    news(page, "kept in plan-")
    (file,) = folder.glob("plan-*.json")
    (state,) = json.loads(file.read_text())["states"]
    assert np.shape(state["targets"]) == (2, 3)
    lift_both(page)
    open_tab(page, "Plan")
    press(page, "return to it")
    news(page, "back at")
    for name in NAMES:
        take(page, name)
        until(page, lambda name=name: force_of(page, name) > 0.3, f"a force on {name} again")
    lift_both(page)
