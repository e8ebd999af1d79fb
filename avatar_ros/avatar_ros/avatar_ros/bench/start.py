"""Time and processor time of each stage from launch to the first force.

A cell is started as ``avatar cell`` does it, or by ``ros2 launch``, while a tool already holds its
tip in the organ. ``avatar bench start`` runs it as ``python -m avatar_ros.bench.start VADEMECUM``.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import SingleThreadedExecutor

from avatar_core.contact import tool_path
from avatar_core.vademecum.storage import load_vademecum
from avatar_interfaces.msg import ContactState, VademecumInfo
from avatar_ros.bench.cell import CellError, isolated_environment
from avatar_ros.bench.command import Report, print_report
from avatar_ros.bench.footprint import children
from avatar_ros.bench.thread_times import thread_times
from avatar_ros.framework import discovery, qos, realtime
from avatar_ros.framework.templates import PoseTemplate, stamp_bytes

STAGES = ("contact node answers", "vademecum announced", "first wrench with a model", "first force")
_RADIUS = 5e-3  # radius of the tip, the node's default [m]
_DEPTH = 3e-3  # [m]
_PERIOD = 10e-3  # period of the poses, below three quarters of the default pose_timeout [s]
_TIMEOUT = 120.0  # [s]
_STOP_TIMEOUT = 20.0  # [s]
_NAMES = {
    "avatar_ros.nodes.cell": "cell",
    "avatar_ros.prepare.worker": "contact's worker",
    "avatar_core.common.confined": "reader",
}


@dataclass(frozen=True)
class StartStage:
    """One stage of a start.

    Attributes
    ----------
    seconds : float
        Time since the launch [s].
    cpu : dict
        Processor time of each process until then [s].
    """

    name: str
    seconds: float
    cpu: dict[str, float]


@dataclass(frozen=True)
class StartReport(Report):
    """Report of ``avatar bench start``."""

    name = "start"

    vademecum: str
    load_average: float
    stages: tuple[StartStage, ...]

    @property
    def summary(self) -> dict[str, float]:
        """Return time and processor time of all processes until the last stage."""
        last = self.stages[-1]
        return {"seconds": last.seconds, "cpu_seconds": sum(last.cpu.values())}

    def table(self) -> str:
        """Return one stage a line: time, processor time of all, and of each process."""
        names = list(self.stages[-1].cpu)
        width = max(len(name) for name in names) + 2
        lines = [
            f"load average {self.load_average:.2f} before; processor times since launch [s]",
            f"{'stage':28}{'at [s]':>8}{'all':>8}" + "".join(f"{n:>{width}}" for n in names),
        ]
        for stage in self.stages:
            row = f"{stage.name:28}{stage.seconds:>8.2f}{sum(stage.cpu.values()):>8.2f}"
            row += "".join(f"{stage.cpu.get(name, 0.0):>{width}.2f}" for name in names)
            lines.append(row)
        return "\n".join(lines)


def run_start(vademecum: Path, command: list[str] | None = None) -> StartReport:
    """Start a cell with a vademecum and wait for the first force on a tool.

    Parameters
    ----------
    vademecum : Path
        Vademecum file.
    command : sequence of str, optional
        Command that starts a cell; by default that of ``avatar cell``.

    Raises
    ------
    CellError
        If the cell ended, or gave no force in time.
    """
    vademecum = vademecum.resolve()
    tip = _tip(vademecum)
    os.environ.update(isolated_environment())
    discovery.stay_local()
    load = os.getloadavg()[0]
    words = command or [sys.executable, "-m", "avatar_core.cli.main", "cell"]
    if command is None:
        words += ["--library-dir", str(vademecum.parent), "--vademecum", vademecum.name]
    context = rclpy.Context()
    context.init()
    watcher = _Watcher(context, tip)
    begin = time.monotonic()
    process = subprocess.Popen(
        words,
        cwd="/",
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=partial(realtime.die_with_parent, signal.SIGINT),
    )
    try:
        stages = watcher.watch(process, begin)
    finally:
        watcher.close()
        context.try_shutdown()
        process.send_signal(signal.SIGINT)
        try:
            process.wait(_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
    return StartReport(vademecum.name, load, tuple(stages))


def _tip(vademecum: Path) -> Any:
    """Return the centre of a tip that presses the middle of the accessible surface, (3,) [m]."""
    organ = load_vademecum(vademecum)
    middle = tool_path.middle_of_access(organ)
    surface = organ.surface
    return surface.centers[middle] + (_RADIUS - _DEPTH) * surface.normals[middle]


class _Watcher:
    """Tool that holds still, and notes when the cell reaches each stage."""

    def __init__(self, context: Any, tip: Any) -> None:
        self._node = rclpy.create_node("start_watcher", context=context, enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self._reached: dict[str, float] = {}
        self._on_reached: Callable[[str], None] = lambda stage: None
        node = self._node
        node.create_subscription(ContactState, "contact_state", self._state, qos.state(1))
        node.create_subscription(VademecumInfo, "vademecum_info", self._info, qos.LATCHED)
        node.create_subscription(WrenchStamped, "tool/servo_cf", self._wrench, qos.COMMAND)
        self._publisher = node.create_publisher(PoseStamped, "tool/measured_cp", qos.NEWEST)
        self._pose = PoseTemplate("organ")
        self._pose.position[:] = tip
        node.create_timer(_PERIOD, self._send)

    def watch(self, process: subprocess.Popen[bytes], begin: float) -> list[StartStage]:
        """Serve until the last stage is reached; return the stages in the order of arrival."""
        stages: list[StartStage] = []

        def note(name: str) -> None:
            of_ended = stages[-1].cpu if stages else {}
            stages.append(StartStage(name, time.monotonic() - begin, of_ended | _cpu(process.pid)))

        self._on_reached = note
        while len(stages) < len(STAGES):
            if process.poll() is not None:
                raise CellError(f"the cell ended with code {process.returncode}; see above")
            if time.monotonic() - begin > _TIMEOUT:
                missing = [name for name in STAGES if name not in self._reached]
                raise CellError(f"not reached in {_TIMEOUT:g} s: {', '.join(missing)}")
            self._executor.spin_once(timeout_sec=0.1)
        return stages

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()

    def _send(self) -> None:
        self._publisher.publish(self._pose.serialise(stamp_bytes(time.time_ns())))

    def _state(self, state: Any) -> None:
        self._reach(STAGES[0])
        if state.vademecum_id:
            self._reach(STAGES[2])

    def _info(self, info: Any) -> None:
        self._reach(STAGES[1])

    def _wrench(self, wrench: Any) -> None:
        force = wrench.wrench.force
        if force.x or force.y or force.z:
            self._reach(STAGES[3])

    def _reach(self, stage: str) -> None:
        if stage not in self._reached:
            self._reached[stage] = time.monotonic()
            self._on_reached(stage)


def _cpu(pid: int) -> dict[str, float]:
    """Return the processor time of a process and its descendants, by name [s]."""
    found = {}
    waiting = [(pid, "")]
    while waiting:
        number, parent = waiting.pop(0)
        with suppress(OSError):  # the process has ended
            name = _name(number, parent)
            found[name] = sum(thread.seconds for thread in thread_times(number).values())
            waiting += [(child, name) for child in sorted(children(number))]
    return found


def _name(pid: int, parent: str) -> str:
    words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    module = words[words.index("-m") + 1] if "-m" in words else Path(words[0]).name
    name = _NAMES.get(module, module.rpartition(".")[2])
    return f"{parent}'s reader".replace("'s worker's", "'s") if name == "reader" else name


def main() -> int:
    """Measure as the command line asks; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m avatar_ros.bench.start")
    parser.add_argument("vademecum", type=Path)
    parser.add_argument("--output", type=Path, help="write all figures as JSON")
    parser.add_argument(
        "command", nargs="*", help="command that starts the cell; default: avatar cell"
    )
    chosen = parser.parse_args()
    return print_report(lambda: run_start(chosen.vademecum, chosen.command or None), chosen.output)


if __name__ == "__main__":
    raise SystemExit(main())
