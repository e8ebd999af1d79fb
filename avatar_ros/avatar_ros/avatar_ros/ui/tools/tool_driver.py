"""Driver of the planning page's tools: 1,000 poses a second, each towards its own target.

It runs in a separate process, because the page is served in bursts. It reads every state that the
contact node answers, and on request records it with the pose that the step used.

Run as ``python -m avatar_ros.ui.tools.tool_driver FRAME ALL TOOL ...`` by ``planning_ui``, never by
hand. ALL are the names of the contact node's tools, with commas. The other names are those to be
moved, in the same order. The shared memory comes as standard input.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_rmw_implementation_identifier
from sensor_msgs.msg import JointState

from avatar_core.contact.status import FAR_AWAY, PLACED
from avatar_interfaces.msg import ContactState
from avatar_ros.framework import discovery, qos, realtime
from avatar_ros.framework.ports import PolledSubscriptions
from avatar_ros.framework.stop_signal import StopSignal
from avatar_ros.framework.templates import PoseTemplate, stamp_bytes
from avatar_ros.ui.tools.tool_state import N_RECENT, N_ROWS, ROW, SharedToolState, organ_number

PERIOD = 1_000_000  # [ns]
_APPROACH = 0.04  # fraction of the remaining distance moved in a period: lags the mouse by 25 ms
_MAX_STEP = 0.5e-3  # largest way in a period [m]
_N_SENT = 4096  # recent poses of each tool, one of which a state answers
_LATE = 20 * PERIOD  # delay from which missed poses are skipped
# deeper than the publisher's queue, for each tool: a recording with lost periods is no path
_N_STATES = 200
_JAW_EVERY = 20  # periods between messages of the jaw, besides each change
_OPEN = 0.5  # position of an open jaw [rad]


class ToolDriver:
    """Publishes the poses of tools and reads the answers."""

    def __init__(
        self,
        node: Any,
        tools: Sequence[str],
        all_tools: Sequence[str],
        frame_id: str,
        state: SharedToolState,
    ) -> None:
        self._all, self._each = state.all, state.each
        self._publishers = [
            node.create_publisher(PoseStamped, f"{tool}/measured_cp", qos.NEWEST) for tool in tools
        ]
        self._jaws = [
            node.create_publisher(JointState, f"{tool}/jaw/measured_js", qos.NEWEST)
            for tool in tools
        ]
        self._shut = self._each["shut"].copy()
        self._states = node.create_subscription(
            ContactState,
            "contact_state",
            lambda _: None,
            QoSProfile(depth=_N_STATES * len(all_tools), reliability=ReliabilityPolicy.RELIABLE),
            callback_group=PolledSubscriptions(),
            raw=True,
        )
        self._pose = PoseTemplate(frame_id)
        self._tips = self._each["target"].copy()
        self._sent = np.full((_N_SENT, len(tools), 3), np.nan)
        self._first = 0  # stamp of pose 0 [ns]
        self._periods = PeriodCollector(tools, all_tools, state, self._used)

    def run(self, stop: StopSignal) -> None:
        """Run until a signal comes."""
        offset = time.time_ns() - time.monotonic_ns()
        tick = time.monotonic_ns() + PERIOD
        self._first = tick + offset
        while not stop:
            realtime.sleep_until(tick)
            self._move()
            number = (tick + offset - self._first) // PERIOD
            self._sent[number % _N_SENT] = self._tips
            self._publish(stamp_bytes(tick + offset))
            self._work_jaws(number)
            self._each["tip"] = self._tips
            self._all["n_poses"] += 1
            while (taken := self._states.handle.take_message(ContactState, True)) is not None:
                message, info = taken
                number = info["publication_sequence_number"]
                self._periods.note(deserialize_message(message, ContactState), number)
            behind = time.monotonic_ns() - tick
            tick += PERIOD * (1 + (behind // PERIOD if behind > _LATE else 0))

    def _move(self) -> None:
        steps = _APPROACH * (self._each["target"] - self._tips)
        lengths = np.sqrt((steps * steps).sum(axis=1, keepdims=True))
        self._tips += steps * (_MAX_STEP / np.maximum(lengths, _MAX_STEP))

    def _publish(self, stamp: bytes) -> None:
        """Publish one pose of each tool, close together: the contact loop wakes at the first."""
        messages = []
        for tip in self._tips:
            self._pose.position[:] = tip
            messages.append(self._pose.serialise(stamp))
        for publisher, message in zip(self._publishers, messages, strict=True):
            publisher.handle.publish_raw(message)

    def _work_jaws(self, number: int) -> None:
        """Publish now and then, and at each change, whether each jaw is closed."""
        for tool, publisher in enumerate(self._jaws):
            shut = int(self._each["shut"][tool])
            if shut == self._shut[tool] and number % _JAW_EVERY:
                continue
            self._shut[tool] = shut
            publisher.publish(JointState(name=["jaw"], position=[0.0 if shut else _OPEN]))

    def _used(self, tool: int, status: int, stamp: int) -> Any:
        """Return the position of a tip that the step used [m]."""
        if status == ContactState.STATUS_INVALID_POSE:
            return np.nan
        if status not in PLACED:
            return FAR_AWAY
        return self._sent[(stamp - self._first) // PERIOD % _N_SENT, tool]


class PeriodCollector:
    """Collects the states of the tools of a period, and writes it once it is complete.

    The contact node sends the states of a step in the order of all its tools, from one publisher.
    The publisher's count therefore tells which states belong to one step. The poses that they
    answer
    may belong to two, because one may have come too late for its step.

    used : returns the tip that a step used [m], for a tool, a status and a stamp [ns]
    """

    def __init__(
        self,
        tools: Sequence[str],
        all_tools: Sequence[str],
        state: SharedToolState,
        used: Callable[[int, int, int], Any],
    ) -> None:
        self._places = {tool: (k, all_tools.index(tool)) for k, tool in enumerate(tools)}
        self._n_all = len(all_tools)
        self._all, self._recent, self._rows = state.all, state.recent, state.rows
        self._used = used
        self._period = np.zeros(len(tools), ROW)
        self._first = -1  # count at the first state of the period that is collected
        self._n_missing = 0

    def note(self, state: Any, number: int) -> None:
        """Note a state with its publisher's sequence number."""
        if state.tool not in self._places:
            return
        tool, before = self._places[state.tool]
        if number - before != self._first:  # another step; missing states of the last one are lost
            self._first, self._n_missing = number - before, len(self._places)
        self._read(tool, state)
        self._n_missing -= 1
        if self._n_missing == 0:
            self._period["number"] = self._first // self._n_all
            self._write()

    def _read(self, tool: int, state: Any) -> None:
        row, force = self._period[tool], np.zeros(3)
        for contact in state.contacts:
            force += (contact.force.x, contact.force.y, contact.force.z)
        stamp = state.header.stamp.sec * 1_000_000_000 + state.header.stamp.nanosec
        row["stamp"], row["tip"] = stamp, self._used(tool, state.status, stamp)
        row["force"], row["error"] = force, state.force_error
        row["sent_fraction"], row["status"] = state.force_share, state.status
        row["touches"], row["held"] = len(state.contacts), state.held
        row["organ"] = organ_number(state.vademecum_id)

    def _write(self) -> None:
        period, everything = self._period, self._all
        n = int(everything["n_recent"][0])
        place = self._recent[:, n % N_RECENT]
        place["stamp"] = 0  # until all of it is there
        for name in ROW.names or ():
            if name != "stamp":
                place[name] = period[name]
        place["stamp"] = period["stamp"]
        everything["n_recent"] = n + 1
        everything["heard"] = time.monotonic_ns()
        n = int(everything["n_rows"][0])
        if everything["recording"][0] and n < N_ROWS:
            self._rows[:, n] = period
            everything["n_rows"] = n + 1


def main() -> int:
    """Drive the tools as the command line asks; return the exit code."""
    frame, names, *tools = sys.argv[1:]
    stop = StopSignal()
    state = SharedToolState(sys.stdin.fileno(), len(tools))
    with discovery.udp_alone(get_rmw_implementation_identifier()):
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node(
            "_planning_ui_hand", enable_rosout=False, start_parameter_services=False
        )
    try:
        driver = ToolDriver(node, tools, names.split(","), frame, state)
        realtime.bind_thread(-1)
        realtime.tune_interpreter()
        driver.run(stop)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
