"""Quality of service by parameters: accepted and refused values, and who is told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from avatar_interfaces.msg import ContactState, LoopStatistics
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from tests.helpers.slowness import slowness
from tests.ros.conftest import Probe
from tests.ros.helpers.refusals import refusal
from tests.ros.helpers.running import running, running_cell

POSES = "qos_overrides./tool/measured_cp.subscription"
WRENCHES = "qos_overrides./tool/servo_cf.publisher"
RELIABLE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


def diagnosis(probe: Any, wanted: Any) -> DiagnosticStatus:
    def found(array: DiagnosticArray) -> DiagnosticStatus:
        return next(s for s in array.status if s.name == "/contact: quality of service")

    array = probe.next(DiagnosticArray, "/diagnostics", qos.STATISTICS, lambda a: wanted(found(a)))
    return found(array)


@pytest.mark.parametrize(
    ("node", "value", "reason"),
    [
        ("contact", f"{POSES}.depth:=5", "depth: give 1, as only the newest counts"),
        ("contact", f"{POSES}.durability:=transient_local", "must not get an old one"),
        ("contact", f"{WRENCHES}.durability:=transient_local", "give volatile"),
        ("contact", f"{WRENCHES}.reliability:=perhaps", "give reliability and durability as words"),
        ("contact", f"{WRENCHES}.reliability:=best_available", "reliable or best_effort"),
        ("contact", f"{WRENCHES}.deadline:=1000000", "at least 2000000 ns"),
        ("contact", f"{WRENCHES}.deadline:=-1", "at least 2000000 ns"),
        ("contact", f"{WRENCHES}.depth:=many", "whole numbers"),
        ("contact", "qos_overrides./contact_state.publisher.depth:=0", "depth: give 1 to 1000"),
        (
            "vademecum_loader",
            "qos_overrides./vademecum.publisher.reliability:=best_effort",
            "needs all of it; give reliable",
        ),
        (
            "vademecum_loader",
            "qos_overrides./rest_surface.publisher.deadline:=1000000000",
            "on demand",
        ),
    ],
)
def test_what_would_harm_is_refused_in_one_line(
    own_domain: dict[str, str], node: str, value: str, reason: str
) -> None:
    said = refusal(node, value)
    assert reason in said and "\n" not in said
    assert f"parameter {value.split(':=')[0].rsplit('.', 1)[0]}" in said


LISTEN = """
import rclpy
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import PointCloud2
rclpy.init()
node = rclpy.create_node("sleeper", enable_rosout=False)
first = []
node.create_subscription(WrenchStamped, "tool/servo_cf", first.append, 1)
node.create_subscription(PointCloud2, "deformation", lambda _: None, 1)
while not first:
    rclpy.spin_once(node)
