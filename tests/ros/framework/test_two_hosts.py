"""The contact node on one host, loader and tool on another, and no file in common.

Two network namespaces joined by a virtual link; in that of the contact node the library is hidden.
Needs the right to make them, and skips where that is not given.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_core.vademecum.storage import save_vademecum
from avatar_interfaces.msg import ContactState
from tests.helpers.paths import ROOT
from tests.helpers.slowness import Deadline, end_of, slowness
from tests.ros.helpers.hosts import Hosts, two_hosts

pytestmark = [pytest.mark.long, pytest.mark.timing]

SCRIPTS = ROOT / "tests" / "ros" / "helpers"
LOAD = """
import sys, time, rclpy
from avatar_interfaces.srv import LoadVademecum
rclpy.init()
node = rclpy.create_node("far_planner", enable_rosout=False)
client = node.create_client(LoadVademecum, "load_vademecum")
client.wait_for_service()
time.sleep(0.5)
begin = time.monotonic()
answer = client.call_async(LoadVademecum.Request(name=sys.argv[1]))
rclpy.spin_until_future_complete(node, answer)
print(begin, answer.result().info.id)
"""


@pytest.fixture
def hosts(own_domain: dict[str, str], organ: Any, tmp_path: Path) -> Iterator[Hosts]:
    library = tmp_path / "library"
    library.mkdir()
    save_vademecum(organ, library / "liver.h5")
    save_vademecum(replace(organ, name="twin"), library / "twin.h5")
    environment = own_domain | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    with two_hosts(tmp_path, environment, hidden=library) as found:
        yield found


class Ear:
    """Lines of ``remote_listener.py``, until a wanted one."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.lines: list[dict[str, Any]] = []

    def until(self, wanted: Callable[[dict[str, Any]], bool], timeout: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        passed = Deadline(timeout)
        while not passed:
            line = json.loads(self._process.stdout.readline())
            self.lines.append(line)
            if wanted(line):
                return line
        raise AssertionError(f"not heard within {timeout:g} s; last: {self.lines[-1]}")


def test_a_vademecum_crosses_and_a_dead_link_costs_no_more_than_itself(
    hosts: Hosts, touch: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    library = tmp_path / "library"
    files = ["-p", f"library_dir:={library}", "-p", "vademecum:=liver.h5"]
    hosts.run("planning", "-m", "avatar_ros.nodes.vademecum_loader", "--ros-args", *files)
    hosts.run("haptic", "-m", "avatar_ros.nodes.contact")
    ear = Ear(hosts.run("haptic", str(SCRIPTS / "remote_listener.py")))
    place = [f"{x:.9g}" for x in (*(touch[0] + 4e-3 * touch[1]), *touch[1])]
    hosts.run("planning", str(SCRIPTS / "steady_tool.py"), *place)
    sound = lambda line: line["status"] == ContactState.STATUS_OK and line["largest"] > 0.1  # noqa: E731
    first = ear.until(lambda line: line["id"] and sound(line), 120.0)["id"]

    hosts.link("down")
    begin = time.monotonic()
    ear.lines.clear()
    ear.until(lambda line: line["at"] > begin + 5.0, 10.0)
    dead = [line for line in ear.lines if line["at"] > begin + 0.15]
    assert {line["status"] for line in dead} <= {
        ContactState.STATUS_STALE_POSE,
        ContactState.STATUS_LOST_TOOL,
    }
    assert all(line["largest"] == 0.0 for line in dead)  # a zero is sent, never silence
    rate = (dead[-1]["n"] - dead[0]["n"]) / (dead[-1]["at"] - dead[0]["at"])
    hosts.link("up")
    up = time.monotonic()
    recovery = ear.until(sound, 30.0)["at"] - up

    planner = hosts.run("planning", "-c", LOAD, "twin.h5")
    crossed = ear.until(lambda line: line["id"] not in ("", first), 60.0)
    assert end_of(planner, 60.0) == 0
    asked, identity = planner.communicate()[0].split()
    assert crossed["id"] == identity
    assert all(line["finite"] for line in ear.lines)
    print(
        f"\ndead link for 5 s: zeros at {rate:.0f} Hz heard; force again {recovery:.2f} s after it "
        f"was up; another vademecum in use {crossed['at'] - float(asked):.2f} s after the request"
    )
    # 0.2 s on an idle machine; distinguishes it from waiting for discovery
    assert recovery <= 3.0 * slowness()
