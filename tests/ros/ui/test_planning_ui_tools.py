"""The planning page of a cell with two tools, in a real browser: both are moved, felt and kept."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

from avatar_ros.ui.organ import Organ

from avatar_core.scene.recording import load_recording
from avatar_core.scene.replay import replay
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.ros.conftest import PATIENT
from tests.ros.helpers.browser import (
    CHROMIUM,
    TOKEN,
    browse_in_idle_time,
    choose,
    drag_there,
    force_of,
    free_port,
    look_beside,
    news,
    nodes_of_a_page,
    open_tab,
    opened,
    press,
    pressed,
    shots_in,
    until,
)

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.timing,  # a browser that draws without a graphics card takes both cores
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt install chromium"),
]

NAMES = ("left", "right")


@pytest.fixture(scope="module")
def folder(organ: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tools")
    save_vademecum(organ, folder / "liver.h5")
    return folder


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shots_in(tmp_path_factory.mktemp("shots"))


@pytest.fixture(scope="module")
def page(folder: Path, own_domain: dict[str, str], shots: Path) -> Iterator[Any]:
    library, port = ["-p", f"library_dir:={folder}"], free_port()
    arguments = {
        "vademecum_loader": [*library, "-p", "vademecum:=liver.h5"],
        "contact": [*PATIENT[1:], "-p", "tools:=[left,right]", "-p", "scene:=two_tools"],
        "planning_ui": [*library, "-p", f"port:={port}", "-p", f"token:={TOKEN}"],
    }
    with nodes_of_a_page(arguments, own_domain), opened(port, shots) as page:
        page.get_by_label("Tool", exact=True).wait_for()  # once the contact node was asked
        try:
            yield page
        finally:
            page.screenshot(path=shots / "last.png")


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
    page: Any, folder: Path, shots: Path
) -> None:
    take(page, "left")
    page.mouse.click(60, 700)  # nothing is there, and the list takes keys no more
    look_beside(page)
    take(page, "right")
    pressed(page, 0.5, "right")
    drag_there(page, Organ.of(load_vademecum(folder / "liver.h5")), 0.020, -0.002)  # the left one
    until(page, lambda: force_of(page, "left") > 0.05, "a force on the tool that is dragged")
    page.mouse.up()
    assert page.get_by_label("Tool", exact=True).input_value() == "left"
    page.wait_for_timeout(2000)
    page.screenshot(path=shots / "two.png")
    take(page, "right")
    assert force_of(page, "right") > 0.3  # it went on pressing
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


def test_a_recording_of_both_replays(page: Any, folder: Path) -> None:
    """As far as it is known: not from a period that was lost until no tip touches.

    Where both press, `test_tool_driver` compares, without a browser that takes the cores.
    """
    browse_in_idle_time()
    take(page, "right")
    press(page, "Record")
    news(page, "two tools runs, with several_tools")
    for name in NAMES:
        take(page, name)
        pressed(page, 0.5, name)
    page.wait_for_timeout(1000)
    lift_both(page)
    press(page, "Stop and save")
    news(page, "recording-")
    (file,) = folder.glob("recording-*.h5")
    recording = load_recording(file)
    found = replay(recording, load_vademecum(folder / "liver.h5"))
    force = np.linalg.norm(recording.periods.force, axis=2)
    assert force.max(axis=0).min() > 0.3
    assert ((force > 0.3).any(axis=1) & found.known).sum() > 100
    assert found.difference(recording) <= 1e-9
    assert len(recording.clouds.period) > 5


def test_scenes_of_two_tools_are_offered(page: Any, shots: Path) -> None:
    open_tab(page, "Scene")
    page.get_by_label("Scene", exact=True).click()
    options = page.get_by_role("option").all_inner_texts()
    assert "two_tools" in options and "palpation" not in options
    page.keyboard.press("Escape")
    assert "palpation" in page.inner_text("body")  # and how to come to it
    page.screenshot(path=shots / "scenes.png")
