"""Faults of real processes while a tool palpates at 1 kHz; a row for each fault.

`pytest -m long tests/ros/nodes/test_faults.py -s` prints the table.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_interfaces.srv import InterpolatePatient, LoadScene, LoadVademecum
from tests.helpers.slowness import end_of, slowness, wait_until
from tests.ros.conftest import START_TIMEOUT, Probe
from tests.ros.helpers.fault_cell import MOST, FaultCell, Harm, Silence
from tests.ros.helpers.parameters import set_parameters

pytestmark = [pytest.mark.long, pytest.mark.timing]

STOPPED = 2.0  # [s]
RECOVERY = 1.0  # on an idle machine [s]
JOINING = 30  # processes, two at a time
SWAPS = 150
JOIN = """
import time, rclpy
rclpy.init()
node = rclpy.create_node("passer_by")
time.sleep(0.4)
"""
STALE = 20e-3  # age of a stale pose [s]
SILENT_AFTER = STALE + 10e-3  # the force is gone [s]


@pytest.fixture(scope="module")
def cell(
    own_domain: dict[str, str], library: Path, folder: Path, touch: tuple[np.ndarray, np.ndarray]
) -> Iterator[FaultCell]:
    cell = FaultCell(library, folder, touch, own_domain)
    yield cell
    cell.close()


@pytest.fixture(autouse=True)
def nothing_is_lost(library: Path, folder: Path) -> Iterator[None]:
    """Check that the files of both libraries are unchanged, to the bit."""
    before = _digests(library) | _digests(folder)
    yield
    after = _digests(library) | _digests(folder)
    assert {name: after.get(name) for name in before} == before


def _digests(place: Path) -> dict[str, str]:
    return {
        str(path): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in place.iterdir()
        if path.is_file() and path.suffix in (".h5", ".obj")
    }


@pytest.fixture
def tool(cell: FaultCell) -> Iterator[FaultCell]:
    """Run a cell whose tool palpates."""
    if "tool" not in cell.processes:
        cell.start("tool")
    for name in ("loader", "contact", "patients", "viewer"):
        if name not in cell.processes or cell.processes[name].poll() is not None:
            cell.start(name)
    yield cell


def accept(harm: Harm) -> None:
    print(f"\n{harm.row()}")
    assert harm.finite
    assert harm.largest <= MOST * (1 + 1e-9)
    assert harm.recovery <= RECOVERY * slowness()


# --- Processes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["loader", "patients", "viewer"])
def test_another_process_is_killed(tool: FaultCell, name: str) -> None:
    harm = tool.suffer(f"kill -9 of {name}", lambda cell: cell.end(name))
    accept(harm)
    # a delay of the loop that long also delayed the tool
    assert harm.recovery == 0.0 or harm.longest_period > STALE


def test_the_tool_is_killed(tool: FaultCell) -> None:
    def kill(cell: FaultCell) -> Silence:
        cell.end("tool")
        begin = time.monotonic()
        time.sleep(1.0)
        silent = time.monotonic()
        cell.start("tool")  # takes about a second to send its first pose
        return Silence(begin, cell.heard_from_tool(silent))

    harm = tool.suffer("kill -9 of the tool", kill)
    accept(harm)
    assert harm.silent_after <= SILENT_AFTER + harm.late


def test_the_contact_node_is_killed(tool: FaultCell) -> None:
    """Nobody can send a zero then; once restarted, it goes on softly with the loaded organ."""

    def kill(cell: FaultCell) -> None:
        identity = cell.ear.statuses[-1][2] if cell.ear.statuses else ""
        cell.end("contact")
        cell.ear.statuses.clear()
        cell.start("contact")
        back = lambda: bool(cell.ear.statuses and cell.ear.statuses[-1][2])  # noqa: E731
        wait_until(back, START_TIMEOUT, "the contact node did not come back")
        assert identity in ("", cell.ear.statuses[-1][2])

    accept(tool.suffer("kill -9 of contact, from its first vademecum on", kill))


@pytest.mark.parametrize("name", ["loader", "patients", "viewer"])
def test_another_process_is_stopped(tool: FaultCell, name: str) -> None:
    def stop(cell: FaultCell) -> None:
        with cell.stopped(name, STOPPED):
            pass

    harm = tool.suffer(f"SIGSTOP of {name} for {STOPPED:g} s", stop)
    accept(harm)
    assert harm.longest_gap < 0.5 * STOPPED  # it does not stop with it


def test_the_tool_is_stopped(tool: FaultCell) -> None:
    def stop(cell: FaultCell) -> Silence:
        with cell.stopped("tool", STOPPED) as begin:
            return Silence(begin, time.monotonic())

    harm = tool.suffer(f"SIGSTOP of the tool for {STOPPED:g} s", stop)
    accept(harm)
    assert harm.silent_after <= SILENT_AFTER + harm.late


def test_the_contact_node_is_stopped(tool: FaultCell) -> None:
    def stop(cell: FaultCell) -> None:
        with cell.stopped("contact", STOPPED):
            pass

    accept(tool.suffer(f"SIGSTOP of contact for {STOPPED:g} s", stop))


def test_processes_join(tool: FaultCell, own_domain: dict[str, str]) -> None:
    """Any ROS process of the same machine, with the middleware's own settings."""

    def join(cell: FaultCell) -> None:
        command = [sys.executable, "-c", JOIN]
        for _ in range(JOINING // 2):
            pair = [subprocess.Popen(command, cwd="/", env=own_domain) for _ in range(2)]
            assert [end_of(one, 30.0) for one in pair] == [0, 0]

    harm = tool.suffer(f"{JOINING} processes join", join)
    accept(harm)
    # distinguishes a loop that goes on from one that waits a third of a second per process
    assert harm.longest_period < 0.2


# --- Files, requests, parameters ----------------------------------------------------------------


def test_broken_vademecums_are_offered(tool: FaultCell, lasting_probe: Probe) -> None:
    def offer(cell: FaultCell) -> None:
        for name in ("short.h5", "flipped.h5", "text.h5"):
            answer = lasting_probe.call(
                LoadVademecum, "load_vademecum", LoadVademecum.Request(name=name)
            )
            assert not answer.success and answer.message

    harm = tool.suffer("corrupted and truncated vademecums offered", offer)
    accept(harm)
    assert harm.recovery == 0.0


def test_vademecums_are_swapped_all_the_time(tool: FaultCell, lasting_probe: Probe) -> None:
    """The same organ under two names: the force stays the same."""

    def swap(cell: FaultCell) -> None:
        client = lasting_probe.client(LoadVademecum, "load_vademecum")
        begin = time.monotonic()
        for k in range(SWAPS):
            name = ("twin.h5", "liver.h5")[k % 2]
            client.call_async(LoadVademecum.Request(name=name))
            lasting_probe.until(lambda k=k: time.monotonic() > begin + 0.1 * (k + 1), 10.0)

    harm = tool.suffer(f"{SWAPS} swaps, one every 100 ms", swap)
    accept(harm)


def test_malformed_requests(tool: FaultCell, lasting_probe: Probe) -> None:
    rng = np.random.default_rng(0)
    letters = list("abc/.\\\0\n\t'\"{}[]:,&*#%\u00e9\u4e2d-0123456789")

    def text() -> str:
        return "".join(rng.choice(letters, rng.integers(0, 300))).replace("\0", "")

    asks: list[Callable[[], tuple[type, str, Any]]] = [
        lambda: (LoadVademecum, "load_vademecum", LoadVademecum.Request(name=text())),
        lambda: (LoadScene, "load_scene", LoadScene.Request(yaml=text(), name=text())),
        lambda: (
            InterpolatePatient,
            "interpolate_patient",
            InterpolatePatient.Request(surface=text(), unit=text(), axes=text(), output=text()),
        ),
    ]

    def ask(cell: FaultCell) -> None:
        for k in range(1000):
            answer = lasting_probe.call(*asks[k % 3]())
            assert not answer.success and answer.message and "\n" not in answer.message

    accept(tool.suffer("1,000 malformed requests", ask))


def test_a_storm_of_parameters(tool: FaultCell, lasting_probe: Probe) -> None:
    rng = np.random.default_rng(1)

    def storm(cell: FaultCell) -> None:
        for _ in range(1000):
            many = {
                "material.young_modulus": rng.uniform(0.1e6, 0.2e6),
                "safety.max_force": rng.uniform(0.9 * MOST, MOST),
                "accuracy.tolerance": rng.uniform(-1.0, 2.0),
                "no.such": rng.uniform(),
            }
            set_parameters(lasting_probe, "contact", many)
        still = {"material.young_modulus": 0.0, "safety.max_force": MOST, "accuracy.tolerance": 0.0}
        assert all(set_parameters(lasting_probe, "contact", still))

    accept(tool.suffer("4,000 parameters set, half of them wrong", storm))


def test_a_flood_of_poses(tool: FaultCell) -> None:
    """Ten thousand a second, from the tool itself."""
    tool.end("tool")
    tool.start("tool", 10_000.0)

    def wait(cell: FaultCell) -> None:
        time.sleep(5.0)

    harm = tool.suffer("poses at 10 kHz for 5 s", wait)
    tool.end("tool")
    accept(harm)
    assert harm.periods / 5.0 < 2500.0  # answered at most twice a period
    print(f"load {os.getloadavg()[0]:.1f}")
