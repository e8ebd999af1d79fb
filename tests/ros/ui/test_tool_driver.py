"""The process that drives the planning page's tools, alone and with the contact node."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped

from avatar_core.contact.tool_path import middle_of_access
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import read_scene, shipped_scene
from avatar_core.scene.recording import load_recording
from avatar_core.scene.replay import replay
from avatar_core.vademecum.storage import load_vademecum
from avatar_interfaces.srv import LoadScene
from avatar_ros.bench.cell import Module
from avatar_ros.bench.footprint import children
from avatar_ros.framework import qos
from avatar_ros.framework.discovery import stay_local
from avatar_ros.ui.session.recorder import Recorder
from avatar_ros.ui.tools.tool_driver import PeriodCollector
from avatar_ros.ui.tools.tool_state import SharedToolState, ToolDriverProcess, organ_number
from tests.helpers.slowness import Deadline, wait_until
from tests.ros.conftest import PATIENT, START_TIMEOUT, Probe
from tests.ros.helpers.page import NAMES, OK, PLACES

APART = 0.02  # distance of two tips on the organ [m]
DEPTH = 0.003  # depth to which they press [m]


# --- The driver -------------------------------------------------------------------------------


@pytest.fixture
def driven(
    state: SharedToolState, own_domain: dict[str, str]
) -> Iterator[tuple[SharedToolState, ToolDriverProcess]]:
    process = ToolDriverProcess(state)
    process.ensure_running(NAMES, NAMES, "organ")
    yield state, process
    process.end()


def test_it_has_no_shared_memory(
    state: SharedToolState, own_domain: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through it, any process that joins can delay its poses for a third of a second."""
    as_page: dict[str, str] = {}
    stay_local(as_page)
    for name, value in as_page.items():
        monkeypatch.setenv(name, value)
    process = ToolDriverProcess(state)
    process.ensure_running(NAMES, NAMES, "organ")
    wait_until(lambda: bool(state.all["n_poses"][0] > 0), START_TIMEOUT)
    (driver,) = [
        pid
        for pid in children(os.getpid())
        if b"tool_driver" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    names = {(task / "comm").read_text() for task in Path(f"/proc/{driver}/task").iterdir()}
    process.end()
    assert any("dds." in name for name in names)
    assert not any("dds.shm" in name for name in names)


def test_poses_of_all_tools_are_of_one_time_and_each_goes_its_way(
    driven: tuple[SharedToolState, ToolDriverProcess], probe: Probe
) -> None:
    state, _ = driven
    poses: dict[str, dict[int, np.ndarray]] = {name: {} for name in NAMES}

    def note(name: str, message: PoseStamped) -> None:
        place, stamp = message.pose.position, message.header.stamp
        assert message.header.frame_id == "organ"
        poses[name][stamp.sec * 10**9 + stamp.nanosec] = np.array([place.x, place.y, place.z])

    for name in NAMES:
        probe.node.create_subscription(
            PoseStamped, f"{name}/measured_cp", lambda m, name=name: note(name, m), qos.NEWEST
        )
    probe.until(lambda: all(poses.values()), 30.0)
    goals = PLACES + np.array([[0.0, 0.0, 0.004], [0.0, -0.006, 0.0]])
    state.each["target"] = goals

    def arrived() -> bool:
        newest = (of[max(of)] for of in poses.values())
        return all(np.allclose(*pair, atol=1e-5) for pair in zip(newest, goals, strict=True))

    probe.until(arrived, 30.0)
    both = set(poses["left"]) & set(poses["right"])
    assert len(both) > 0.5 * max(map(len, poses.values()))
    np.testing.assert_allclose(state.sent, goals, atol=2e-5)


def answer(tool: str, step: int, force: float) -> Any:
    """Return a ContactState of a step, at 1 kHz."""
    stamp = SimpleNamespace(sec=0, nanosec=1000 * (step + 1))
    contact = SimpleNamespace(force=SimpleNamespace(x=0.0, y=force, z=0.0))
    return SimpleNamespace(
        tool=tool,
        status=OK,
        header=SimpleNamespace(stamp=stamp),
        contacts=[contact],
        force_error=0.1,
        force_share=1.0,
        held=False,
        vademecum_id="a" * 64,
    )


def used(tool: int, _status: int, stamp: int) -> np.ndarray:
    """Return a place that encodes tool and pose."""
    return np.full(3, tool + 1e-9 * stamp)


def test_a_period_has_the_states_of_one_step_or_is_lost(state: SharedToolState) -> None:
    """The first state of step 2 and the last one of step 4 are lost; the count goes on."""
    state.all["recording"] = 1
    periods = PeriodCollector(NAMES, NAMES, state, used)
    number = 1
    for step in range(7):
        for tool, name in enumerate(NAMES):
            if (step, tool) not in ((2, 0), (4, 1)):
                periods.note(answer(name, step, 10.0 * tool + step), number)
            number += 1
    rows = state.recorded()
    assert rows["number"].tolist() == 2 * [[0, 1, 3, 5, 6]]
    np.testing.assert_array_equal(rows["force"][:, :, 1], [[0, 1, 3, 5, 6], [10, 11, 13, 15, 16]])
    assert (rows["stamp"][0] == rows["stamp"][1]).all()
    np.testing.assert_allclose(rows["tip"][1] - rows["tip"][0], 1.0)
    newest = state.period()
    assert newest is not None and newest["force"][:, 1].tolist() == [6.0, 16.0]


def test_beside_a_device_the_states_of_its_tool_are_passed_over(state: SharedToolState) -> None:
    """The device's is the second of three, so that the last one's place is not its count."""
    state.all["recording"] = 1
    every = ("left", "stylus", "right")
    periods = PeriodCollector(NAMES, every, state, used)
    for number in range(12):
        periods.note(answer(every[number % 3], number // 3, float(number)), number)
    rows = state.recorded()
    assert rows["number"].tolist() == 2 * [[0, 1, 2, 3]]
    np.testing.assert_array_equal(rows["force"][:, :, 1], [[0, 3, 6, 9], [2, 5, 8, 11]])


# --- In a cell --------------------------------------------------------------------------------


@pytest.fixture
def cell(
    own_domain: dict[str, str], library: Path
) -> Iterator[tuple[SharedToolState, Callable[[], None]]]:
    """Run the contact node with the shipped scene of two tools, and the page's driver of both."""
    words = ["-p", "tools:=[left,right]", "-p", "scene:=two_tools"]
    files = ["-p", f"library_dir:={library}", "-p", "vademecum:=liver.h5"]
    processes = {
        "vademecum_loader": Module("vademecum_loader", ["--ros-args", *files], own_domain),
        "contact": Module("contact", [*PATIENT, *words], own_domain),
    }
    state = SharedToolState.make()
    driver = ToolDriverProcess(state)

    def start() -> None:
        driver.ensure_running(NAMES, NAMES, "organ")

    yield state, start
    driver.end()
    assert {name: process.finish() for name, process in processes.items()} == {
        "vademecum_loader": 0,
        "contact": 0,
    }


def until(reached: Callable[[], bool], what: str, seconds: float = START_TIMEOUT) -> None:
    passed = Deadline(seconds)
    while not reached():
        assert not passed, f"{what}: not within {seconds:g} s"
        time.sleep(0.01)


@pytest.mark.long
def test_a_still_tool_feels_the_other_and_the_recording_of_both_replays(
    cell: tuple[SharedToolState, Callable[[], None]], library: Path, tmp_path: Path, probe: Probe
) -> None:
    state, start = cell
    vademecum = load_vademecum(library / "liver.h5")
    surface, middle = vademecum.surface, middle_of_access(vademecum)
    beside = np.argmin(
        np.abs(np.linalg.norm(surface.centers - surface.centers[middle], axis=1) - APART)
    )
    places = surface.centers[[middle, beside]]
    normals = surface.normals[[middle, beside]]

    def at(*depths: float) -> np.ndarray:
        return np.asarray(places + (Tip().offset - np.array(depths)[:, None]) * normals)

    def forces() -> np.ndarray:
        period = state.period()
        return np.zeros(2) if period is None else np.linalg.norm(period["force"], axis=1)

    state.use(at(-0.01, -0.01))
    start()
    used = organ_number(vademecum.id)
    until(
        lambda: (p := state.period()) is not None and (p["organ"] == used).all(), "the organ in use"
    )
    recorder = Recorder(state)
    recorder.open(vademecum, read_scene(shipped_scene("two_tools")), 1000.0)
    assert probe.call(LoadScene, "load_scene", LoadScene.Request(name="two_tools")).success
    recorder.begin()
    state.each["target"] = at(DEPTH, -0.01)
    until(lambda: forces()[0] > 0.1, "a force on the still tool", 60.0)
    time.sleep(1.0)
    alone = forces()
    assert alone[1] == 0.0
    state.each["target"][1] = at(DEPTH, DEPTH)[1]
    until(lambda: forces()[1] > 0.1, "a force on the other tool", 60.0)
    time.sleep(1.0)
    both = forces()
    print(f"the still tool: {alone[0]:.3f} N alone, {both[0]:.3f} N beside the other")
    assert alone[0] - both[0] > 0.02 * alone[0]  # the other one lowers the surface under it
    saved = recorder.save(tmp_path)
    assert saved is not None
    recording = load_recording(saved[0])
    periods = recording.periods
    assert periods.force.shape[1:] == (2, 3) and (periods.force.any(axis=(0, 2))).all()
    found = replay(recording, vademecum)
    print(f"{len(periods)} periods, {periods.lost.sum()} lost, {found.known.mean():.0%} known")
    assert found.known.sum() > 100  # a busy machine loses many
    assert found.difference(recording) <= 1e-9
