"""Drives the tool of the planning page: 1,000 poses a second towards the target of the mouse.

It is a process of its own, because the page is served in bursts. It reads every state that the
contact node answers, and on request records it with the pose that the step used.

Run as ``python -m avatar_ros.ui.tool_driver TOOL FRAME`` by ``planning_ui``, never by hand; the
shared memory comes as standard input.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions

from avatar_ros.framework import qos, realtime
from avatar_ros.framework.ports import PolledSubscriptions
from avatar_ros.framework.stop_signal import StopSignal
from avatar_ros.framework.templates import PoseTemplate, stamp_bytes
from avatar_ros.loop.tool_channel import FAR_AWAY
from avatar_ros.msg import ContactState
from avatar_ros.ui.tool_state import N_RECENT, N_ROWS, SharedToolState, organ_number

PERIOD = 1_000_000  # [ns]
_APPROACH = 0.04  # part of the remaining distance moved in a period: lags the mouse by 25 ms
_MAX_STEP = 0.5e-3  # in a period [m]
_N_SENT = 4096  # recent poses, one of which a state answers
_LATE = 20 * PERIOD  # delay from which missed poses are skipped
# With these, the step used the pose of the stamp; with INVALID_POSE none; with others FAR_AWAY.
_PLACED = frozenset(
    int(status)
    for status in (
        ContactState.STATUS_OK,
        ContactState.STATUS_NOT_CONVERGED,
        ContactState.STATUS_TOO_MANY_CONTACTS,
        ContactState.STATUS_OUT_OF_RANGE,
        ContactState.STATUS_EXTRAPOLATED,
        ContactState.STATUS_ENGAGING,
        ContactState.STATUS_NO_OPERATING_STATE,
        ContactState.STATUS_NOT_ENABLED,
        ContactState.STATUS_NOT_HOMED,
    )
)
# Deeper than the publisher's queue: a recording that lost a period cannot be replayed.
_STATES = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)


class ToolDriver:
    """Publishes the tool's poses and reads the answers."""

    def __init__(self, node: Any, tool: str, frame_id: str, state: SharedToolState) -> None:
        self._tool = tool
        self._live, self._recent, self._rows = state.live, state.recent, state.rows
        self._publisher = node.create_publisher(PoseStamped, f"{tool}/measured_cp", qos.NEWEST)
        self._states = node.create_subscription(
            ContactState,
            "contact_state",
            lambda _: None,
            _STATES,
            callback_group=PolledSubscriptions(),
            raw=True,
        )
        self._pose = PoseTemplate(frame_id)
        self._tip = self._live["target"][0].copy()
        self._sent = np.full((_N_SENT, 3), np.nan)
        self._first = 0  # stamp of pose 0 [ns]

    def run(self, stop: StopSignal) -> None:
        """Run until the signal comes."""
        offset = time.time_ns() - time.monotonic_ns()
        tick = time.monotonic_ns() + PERIOD
        self._first = tick + offset
        while not stop:
            realtime.sleep_until(tick)
            self._move()
            number = (tick + offset - self._first) // PERIOD
            self._sent[number % _N_SENT] = self._tip
            self._pose.position[:] = self._tip
            self._publisher.handle.publish_raw(self._pose.serialise(stamp_bytes(tick + offset)))
            self._live["tip"][0] = self._tip
            self._live["n_poses"][0] += 1
            while (taken := self._states.handle.take_message(ContactState, True)) is not None:
                self._read(deserialize_message(taken[0], ContactState), taken[1])
            behind = time.monotonic_ns() - tick
            tick += PERIOD * (1 + (behind // PERIOD if behind > _LATE else 0))

    def _move(self) -> None:
        way = self._live["target"][0] - self._tip
        step = _APPROACH * way
        length = float(np.sqrt(step @ step))
        self._tip += step if length <= _MAX_STEP else step * (_MAX_STEP / length)

    def _read(self, state: Any, info: Any) -> None:
        if state.tool != self._tool:
            return
        live = self._live
        force = np.zeros(3)
        for contact in state.contacts:
            force += (contact.force.x, contact.force.y, contact.force.z)
        live["force"][0] = force
        live["error"][0], live["sent_fraction"][0] = state.force_error, state.force_share
        live["status"][0], live["touches"][0] = state.status, len(state.contacts)
        live["heard"][0] = time.monotonic_ns()
        live["n_states"][0] += 1
        stamp = state.header.stamp.sec * 1_000_000_000 + state.header.stamp.nanosec
        recent = int(live["n_recent"][0])
        row = self._recent[recent % N_RECENT]
        row["stamp"] = 0  # until it is whole
        row["number"], row["touches"] = info["publication_sequence_number"], len(state.contacts)
        row["tip"] = self._used(state.status, stamp)
        row["force"], row["error"] = force, state.force_error
        row["sent_fraction"], row["status"] = state.force_share, state.status
        row["organ"] = organ_number(state.vademecum_id)
        row["stamp"] = stamp
        live["n_recent"][0] = recent + 1
        n = int(live["n_rows"][0])
        if live["recording"][0] and n < N_ROWS:
            self._rows[n] = row
            live["n_rows"][0] = n + 1

    def _used(self, status: int, stamp: int) -> Any:
        """Position of the tip that the step used [m]."""
        if status == ContactState.STATUS_INVALID_POSE:
            return np.nan
        if status not in _PLACED:
            return FAR_AWAY
        return self._sent[(stamp - self._first) // PERIOD % _N_SENT]


def main() -> int:
    tool, frame = sys.argv[1:3]
    stop = StopSignal()
    state = SharedToolState(sys.stdin.fileno())
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(
        "_planning_ui_hand", enable_rosout=False, start_parameter_services=False
    )
    try:
        driver = ToolDriver(node, tool, frame, state)
        realtime.bind_thread(-1)
        realtime.tune_interpreter()
        driver.run(stop)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
