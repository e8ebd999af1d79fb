"""Benchmark of a whole cell of real processes over real DDS: whether this machine keeps 1 kHz.

The cell consists of loader, contact node, a palpating tool, a cloud viewer and, on request, a
slider of the material. A loop that only sleeps runs beside them and shows which periods the machine
itself misses. Then a second bare loop runs alone and computes as long as the contact node does: any
program with that load misses as many periods. The memory, files and threads of every process are
compared between begin and end, so a run of ten minutes is a soak test.
``avatar bench cell`` and ``avatar demo`` run it as
``python -m avatar_ros.bench.cell VADEMECUM SECONDS``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.common.processes import ModuleProcess, thread_limits
from avatar_core.errors import AvatarError
from avatar_ros.bench import footprint
from avatar_ros.bench.command import print_report
from avatar_ros.bench.footprint import FootprintGrowth, footprints
from avatar_ros.bench.report import CellMeasurement, CellReport, Times
from avatar_ros.bench.scripted_tool import READY, RoundTrips

PERIOD = 1e-3  # [s]
ON_TIME = 1.5e-3  # longest period that is on time [s]
PRIORITY = 80  # priority of contact node, tool and sleeping loop in the real-time mode
_START_TIMEOUT = 120.0  # compilation included [s]
_WARM = 0.1  # fraction of a run before the first comparison of the processes
_LAST = 1.5  # time before the end, with the tool still running, of the second comparison [s]
_ALONE = 20.0  # longest run of the loop that works alone [s]
_STOP_TIMEOUT = 20.0  # a node ends within 2 s, or later with a tenth of a core [s]
_DOMAINS = range(1, 102)  # DDS domain ids that work on every platform


class CellError(AvatarError):
    """A process of the measured cell failed."""


def run_cell(
    vademecum_path: str | Path,
    seconds: float = 60.0,
    real_time: bool = True,
    ordinary: bool = True,
    tip_radius: float = 0.005,
    changes: float = 0.0,
) -> CellReport:
    """Measure a cell with real-time priority and without, ``seconds`` each.

    Parameters
    ----------
    tip_radius : float
        Radius of the palpating sphere [m].
    changes : float
        Rate at which the material changes [Hz].

    Raises
    ------
    CellError
        If a process failed; the message holds the last line of its standard error.
    """
    path = Path(vademecum_path).resolve()
    if not path.is_file():
        raise CellError(f"{path}: no such file; build one with 'avatar vademecum'")
    granted = real_time and _priority_is_granted()
    return CellReport(
        machine=f"{platform.machine()} {platform.release()}",
        cores=len(os.sched_getaffinity(0)),
        vademecum=path.name,
        real_time=_measure(path, seconds, PRIORITY, tip_radius, changes) if granted else None,
        ordinary=_measure(path, seconds, 0, tip_radius, changes) if ordinary else None,
    )


def _priority_is_granted() -> bool:
    question = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({PRIORITY}))"
    return (
        subprocess.run([sys.executable, "-c", question], stderr=subprocess.DEVNULL).returncode == 0
    )


def _measure(
    path: Path, seconds: float, priority: int, tip_radius: float, changes: float
) -> CellMeasurement:
    load = os.getloadavg()[0]
    with (
        tempfile.TemporaryDirectory(prefix="avatar-bench-") as folder,
        cell(path, tip_radius, priority) as (environment, processes),
    ):
        trips_file, view_file = Path(folder, "round_trips.npz"), Path(folder, "view.json")
        count_file = Path(folder, "count.json")
        viewer = Module("bench.cloud_viewer", [str(view_file)], environment)
        arguments = [str(path), "--tip-radius", str(tip_radius), "--output", str(trips_file)]
        arguments += ["--seconds", str(seconds), "--priority", str(priority)]
        arguments += ["--timeout", str(_START_TIMEOUT)]
        tool = Module("bench.scripted_tool", arguments, environment)
        slider = None
        try:
            assert tool.stdout is not None
            if tool.stdout.readline().strip() != READY:
                tool.wait(_STOP_TIMEOUT)
                raise CellError(f"the tool did not start: {tool.last_line()}")
            if changes > 0.0:
                of_slider = [str(path), str(changes), str(count_file)]
                slider = Module("bench.material_slider", of_slider, environment)
            floor = Module("bench.bare_loop", [str(seconds), str(priority)], environment)
            grown = _growths(seconds, processes | {"cloud_viewer": viewer, "scripted_tool": tool})
            slept = _periods(floor, seconds)
            if tool.wait(timeout=seconds + _START_TIMEOUT) != 0:
                raise CellError(f"the tool failed: {tool.last_line()}")
        finally:
            tool.finish()
            viewer.finish()
            code = 0 if slider is None else slider.finish()
        if slider is not None and code != 0:
            raise CellError(f"the slider failed: {slider.last_line()}")
        accepted = 0 if slider is None else json.loads(count_file.read_text())["accepted"]
        round_trips = RoundTrips.load(trips_file)
        view = json.loads(view_file.read_text())
    windows = _windows(round_trips, view)
    shortly = min(seconds, _ALONE)
    work = str(float(np.mean([w["compute_mean"] for w in windows])))
    alone = Module("bench.bare_loop", [str(shortly), str(priority), work], isolated_environment())
    bare = slept, _periods(alone, shortly)
    return _evaluate(round_trips, view, windows, bare, load, accepted, grown)


def _periods(loop: Module, seconds: float) -> np.ndarray:
    """Return the periods that a bare loop printed [s]."""
    said, _ = loop.communicate(timeout=seconds + _START_TIMEOUT)
    if loop.returncode != 0:
        raise CellError(f"the bare loop failed: {loop.last_line()}")
    return np.array(json.loads(said)["periods"])


def _windows(round_trips: RoundTrips, view: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the contact node's statistics of the measured part."""
    begin, end = float(round_trips.begin), float(round_trips.end)
    found = [
        w
        for w in view["statistics"]
        if begin <= w["received"] - w["window"] and w["received"] <= end
    ]
    if not found:
        raise CellError("no statistics from the contact node: measure for 3 s or longer")
    return found


