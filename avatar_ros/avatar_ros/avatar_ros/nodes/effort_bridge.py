"""Forces of a tool as effort commands of ros2_control, for devices with Cartesian effort axes.

A driver such as forcedimension_ros2 has one effort interface per Cartesian axis of the device's
base. Its controller takes them in one message, x y z, then roll pitch yaw, then the gripper. A
device whose joints are no Cartesian axes needs its Jacobian, which only its driver knows.
"""

from __future__ import annotations

import math
import time
from typing import Any

from geometry_msgs.msg import WrenchStamped
from rclpy.duration import Duration
from std_msgs.msg import Float64MultiArray

from avatar_ros.framework import qos
from avatar_ros.framework.managed_node import ManagedNode, run
from avatar_ros.framework.parameters import AUTOSTART, Parameter

_REPEATED = 1.0  # time for which no effort is sent again [s]
_ARRIVED = Duration(seconds=0.5)  # most time for the last command to arrive

EFFORT_BRIDGE = (
    AUTOSTART,
    Parameter(
        "axes",
        3,
        "number of joints of the controller: 3 forces, 6 with torques; more get 0",
        range=(3, 8),
    ),
    Parameter(
        "timeout",
        0.02,
        "age of the last wrench above which the effort is 0 [s]",
        range=(0.002, 1.0),
    ),
)


class EffortBridge(ManagedNode):
    """Subscribes ``tool/servo_cf``; publishes ``commands``."""

    def __init__(self) -> None:
        self._commands: Any = None
        self._wrenches: Any = None
        self._timer: Any = None
        self._heard = 0.0  # time of the last wrench; 0: no more zeros are sent [s]
        super().__init__("effort_bridge", EFFORT_BRIDGE)

    def configure(self) -> None:
        """Make the publisher."""
        self._commands = self.create_publisher(Float64MultiArray, "commands", qos.COMMAND)

    def activate(self) -> None:
        """Clear what an earlier bridge left, pass on wrenches, and watch whether they come."""
        self._heard = time.monotonic()
        self._send([])
        self._wrenches = self.create_subscription(
            WrenchStamped, "tool/servo_cf", self._take, qos.NEWEST
        )
        self._timer = self.create_timer(self.get_parameter("timeout").value / 2, self._watch)

    def deactivate(self) -> None:
        """Send no effort, since a controller keeps its last command."""
        if self._wrenches is not None:
            self.destroy_subscription(self._wrenches)
            self.destroy_timer(self._timer)
            self._wrenches = self._timer = None
            self._send([])
            self._commands.wait_for_all_acked(_ARRIVED)  # else it may end with the node

    def clean_up(self) -> None:
        """Remove the publisher."""
        self.destroy_publisher(self._commands)
        self._commands = None

    def _take(self, message: WrenchStamped) -> None:
        force, torque = message.wrench.force, message.wrench.torque
        efforts = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
        self._heard = time.monotonic()
        self._send(efforts if all(map(math.isfinite, efforts)) else [])

    def _watch(self) -> None:
        """Send zeros for a second once wrenches have ceased: one message may be lost."""
        silent = time.monotonic() - self._heard
        if self._heard and silent > self.get_parameter("timeout").value:
            self._send([])
            if silent > self.get_parameter("timeout").value + _REPEATED:
                self._heard = 0.0

    def _send(self, efforts: list[float]) -> None:
        n = self.get_parameter("axes").value
        self._commands.publish(Float64MultiArray(data=[*efforts, *[0.0] * n][:n]))


def main() -> int:
    """Run the node; return the exit code."""
    return run(EffortBridge)


if __name__ == "__main__":
    raise SystemExit(main())
