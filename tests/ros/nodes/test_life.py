"""Start, transitions and end of the nodes' processes."""

from __future__ import annotations

import signal
from typing import Any

import pytest
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.framework.conversions import vademecum_file
from geometry_msgs.msg import WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

from avatar_ros.msg import ContactState, LoopStatistics, VademecumFile
from tests.helpers.slowness import end_of
from tests.ros.helpers.refusals import refusal

NODES = ("vademecum_loader", "contact")


def _state(probe: Any, node: str) -> str:
    return str(probe.ask(GetState, f"{node}/get_state", GetState.Request()).current_state.label)


def _change(probe: Any, node: str, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(probe.call(ChangeState, f"{node}/change_state", request).success)


def _is_silent(probe: Any, kind: type, topic: str, seconds: float = 0.5) -> bool:
    heard: list[Any] = []
    subscription = probe.node.create_subscription(kind, topic, heard.append, qos.COMMAND)
    probe.spin(seconds)
    probe.node.destroy_subscription(subscription)
    return not heard


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_a_signal_ends_a_node_cleanly(own_domain: dict[str, str], probe: Any, number: int) -> None:
    processes = {node: Module(node, [], own_domain) for node in NODES}
    try:
        probe.until(lambda: False, 1.0, fail=False)
        for node, process in processes.items():
            assert _state(probe, node) == "active"
            process.send_signal(number)
            assert end_of(process, 2.0) == 0
            assert "rror" not in process.said()
    finally:
        for process in processes.values():
            process.kill()


def test_without_vademecum_the_wrench_is_zero_and_a_broken_one_changes_nothing(
    own_domain: dict[str, str], probe: Any
) -> None:
    process = Module("contact", [], own_domain)
    try:
        state = probe.next(ContactState, "contact_state", qos.state(1))
        assert state.status == ContactState.STATUS_NO_MODEL
        assert (state.vademecum_id, list(state.contacts)) == ("", [])
        wrench = probe.next(WrenchStamped, "tool/servo_cf", qos.COMMAND)
        assert wrench == WrenchStamped(header=wrench.header)
        assert wrench.header.frame_id == "organ"
        assert (wrench.header.stamp.sec, wrench.header.stamp.nanosec) == (0, 0)
        window = probe.next(LoopStatistics, "statistics", 1)
        assert 0.0 < window.rate < 250.0  # there is no force to be late
        publisher = probe.node.create_publisher(VademecumFile, "vademecum", qos.LATCHED)
        publisher.publish(vademecum_file("0" * 64, "forged", b"x" * 1000))
        probe.until(lambda: "'forged' refused" in process.said(), 30.0)
        state = probe.next(ContactState, "contact_state", qos.state(1))
        assert state.status == ContactState.STATUS_NO_MODEL
    finally:
        assert process.finish() == 0


@pytest.mark.long  # their step is compiled
def test_two_tools_have_topics_of_their_own(own_domain: dict[str, str], probe: Any) -> None:
    arguments = ["-p", "tools:=[left,right]", "-p", "tip.radius:=[0.004,0.008]"]
    arguments += ["-p", "tip.shape:=[sphere,cone]", "-p", "tip.half_angle:=[0.0,60.0]"]
    process = Module("contact", ["--ros-args", *arguments], own_domain)
    try:
        for tool in ("left", "right"):
            probe.next(WrenchStamped, f"{tool}/servo_cf", qos.COMMAND)
            probe.next(ContactState, "contact_state", qos.state(2), lambda s, t=tool: s.tool == t)
    finally:
        assert process.finish() == 0


def test_the_contact_node_is_managed(own_domain: dict[str, str], probe: Any) -> None:
    process = Module("contact", ["--ros-args", "-p", "autostart:=false"], own_domain)
    topic = "tool/servo_cf"
    try:
        assert _state(probe, "contact") == "unconfigured"
        for _ in range(2):  # once more after cleaning up
            assert _change(probe, "contact", Transition.TRANSITION_CONFIGURE)
            assert _change(probe, "contact", Transition.TRANSITION_ACTIVATE)
            probe.next(WrenchStamped, topic, qos.COMMAND)
            assert _change(probe, "contact", Transition.TRANSITION_DEACTIVATE)
            assert _is_silent(probe, WrenchStamped, topic)
            assert _change(probe, "contact", Transition.TRANSITION_CLEANUP)
            assert _state(probe, "contact") == "unconfigured"
            probe.until(lambda: probe.node.count_publishers(topic) == 0, 5.0)
    finally:
        assert process.finish() == 0


WRONG = [
    ("contact", ["rate:=5.0"], "from 100 to 2000"),
    ("contact", ["rate:=fast"], "rate"),
    ("contact", ["tools:=[a b]"], "topic's name"),
    ("contact", ["cloud:=fog"], "surface, volume, off"),
    ("contact", ["frame_id:=''"], "frame_id"),
    ("contact", ["scene:=nowhere"], "come with avatar: breathing"),
    ("contact", ["scene:=/nowhere.yaml"], "No such file"),
    ("contact", ["scene:=two_tools"], "set the parameter tools"),
    ("vademecum_loader", ["library_dir:=/nowhere"], "not a directory"),
    ("vademecum_loader", ["vademecum:=missing.h5"], "No such file"),
    ("vademecum_loader", ["max_megabytes:=0"], "from 1 to 65536"),
    ("contact", ["tip.radius:=0.5"], "tip.*: tip: radius is 0.5; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=0.0"], "radius is 0.0; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=.nan"], "radius is nan; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=true"], "radius is True; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=wide"], "radius is wide; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=[0.005,0.005]"], "tip.radius: there are 2 values; give one"),
    ("contact", ["tip.shape:=ball"], "shape 'ball' is unknown; choose sphere, flat, cone"),
    ("contact", ["tip.shape:=3"], "shape '3' is unknown; choose sphere, flat, cone"),
    ("contact", ["tip.shape:=cone"], "cone needs half_angle; give one"),
    ("contact", ["tip.shape:=cone", "tip.half_angle:=90.0"], "must lie in 10 to 85 deg"),
    ("contact", ["tip.shape:=cone", "tip.half_angle:=.nan"], "must lie in 10 to 85 deg"),
    ("contact", ["tip.shape:=flat", "tip.half_angle:=60.0"], "does not use half_angle; leave it"),
    ("contact", ["tip.rounding:=0.001"], "sphere does not use rounding; leave it out"),
]


@pytest.mark.parametrize(("node", "arguments", "reason"), WRONG)
def test_a_wrong_parameter_is_refused(
    own_domain: dict[str, str], node: str, arguments: list[str], reason: str
) -> None:
    said = refusal(node, *arguments)
    assert reason in said and "\n" not in said


# refused when it is declared, and when the node is configured
@pytest.mark.parametrize(("node", "arguments", "reason"), [WRONG[0], WRONG[5], WRONG[9]])
def test_a_wrong_parameter_ends_the_node(
    own_domain: dict[str, str], node: str, arguments: list[str], reason: str
) -> None:
    options = [word for argument in arguments for word in ("-p", argument)]
    process = Module(node, ["--ros-args", *options], own_domain)
    assert end_of(process, 60.0) == 1
    assert reason in process.last_line()