print("heard", flush=True)
rclpy.spin(node)
"""


@pytest.mark.long
def test_reliable_subscribers_that_stand_still_do_not_hold_up_the_loop(
    own_domain: dict[str, str], library: Any, probe: Any
) -> None:
    reliable = "qos_overrides./deformation.publisher.reliability:=reliable"
    with running_cell(own_domain, library, reliable):
        probe.next(ContactState, "contact_state", qos.state(1), lambda state: state.vademecum_id)
        sleeper = subprocess.Popen(
            [sys.executable, "-c", LISTEN],
            cwd="/",
            env=own_domain,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert sleeper.stdout is not None and sleeper.stdout.readline() == "heard\n"
        awake = probe.next(LoopStatistics, "statistics", qos.STATISTICS)
        os.kill(sleeper.pid, signal.SIGSTOP)
        stopped = time.monotonic()
        while time.monotonic() < stopped + 3.0:
            asleep = probe.next(LoopStatistics, "statistics", qos.STATISTICS)
        sleeper.kill()
        sleeper.wait()
    print(
        f"\nstep with wrench, two reliable subscribers: p50 {1e6 * awake.compute_p50:.0f} us, p99 "
        f"{1e6 * awake.compute_p99:.0f} us, {awake.rate:.0f} Hz; while they stand still "
        f"{1e6 * asleep.compute_p50:.0f} us, {1e6 * asleep.compute_p99:.0f} us, "
        f"{asleep.rate:.0f} Hz"
    )
    # distinguishes a loop that goes on from one that waits for each of them for 0.1 s
    assert asleep.rate > 0.5 * awake.rate
    assert asleep.compute_p99 < 0.05 * slowness()


# --- One contact node for the tests of its defaults, then one for the tests of its overrides ------
# each runs until the other's turn: a test that starts its own comes before


@pytest.fixture(scope="module")
def contact(request: pytest.FixtureRequest, own_domain: dict[str, str]) -> Iterator[Module]:
    with running("contact", own_domain, *request.param) as process:
        yield process


DEFAULTS: tuple[str, ...] = ()
OVERRIDES = (
    f"{WRENCHES}.reliability:=best_effort",
    f"{WRENCHES}.deadline:=50000000",
    f"{POSES}.deadline:=20000000",
)
by_default = pytest.mark.parametrize("contact", [DEFAULTS], indirect=True, ids=["defaults"])
overridden = pytest.mark.parametrize("contact", [OVERRIDES], indirect=True, ids=["overrides"])


@overridden
def test_an_override_is_what_others_see(contact: Module, probe: Any) -> None:
    topic = "/tool/servo_cf"
    probe.until(lambda: bool(probe.node.get_publishers_info_by_topic(topic)), 60.0)
    (end,) = probe.node.get_publishers_info_by_topic(topic)
    assert end.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert end.qos_profile.deadline == Duration(nanoseconds=50_000_000)
    probe.next(WrenchStamped, topic, qos.NEWEST)


@by_default
def test_a_driver_learns_by_its_deadline_that_the_wrenches_ended(
    contact: Module, probe: Any
) -> None:
    missed: list[Any] = []
    heard: list[Any] = []
    asked = QoSProfile(
        depth=1, reliability=ReliabilityPolicy.RELIABLE, deadline=Duration(seconds=0.2)
    )
    probe.node.create_subscription(
        WrenchStamped,
        "tool/servo_cf",
        heard.append,
        asked,
        event_callbacks=SubscriptionEventCallbacks(deadline=missed.append),
    )
    probe.until(lambda: len(heard) > 100, 60.0)  # it matches: a deadline as short is offered
    contact.send_signal(signal.SIGSTOP)
    missed.clear()
    try:
        probe.until(lambda: bool(missed), 5.0)
    finally:
        contact.send_signal(signal.SIGCONT)


@overridden
def test_a_driver_that_does_not_match_is_named(contact: Module, probe: Any) -> None:
    """A deadline that it does not offer shuts it out, from the request on."""
    topic = "tool/measured_cp"
    assert diagnosis(probe, lambda status: True).level == DiagnosticStatus.OK
    publisher = probe.node.create_publisher(PoseStamped, topic, qos.NEWEST)
    said = diagnosis(probe, lambda status: status.level == DiagnosticStatus.WARN)
    assert "/tool/measured_cp: not matched with probe" in said.message
    assert "deadline" in said.message.lower()
    assert "/tool/measured_cp: probe is not heard here" in contact.said()
    assert f"{POSES}.*" in contact.said()
    assert contact.said().count("is not heard here") == 1
    probe.node.destroy_publisher(publisher)
    diagnosis(probe, lambda status: status.level == DiagnosticStatus.OK)


@by_default
def test_a_listener_that_does_not_match_is_named_alone_while_it_is_there(
    contact: Module, probe: Any
) -> None:
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    probe.node.create_subscription(WrenchStamped, "tool/servo_cf", lambda _: None, RELIABLE)
    with closing(Probe()) as other:
        other.node.create_subscription(WrenchStamped, "tool/servo_cf", lambda _: None, late)
        said = diagnosis(probe, lambda status: status.level == DiagnosticStatus.WARN)
        assert said.message.count("not matched") == 1
        assert "transient local" in said.message and "liveliness" not in said.message
    diagnosis(probe, lambda status: status.level == DiagnosticStatus.OK)


@by_default
def test_a_viewer_that_does_not_match_is_named(contact: Module, probe: Any) -> None:
    from sensor_msgs.msg import PointCloud2

    probe.next(ContactState, "contact_state", qos.state(1))
    probe.node.create_subscription(PointCloud2, "deformation", lambda _: None, RELIABLE)
    said = diagnosis(probe, lambda status: status.level == DiagnosticStatus.WARN)
    assert "/deformation: not matched with probe" in said.message
    assert "deadline" not in said.message.lower()
    assert "qos_overrides./deformation.publisher.reliability" in contact.said()