def _growths(seconds: float, processes: dict[str, Module]) -> tuple[FootprintGrowth, ...]:
    """Measure how much all processes grow over a run; return shortly before its end."""
    begin = time.monotonic()
    pids = {name: process.pid for name, process in processes.items()}
    helpers = footprint.children(pids["contact"])
    pids |= {f"contact's helper {k}": pid for k, pid in enumerate(sorted(helpers), 1)}
    time.sleep(_WARM * seconds)
    try:
        first = footprints(pids)
        time.sleep(max(0.0, begin + seconds - _LAST - time.monotonic()))
        return footprint.growths(first, footprints(pids))
    except OSError:  # a process has ended; the caller reports it
        return ()


def _evaluate(
    round_trips: RoundTrips,
    view: dict[str, Any],
    windows: list[dict[str, Any]],
    bare: tuple[np.ndarray, np.ndarray],
    load: float,
    accepted: int,
    grown: tuple[FootprintGrowth, ...],
) -> CellMeasurement:
    begin, end = float(round_trips.begin), float(round_trips.end)
    periods = sum(w["periods"] for w in windows)
    duration = end - begin
    clouds = [n for at, n in view["clouds"].items() if begin < int(at) < end - 1.0]
    slept, worked = bare
    at_tool = np.diff(round_trips.arrivals)
    answered = round_trips.latencies[np.isfinite(round_trips.latencies)]
    return CellMeasurement(
        priority=int(round_trips.priority),
        load_average=load,
        seconds=duration,
        rate_hz=periods / sum(w["window"] for w in windows),
        on_time_fraction=1.0 - sum(w["missed"] for w in windows) / periods,
        period_max_ms=1e3 * max(w["period_max"] for w in windows),
        rate_at_tool_hz=len(round_trips.arrivals) / duration,
        on_time_at_tool_fraction=float(np.mean(at_tool <= ON_TIME)),
        latency=Times.of(answered),
        answered_fraction=len(answered) / len(round_trips.latencies),
        compute_p99_ms=1e3 * max(w["compute_p99"] for w in windows),
        floor=Times.of(slept),
        floor_on_time_fraction=float(np.mean(slept <= ON_TIME)),
        bare_work_on_time_fraction=float(np.mean(worked <= ON_TIME)),
        cloud_hz=float(np.mean(clouds)) if clouds else 0.0,
        cloud_bytes=view["cloud_bytes"],
        material_changes=accepted,
        force_max_n=float(np.nanmax(np.linalg.norm(round_trips.forces, axis=1))),
        growths=grown,
        round_trips=round_trips,
    )


