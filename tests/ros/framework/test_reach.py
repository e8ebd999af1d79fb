"""Reach of a node: by default this machine only, measured between two network namespaces."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.srv import GetState

from avatar_ros.framework.discovery import (
    BY_PROFILE,
    LOCAL,
    PROFILES,
    RANGE,
    TRANSPORTS,
    stay_local,
    udp_alone,
)
from tests.helpers.slowness import end_of
from tests.ros.conftest import START_TIMEOUT
from tests.ros.helpers.hosts import two_hosts

FAST_DDS = "rmw_fastrtps_cpp"
NODE = [sys.executable, "-m", "avatar_ros.nodes.vademecum_loader"]
LISTENING = 8.0  # a peer gets an answer within 2 s, if at all [s]
HEARD = """
import time, rclpy
from rcl_interfaces.msg import Log
from rclpy.qos import QoSProfile, DurabilityPolicy
rclpy.init()
node = rclpy.create_node("peer")
heard = []
node.create_subscription(
    Log, "/rosout", lambda message: heard.append(message.name),
    QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL))
end = time.monotonic() + {seconds}
while time.monotonic() < end and "vademecum_loader" not in heard + node.get_node_names():
    rclpy.spin_once(node, timeout_sec=0.1)
print("heard" if "vademecum_loader" in heard + node.get_node_names() else "nothing")
"""


def test_a_node_stays_local_unless_told_otherwise() -> None:
    default: dict[str, str] = {}
    stay_local(default)
    assert default[RANGE] == LOCAL
    assert "127.0.0.1" in Path(default[PROFILES]).read_text()
    for told in ({RANGE: "SUBNET"}, {RANGE: LOCAL, "ROS_STATIC_PEERS": "10.0.0.1"}):
        environment = dict(told)
        stay_local(environment)
        assert environment == told
    own = {PROFILES: "/own.xml"}
    stay_local(own)
    assert own == {PROFILES: "/own.xml", RANGE: LOCAL}


def test_what_keeps_time_has_udp_alone_and_leaves_no_trace() -> None:
    environment: dict[str, str] = {}
    stay_local(environment)
    before = dict(environment)
    with udp_alone(FAST_DDS, environment):
        assert environment[RANGE] == BY_PROFILE
        profile = Path(environment[PROFILES]).read_text()
        assert "127.0.0.1" in profile and "<type>SHM" not in profile
    assert environment == before


@pytest.mark.parametrize(
    ("middleware", "told", "added"),
    [
        (FAST_DDS, {RANGE: "SUBNET"}, {TRANSPORTS: "UDPv4"}),
        (FAST_DDS, {RANGE: "SUBNET", TRANSPORTS: "LARGE_DATA"}, {}),
        (FAST_DDS, {RANGE: LOCAL, PROFILES: "/own.xml"}, {}),
        ("rmw_cyclonedds_cpp", {RANGE: LOCAL}, {}),
    ],
    ids=["subnet", "transports", "profile", "middleware"],
)
def test_udp_alone_leaves_what_the_user_chose(
    middleware: str, told: dict[str, str], added: dict[str, str]
) -> None:
    environment = dict(told)
    with udp_alone(middleware, environment):
        assert environment == told | added
    assert environment == told


@pytest.mark.parametrize("middleware", ["rmw_cyclonedds_cpp", "rmw_zenoh_cpp"])
def test_another_middleware_stays_on_this_machine(middleware: str) -> None:
    """It reads no profile: without the range, everybody would hear it."""
    environment: dict[str, str] = {}
    stay_local(environment)
    with udp_alone(middleware, environment):
        assert environment[RANGE] == LOCAL


def _plain(environment: dict[str, str]) -> dict[str, str]:
    """Return the environment of a user's shell: nothing is set about discovery."""
    kept = {k: v for k, v in environment.items() if k not in (RANGE, PROFILES, TRANSPORTS)}
    return {k: v for k, v in kept.items() if k != "FASTDDS_DEFAULT_PROFILES_FILE"}


def _listening(pid: int) -> set[str]:
    """List the addresses of the UDP ports of DDS on which a process receives, in this namespace."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = os.readlink(link)
        except FileNotFoundError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = set()
    for line in Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]:
        words = line.split()
        address, port = words[1].split(":")
        if words[9] in inodes and 7400 <= int(port, 16) < 7400 + 250 * 233:
            octets = bytes.fromhex(address)[::-1]
            found.add((".".join(map(str, octets)), int(port, 16)))
    domain = int(os.environ["ROS_DOMAIN_ID"])
    first = 7400 + 250 * domain
    return {address for address, port in found if first <= port < first + 250}


def _threads(pid: int) -> str:
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return " ".join(sorted((task / "comm").read_text().strip() for task in tasks))


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "shared_memory"), [("vademecum_loader", True), ("contact", False)]
)
def test_a_node_receives_on_the_loopback_alone(
    own_domain: dict[str, str], probe: Any, name: str, shared_memory: bool
) -> None:
    """The time-critical node receives through no shared memory."""
    command = [sys.executable, "-m", f"avatar_ros.nodes.{name}"]
    node = subprocess.Popen(command, env=_plain(own_domain), cwd="/")
    try:
        probe.ask(GetState, f"{name}/get_state", GetState.Request())  # it is heard here
        assert _listening(node.pid) == {"127.0.0.1"}
        assert ("dds.shm" in _threads(node.pid)) == shared_memory
    finally:
        node.terminate()
        assert end_of(node, 10.0) == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("said", "heard"),
    [({}, "nothing"), ({RANGE: LOCAL}, "nothing"), ({RANGE: "SUBNET"}, "heard")],
    ids=["default", "localhost", "subnet"],
)
def test_another_machine_reaches_a_node_only_if_told(
    own_domain: dict[str, str], tmp_path: Path, said: dict[str, str], heard: str
) -> None:
    """The other machine even knows the address, and looks there."""
    with two_hosts(tmp_path, _plain(own_domain)) as hosts:
        node = hosts.run("planning", *NODE[1:], environment=_plain(own_domain) | said)
        time.sleep(2.0)
        environment = _plain(own_domain) | {RANGE: "SUBNET", "ROS_STATIC_PEERS": hosts.ADDRESS}
        seconds = LISTENING if heard == "nothing" else START_TIMEOUT  # it ends when it hears
        script = HEARD.format(seconds=seconds)
        peer = hosts.run("haptic", "-c", script, environment=environment)
        end_of(peer, 2 * START_TIMEOUT)
        assert peer.communicate()[0].strip() == heard
        assert node.poll() is None
        node.terminate()
        assert end_of(node, 10.0) == 0


def test_security_that_is_not_there_lets_nothing_run(
    own_domain: dict[str, str], tmp_path: Path
) -> None:
    """These wheels have no DDS security; with security, the key is missing, and nothing runs."""
    environment = own_domain | {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(tmp_path),
    }
    with subprocess.Popen(NODE, env=environment, cwd="/", stderr=subprocess.DEVNULL) as node:
        assert end_of(node, 60.0) == 1
