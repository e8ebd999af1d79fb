"""Wrenches of a tool arrive as commands of an effort controller, and cease with it."""

from __future__ import annotations

from typing import Any

import pytest
from geometry_msgs.msg import WrenchStamped
from std_msgs.msg import Float64MultiArray

from avatar_ros.framework import qos
from avatar_ros.nodes.effort_bridge import EFFORT_BRIDGE
from tests.ros.helpers.doc_pages import parameter_rows, yaml_parameters
from tests.ros.helpers.running import running


@pytest.mark.parametrize(
    ("axes", "efforts"), [(3, [1.0, 2.0, 3.0]), (7, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0])]
)
def test_a_wrench_arrives_and_ends_with_its_sender(
    own_domain: dict[str, str], probe: Any, axes: int, efforts: list[float]
) -> None:
    message = WrenchStamped()
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z = 1.0, 2.0, 3.0
    torque.x, torque.y, torque.z = 4.0, 5.0, 6.0
    wrenches = probe.node.create_publisher(WrenchStamped, "tool/servo_cf", qos.COMMAND)
    heard: list[list[float]] = []
    probe.node.create_subscription(
        Float64MultiArray, "commands", lambda one: heard.append(list(one.data)), qos.COMMAND
    )
    with running("effort_bridge", own_domain, f"axes:={axes}"):
        probe.next(
            Float64MultiArray, "commands", qos.COMMAND, meanwhile=lambda: wrenches.publish(message)
        )
        probe.until(lambda: heard[-3:] == [[0.0] * axes] * 3, 10.0)  # none comes any more
        assert efforts in heard and all(one in (efforts, [0.0] * axes) for one in heard)


def test_it_clears_what_an_earlier_bridge_left_and_passes_on_numbers_only(
    own_domain: dict[str, str], probe: Any
) -> None:
    message = WrenchStamped()
    message.wrench.force.x, message.wrench.force.y = float("nan"), 1.0
    heard: list[list[float]] = []
    probe.node.create_subscription(
        Float64MultiArray, "commands", lambda one: heard.append(list(one.data)), qos.COMMAND
    )
    with running("effort_bridge", own_domain):
        probe.until(lambda: bool(heard), 20.0)
        wrenches = probe.node.create_publisher(WrenchStamped, "tool/servo_cf", qos.COMMAND)
        probe.until(lambda: wrenches.get_subscription_count() > 0, 10.0)
        for _ in range(20):
            wrenches.publish(message)
            probe.spin(0.01)
    assert len(heard) > 20 and all(one == [0.0] * 3 for one in heard)


def test_it_sends_zero_when_it_ends(own_domain: dict[str, str], probe: Any) -> None:
    message = WrenchStamped()
    message.wrench.force.z = 3.0
    wrenches = probe.node.create_publisher(WrenchStamped, "tool/servo_cf", qos.COMMAND)
    heard: list[list[float]] = []
    probe.node.create_subscription(
        Float64MultiArray, "commands", lambda one: heard.append(list(one.data)), qos.COMMAND
    )
    with running("effort_bridge", own_domain, "timeout:=1.0"):
        probe.next(
            Float64MultiArray, "commands", qos.COMMAND, meanwhile=lambda: wrenches.publish(message)
        )
    probe.until(lambda: heard[-1:] == [[0.0] * 3], 10.0)


def test_page_and_file_hold_every_parameter_at_its_default() -> None:
    defaults = {p.name: p.default for p in EFFORT_BRIDGE}
    assert set(parameter_rows("effort_bridge")) == set(defaults)
    assert yaml_parameters("effort_bridge") == defaults