# --- Processes -------------------------------------------------------------------------------


def isolated_environment() -> dict[str, str]:
    """Return an environment with a DDS domain of its own, restricted to this machine."""
    return (
        os.environ
        | thread_limits()
        | {
            "ROS_DOMAIN_ID": str(
                _DOMAINS[(os.getpid() * 37 + time.monotonic_ns()) % len(_DOMAINS)]
            ),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "PYTHONUNBUFFERED": "1",
        }
    )


@contextmanager
def cell(
    vademecum: Path, tip_radius: float = 0.005, priority: int = 0
) -> Iterator[tuple[dict[str, str], dict[str, Module]]]:
    """Run loader and contact node; yield the environment that joins them, and both processes.

    Raises
    ------
    CellError
        If one of them failed, or did not end in time.
    """
    environment = isolated_environment()
    files = ["-p", f"library_dir:={vademecum.parent}", "-p", f"vademecum:={vademecum.name}"]
    loader = Module("vademecum_loader", ["--ros-args", *files], environment)
    numbers = ["-p", f"tip.radius:={float(tip_radius)}", "-p", f"realtime.priority:={priority}"]
    contact = Module("contact", ["--ros-args", *numbers], environment)
    try:
        yield environment, {"vademecum_loader": loader, "contact": contact}
        for name, process in (("vademecum_loader", loader), ("contact", contact)):
            if process.poll() is not None:
                raise CellError(f"{name} ended by itself: {process.last_line()}")
    finally:
        codes = [process.finish() for process in (contact, loader)]
    if any(codes):
        raise CellError(f"contact and loader ended with codes {codes} instead of 0")


class Module(ModuleProcess):
    """Process of a node, or of a module named with its room; its standard error is kept."""

    def __init__(self, name: str, arguments: list[str], environment: dict[str, str]) -> None:
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115, closed with the object
        module = name if "." in name else f"nodes.{name}"
        super().__init__(
            f"avatar_ros.{module}",
            *arguments,
            environment=environment,
            start_new_session=False,
            stdout=subprocess.PIPE,
            stderr=self._said,
            text=True,
        )

    def said(self) -> str:
        """Return all of standard error so far, without moving the file's position."""
        number = self._said.fileno()
        return os.pread(number, os.fstat(number).st_size, 0).decode(errors="replace")

    def last_line(self) -> str:
        """Return the last line of standard error."""
        lines = [line.strip() for line in self.said().splitlines() if line.strip()]
        return lines[-1] if lines else f"no output, exit code {self.poll()}"

    def finish(self, seconds: float = _STOP_TIMEOUT, number: int = signal.SIGINT) -> int:
        """End the process as Ctrl-C would; return its exit code."""
        return super().finish(seconds, number)


def main() -> int:
    """Measure a cell as the command line asks; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m avatar_ros.bench.cell")
    parser.add_argument("vademecum", type=Path)
    parser.add_argument("seconds", type=float, help="duration of each run [s]")
    parser.add_argument(
        "--changes", type=float, default=0.0, help="rate of changes of the material [Hz]"
    )
    parser.add_argument("--output", type=Path, help="write all figures as JSON")
    chosen = parser.parse_args()
    return print_report(
        lambda: run_cell(chosen.vademecum, chosen.seconds, changes=chosen.changes), chosen.output
    )


if __name__ == "__main__":
    raise SystemExit(main())
