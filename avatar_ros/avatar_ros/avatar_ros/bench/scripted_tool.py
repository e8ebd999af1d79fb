"""A tool that palpates on its own: approaches the organ, pushes, slides, and times the answers.

Run as ``python -m avatar_ros.bench.scripted_tool FILE.h5``; poses and answers go into an ``.npz``
file.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from avatar_core.contact import tool_path
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum
from avatar_interfaces.msg import ContactState
from avatar_ros.framework import qos, realtime
from avatar_ros.framework.stop_signal import StopSignal
from avatar_ros.framework.templates import PoseTemplate, WrenchReader, stamp_bytes

READY = "palpating"  # printed when the measured part begins
_CLEARANCE = 0.020  # height over the surface before and after a touch [m]
_SLIDE = 0.040  # [m]
_SLIDE_DEPTH = 0.003  # [m]
_PUSHES = 2  # pushes in a touch
_TOUCH = 4.0  # duration of a touch: approach, push, slide, leave [s]
_HEADINGS = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))  # directions of the slides, in turn
_WAKE_MARGIN = 150_000  # time before a tick at which the tool stops listening [ns]
_SETTLE = 1.0  # time of poses sent before the measured part [s]


@dataclass(frozen=True)
class RoundTrips:
    """The poses that a tool sent and the answers, one entry per pose.

    Attributes
    ----------
    tips : ndarray, shape (n, 3)
        Positions of the tip [m].
    forces : ndarray, shape (n, 3)
        Forces [N], NaN without an answer.
    latencies : ndarray, shape (n,)
        Time from publishing a pose to having its wrench [s], NaN without an answer.
    arrivals : ndarray, shape (m,)
        Arrival of every wrench on the monotonic clock [s].
    begin, end : float
        Limits of the measured part on the monotonic clock [s].
    """

    tips: np.ndarray
    forces: np.ndarray
    latencies: np.ndarray
    arrivals: np.ndarray
    begin: float
    end: float
    priority: int

    def save(self, path: Path) -> None:
        """Write all arrays to an ``.npz`` file."""
        np.savez(path, **vars(self))

    @staticmethod
    def load(path: Path) -> RoundTrips:
        """Read the arrays that :meth:`save` wrote."""
        with np.load(path) as held:
            values: dict[str, Any] = {name: held[name] for name in held.files}
        return RoundTrips(**values)


# --- The path of the tool --------------------------------------------------------------------


def palpation(
    vademecum: Vademecum, tip_radius: float, seconds: float, rate: float, depth: float = 0.005
) -> np.ndarray:
    """Return centres of a sphere, shape (seconds * rate, 3) [m]: touches of four seconds in a row.

    A touch moves along the surface normal to the organ and pushes twice by ``depth`` [m], as a
    sine.
    Then it slides 40 mm there and back at 3 mm depth, and leaves. Odd touches slide at right angles
    to even ones.
    """
    path = np.concatenate([_touch(vademecum, tip_radius, rate, depth, way) for way in _HEADINGS])
    return np.resize(path, (round(seconds * rate), 3))


def _touch(
    vademecum: Vademecum,
    tip_radius: float,
    rate: float,
    depth: float,
    heading: tuple[float, float, float],
) -> np.ndarray:
    """Return one touch, shape (_TOUCH * rate, 3) [m]."""
    phase = (np.arange(round(_TOUCH * rate)) + 0.5) / round(_TOUCH * rate)
    approach, push, slide, leave = (
        np.clip((phase - start) / length, 0.0, 1.0)
        for start, length in ((0.0, 0.15), (0.15, 0.35), (0.50, 0.35), (0.85, 0.15))
    )
    pushed = depth * np.sin(np.pi * _PUSHES * push) ** 2
    sunk = _SLIDE_DEPTH * np.clip(8.0 * np.minimum(slide, 1.0 - slide), 0.0, 1.0)
    clear = _CLEARANCE * (1.0 + _ease(leave) - _ease(approach))
    line = tool_path.slide(vademecum, tip_radius, _SLIDE_DEPTH, _SLIDE, heading=heading)
    station = np.sin(np.pi * slide) ** 2 * (len(line) - 1)
    on_line = np.column_stack([np.interp(station, np.arange(len(line)), x) for x in line.T])
    normal = vademecum.surface.normals[tool_path.middle_of_access(vademecum)]
    return on_line + (_SLIDE_DEPTH + clear - pushed - sunk)[:, None] * normal


def _ease(x: np.ndarray) -> np.ndarray:
    return x * x * (3.0 - 2.0 * x)


# --- The tool --------------------------------------------------------------------------------


class ScriptedTool:
    """Tool that publishes ``NAME/measured_cp`` on time and listens to ``NAME/servo_cf`` between."""

    def __init__(self, node: Node, name: str, frame_id: str, rate: float) -> None:
        self._node = node
        self._name = name
        self._period = round(1e9 / rate)
        self._publisher = node.create_publisher(PoseStamped, f"{name}/measured_cp", qos.NEWEST)
        self._subscription = node.create_subscription(
            WrenchStamped, f"{name}/servo_cf", lambda _: None, qos.COMMAND, raw=True
        )
        self._pose = PoseTemplate(frame_id)
        self._reader = WrenchReader(frame_id)
        self._wait_set = _rclpy.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def wait_for_model(self, timeout: float) -> None:
        """Wait until the contact node answers with a vademecum.

        Raises
        ------
        TimeoutError
            If no contact node has one in time.
        """
        loaded: list[str] = []

        def note(state: Any) -> None:
            loaded.extend([state.vademecum_id] if state.vademecum_id else [])

        topic_qos = qos.state(1)
        listener = self._node.create_subscription(ContactState, "contact_state", note, topic_qos)
        deadline = time.monotonic() + timeout
        while not loaded:
            if time.monotonic() > deadline:
                raise TimeoutError(f"no contact node with a vademecum within {timeout:g} s")
            rclpy.spin_once(self._node, timeout_sec=0.1)
        self._node.destroy_subscription(listener)

    def play(self, tips: np.ndarray, stop: StopSignal, priority: int = 0) -> RoundTrips:
        """Send one pose per period; return the poses with their answers."""
        n = len(tips)
        forces = np.full((n, 3), np.nan)
        latencies = np.full(n, np.nan)
        sent = np.full(n, 0)  # allocated now, not page by page in the loop
        arrivals = np.full(4 * n + 64, 0)
        n_arrivals = 0
        offset = time.time_ns() - time.monotonic_ns()
        first = time.monotonic_ns() + self._period
        with self._publisher.handle, self._subscription.handle, self._wait_set:
            for i in range(n):
                tick = first + i * self._period
                realtime.sleep_until(tick)
                if stop:
                    n = i
                    break
                self._pose.position[:] = tips[i]
                serialised = self._pose.serialise(stamp_bytes(tick + offset))
                sent[i] = time.monotonic_ns()
                self._publisher.handle.publish_raw(serialised)
                while (raw := self._listen(tick + self._period - _WAKE_MARGIN)) is not None:
                    now = time.monotonic_ns()
                    if n_arrivals < len(arrivals):
                        arrivals[n_arrivals] = now
                        n_arrivals += 1
                    stamp, force = self._reader.read(raw)
                    k = (stamp - offset - first) // self._period
                    if 0 <= k <= i and np.isnan(latencies[k]):
                        latencies[k] = (now - sent[k]) * 1e-9
                        forces[k] = force
        return RoundTrips(
            tips=tips[:n],
            forces=forces[:n],
            latencies=latencies[:n],
            arrivals=arrivals[:n_arrivals] * 1e-9,
            begin=first * 1e-9,
            end=time.monotonic_ns() * 1e-9,
            priority=priority,
        )

    def _listen(self, until: int) -> bytes | None:
        """Return the next wrench, serialised, or None if none came in time."""
        handle = self._subscription.handle
        wait_set = self._wait_set
        while (left := until - time.monotonic_ns()) > 0:
            wait_set.clear_entities()
            wait_set.add_subscription(handle)
            wait_set.wait(left)
            taken = handle.take_message(WrenchStamped, True)
            if taken is not None:
                return bytes(taken[0])
        return None


def main() -> int:
    """Palpate as the command line asks; return the exit code."""
    options = _options()
    # a damaged file ends the process before anything runs
    vademecum = load_vademecum(options.vademecum)
    tips = palpation(vademecum, options.tip_radius, options.seconds, options.rate)
    del vademecum
    stop = StopSignal()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"scripted_{options.tool}", enable_rosout=False)
    try:
        tool = ScriptedTool(node, options.tool, options.frame, options.rate)
        tool.wait_for_model(options.timeout)
        granted = realtime.claim(options.priority)
        realtime.bind_thread(options.cpu)
        realtime.tune_interpreter()
        tool.play(np.repeat(tips[:1], round(_SETTLE * options.rate), axis=0), stop)
        print(READY, flush=True)
        round_trips = tool.play(tips, stop, granted.priority)
        if options.output:
            round_trips.save(options.output)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="A tool that palpates the organ by itself.")
    parser.add_argument("vademecum", type=Path, help="file with the organ's surface")
    parser.add_argument("--tool", default="tool", help="name of the tool")
    parser.add_argument("--frame", default="organ", help="frame of its poses")
    parser.add_argument(
        "--tip-radius", type=float, default=0.005, help="radius of the spherical tip [m]"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="duration [s]")
    parser.add_argument("--rate", type=float, default=1000.0, help="poses per second [Hz]")
    parser.add_argument("--priority", type=int, default=0, help="SCHED_FIFO priority; 0: none")
    parser.add_argument("--cpu", type=int, default=-1, help="core; -1: any")
    parser.add_argument(
        "--timeout", type=float, default=60.0, help="time to wait for the contact node [s]"
    )
    parser.add_argument("--output", type=Path, help="file for poses and answers (.npz)")
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())
