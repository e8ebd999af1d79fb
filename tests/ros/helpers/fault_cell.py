"""A cell for fault injection: its processes, and the contact node's messages meanwhile."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from avatar_interfaces.msg import ContactState, LoopStatistics
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from tests.helpers.slowness import Deadline
from tests.ros.helpers.steady_tool import SWING

MOST = 5.0  # [N], the limit that the contact node is given
_ORDINARY_GAP = 2e-3  # largest gap between two wrenches [s]
_CALM = 0.3  # time of ordinary palpation that counts as recovered [s]
_PATIENCE = 20.0  # time limit for recovery [s]


@dataclass
class Harm:
    """Effects of a fault; times in seconds, by the sender's clock.

    recovery : from its end to ordinary palpation; infinite if it never came
    largest : largest sent force [N]; finite : whether all sent numbers were
    longest_gap : longest time between two wrenches during the fault
    longest_period : longest period of the loop, by its own clock
    silent_after : from the tool's end to the last force before its return; NaN if it went on
    late : delay of the loop during the fault's first tenth of a second
    """

    name: str
    recovery: float
    largest: float
    finite: bool
    wrenches: int
    missed: int
    periods: int
    longest_gap: float
    longest_period: float
    silent_after: float
    late: float

    def row(self) -> str:
        silent = (
            f", the last force {1e3 * self.silent_after:.1f} ms after the tool's end "
            f"(the loop lost {1e3 * self.late:.1f} ms)"
            if np.isfinite(self.silent_after)
            else ""
        )
        return (
            f"{self.name}: {self.wrenches} wrenches of at most {self.largest:.2f} N{silent}, "
            f"{self.missed} of {self.periods} periods missed, longest "
            f"{1e3 * self.longest_period:.1f} ms, longest gap heard "
            f"{1e3 * self.longest_gap:.1f} ms, recovered in {self.recovery:.2f} s"
        )


@dataclass(frozen=True)
class Silence:
    """Time without a tool [s]."""

    begin: float
    end: float


class Ear:
    """Listener to every wrench and every window of statistics, in a separate thread.

    Times are those of sending: on a busy machine the listener itself comes late.
    """

    def __init__(self) -> None:
        self.heard: list[tuple[float, bytes]] = []
        self.windows: list[LoopStatistics] = []
        self.statuses: list[tuple[float, int, str]] = []
        self._context = rclpy.Context()
        self._context.init()
        self._node = rclpy.create_node(
            "ear", context=self._context, enable_rosout=False, start_parameter_services=False
        )
        every = QoSProfile(depth=4000, reliability=qos.COMMAND.reliability)
        self._node.create_subscription(
            WrenchStamped,
            "tool/servo_cf",
            lambda raw, info: self.heard.append((_sent(info), raw)),
            every,
            raw=True,
        )
        self._node.create_subscription(
            LoopStatistics, "statistics", self.windows.append, qos.STATISTICS
        )
        self._node.create_subscription(
            ContactState,
            "contact_state",
            lambda s, info: self.statuses.append((_sent(info), s.status, s.vademecum_id)),
            every,
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        with suppress(ExternalShutdownException):  # closed while it waited
            while self._context.ok():
                self._executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self._context.try_shutdown()
        self._thread.join(5.0)

    def forces(self, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
        """Return times (n,) and forces (n, 3) that came in between."""
        chosen = [(at, raw) for at, raw in self.heard if begin <= at <= end]
        found = [deserialize_message(raw, WrenchStamped).wrench.force for _, raw in chosen]
        times = np.array([at for at, _ in chosen])
        return times, np.array([[f.x, f.y, f.z] for f in found]).reshape(-1, 3)


def _sent(info: dict[str, int]) -> float:
    """Return the time of sending by the monotonic clock [s]."""
    return time.monotonic() - 1e-9 * (time.time_ns() - info["source_timestamp"])


class FaultCell:
    """Loader, contact node, patient node, tool and a viewer of clouds, each a process."""

    def __init__(
        self,
        library: Path,
        patients: Path,
        touch: Any,
        domain: dict[str, str],
        state_dir: Path | str = "",
        swing: float = SWING,
        contact: tuple[str, ...] = (),
    ) -> None:
        self.library, self.patients, self.domain = library, patients, domain
        self._state_dir, self._swing, self._contact = state_dir, swing, contact
        tip, normal = touch
        self._tool = [f"{x:.9g}" for x in (*(tip + 4e-3 * normal), *normal)]
        self.processes: dict[str, subprocess.Popen[Any]] = {}
        self.ear = Ear()
        for name in ("loader", "contact", "patients", "viewer"):
            self.start(name)

    def start(self, name: str, rate: float = 1000.0) -> None:
        """Start a process anew."""
        kept = [f"state_dir:={self._state_dir}"] if self._state_dir else []
        files = [f"library_dir:={self.library}", "vademecum:=liver.h5", *kept]
        rough = [f"library_dir:={self.patients}", f"atlas:={self.patients / 'atlas'}"]
        modules = {
            "loader": ("vademecum_loader", files),
            "contact": ("contact", [f"safety.max_force:={MOST}", *self._contact, *kept]),
            "patients": ("patient_interpolation", rough),
        }
        if name in modules:
            module, given = modules[name]
            words = [word for pair in given for word in ("-p", pair)]
            self.processes[name] = Module(module, ["--ros-args", *words], self.domain)
        elif name == "viewer":
            output = str(self.patients / "clouds.json")
            self.processes[name] = Module("bench.cloud_viewer", [output], self.domain)
        else:
            script = str(Path(__file__).with_name("steady_tool.py"))
            command = [sys.executable, script, *self._tool, f"{rate:g}", f"{self._swing:g}"]
            self.processes[name] = subprocess.Popen(command, cwd="/", env=self.domain)

    def end(self, name: str) -> None:
        process = self.processes.pop(name)
        process.kill()
        process.wait()

    def close(self) -> None:
        for process in self.processes.values():
            process.send_signal(signal.SIGCONT)
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.ear.close()

    @contextmanager
    def stopped(self, name: str, seconds: float) -> Iterator[float]:
        """Stop a process by SIGSTOP for a while; yield the time when it stopped."""
        pid = self.processes[name].pid
        os.kill(pid, signal.SIGSTOP)
        os.waitid(os.P_PID, pid, os.WSTOPPED)
        begin = time.monotonic()
        try:
            time.sleep(seconds)
            yield begin
        finally:
            os.kill(pid, signal.SIGCONT)

    def heard_from_tool(self, since: float, patience: float = _PATIENCE) -> float:
        """Return when a pose was answered for the first time after a moment."""
        answered = (ContactState.STATUS_ENGAGING, ContactState.STATUS_OK)
        passed = Deadline(patience)
        while True:
            for at, status, _ in list(self.ear.statuses):
                if at > since and status in answered:
                    return at
            assert not passed, "the tool did not start"
            time.sleep(0.005)

    def wait_until_it_palpates(self, begin: float, patience: float = _PATIENCE) -> float:
        """Return the time from ``begin`` to ordinary palpation [s]; infinity if there is none."""
        passed = Deadline(patience)
        while not passed:
            time.sleep(0.05)
            since = begin
            for at, status, _ in [s for s in self.ear.statuses if s[0] >= begin]:
                if status != ContactState.STATUS_OK:
                    since = at
            heard = [s for s in self.ear.statuses if s[0] > since]
            if heard and heard[-1][0] - since >= _CALM:
                return max(heard[0][0] - begin, 0.0) if since > begin else 0.0
        return float("inf")

    def suffer(self, name: str, fault: Callable[[FaultCell], Silence | None]) -> Harm:
        """Inject a fault while the tool palpates; return its effects."""
        assert np.isfinite(self.wait_until_it_palpates(time.monotonic(), 120.0)), name
        self.ear.heard.clear()
        self.ear.statuses.clear()
        self.ear.windows.clear()
        begin = time.monotonic()
        silence = fault(self)
        recovery = self.wait_until_it_palpates(silence.end if silence else time.monotonic())
        times, forces = self.ear.forces(begin, time.monotonic())
        sizes = np.linalg.norm(forces, axis=1)
        silent_after, late = _silent_after(silence, times, sizes)
        return Harm(
            name,
            recovery,
            float(sizes.max(initial=0.0)),
            bool(np.isfinite(forces).all()),
            len(times),
            sum(w.missed for w in self.ear.windows),
            sum(w.periods for w in self.ear.windows),
            float(np.diff(times).max(initial=0.0)),
            max((w.period_max for w in self.ear.windows), default=0.0),
            silent_after,
            late,
        )


def _silent_after(
    silence: Silence | None, times: np.ndarray, sizes: np.ndarray
) -> tuple[float, float]:
    """Return ``silent_after`` and ``late``; ``sizes`` are those of the forces at ``times``."""
    if silence is None:
        return float("nan"), 0.0
    felt = times[(times > silence.begin) & (times < silence.end) & (sizes > 0.0)]
    first = times[(times > silence.begin) & (times < silence.begin + 0.1)]
    lost = np.clip(np.diff(first) - _ORDINARY_GAP, 0.0, None)
    return float(felt.max(initial=silence.begin) - silence.begin), float(lost.sum())
