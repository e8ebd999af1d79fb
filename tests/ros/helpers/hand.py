"""A tool that publishes one pose from the test's own process, and the force on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped

from avatar_interfaces.msg import ContactState
from avatar_ros.framework import qos


class Hand:
    """Publisher of one pose again and again, each time with a new stamp; one per node."""

    def __init__(self, probe: Any, position: np.ndarray, frame: str = "organ") -> None:
        node = probe.node
        self._clock = node.get_clock()
        for before in [p for p in node.publishers if p.topic == "/tool/measured_cp"]:
            node.destroy_publisher(before)
        self._publisher = node.create_publisher(PoseStamped, "/tool/measured_cp", qos.NEWEST)
        self.pose = PoseStamped()
        self.pose.header.frame_id = frame
        self.pose.pose.orientation.w = 1.0
        p = self.pose.pose.position
        p.x, p.y, p.z = (float(x) for x in position)
        self.stamps: set[tuple[int, int]] = set()

    def __call__(self) -> None:
        self.pose.header.stamp = self._clock.now().to_msg()
        self.stamps.add(stamp_of(self.pose))
        self._publisher.publish(self.pose)


def stamp_of(message: Any) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


def force_of(wrench: WrenchStamped) -> np.ndarray:
    force = wrench.wrench.force
    return np.array([force.x, force.y, force.z])


def wait_for_model(cell: Any, probe: Any) -> None:
    assert all(process.poll() is None for process in cell.values())
    probe.next(ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id)


def felt(probe: Any, hand: Hand, timeout: float = 60.0) -> tuple[ContactState, np.ndarray]:
    """Return state and wrench of a tool in contact once its force is engaged."""
    wrenches: dict[tuple[int, int], np.ndarray] = {}
    listener = probe.node.create_subscription(
        WrenchStamped,
        "tool/servo_cf",
        lambda w: wrenches.update({stamp_of(w): force_of(w)}),
        qos.COMMAND,
    )
    engaged: list[tuple[int, int]] = []

    def complete(s: ContactState) -> bool:
        """Exclude the first pose: its wrench may have been sent before the force was engaged."""
        if s.status != ContactState.STATUS_OK or not s.contacts:
            return False
        engaged.append(stamp_of(s))
        return engaged[-1] != engaged[0] and engaged[-1] in wrenches

    state = probe.next(ContactState, "contact_state", qos.state(1), complete, timeout, hand)
    probe.node.destroy_subscription(listener)
    return state, wrenches[stamp_of(state)]
