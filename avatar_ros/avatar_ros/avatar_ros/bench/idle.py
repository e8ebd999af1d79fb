"""Processor time of the nodes while nobody asks anything of them.

Contact node and loader run without a vademecum; the patients' service runs if an atlas is given.
Each has a domain of its own. ``avatar bench idle`` runs it as
``python -m avatar_ros.bench.idle SECONDS``.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from avatar_ros.bench.cell import CellError, Module, isolated_environment
from avatar_ros.bench.command import Report, print_report
from avatar_ros.bench.footprint import children
from avatar_ros.bench.thread_times import between, thread_times

_LEAST = 0.0005  # smallest fraction of a core for which a thread gets its own row
_CALM = 0.15  # fraction of a core below which a start is over, even on a fifth of a core
_SETTLED = 5  # seconds in a row below _CALM
_START_TIMEOUT = 120.0  # [s]


@dataclass(frozen=True)
class IdleThread:
    """Load of one thread, or of a whole process.

    Attributes
    ----------
    fraction : float
        Fraction of a core.
    wake_ups : float
        Wake-ups per second.
    """

    process: str
    thread: str
    fraction: float
    wake_ups: float

    def row(self) -> str:
        """Return a line of the table under ``HEADER``."""
        return f"{self.process:32}{self.thread:18}{self.fraction:>9.2%}{self.wake_ups:>12.1f}"


HEADER = f"{'process':32}{'thread':18}{'of a core':>9}{'wake-ups/s':>12}"
ALL = "all"


@dataclass(frozen=True)
class IdleReport(Report):
    """Report of ``avatar bench idle``."""

    name = "idle"

    load_average: float
    seconds: float
    threads: tuple[IdleThread, ...]

    @property
    def summary(self) -> dict[str, float]:
        """Return the fraction of a core of each node, its helper processes included."""
        found: dict[str, float] = {}
        for thread in self.threads:
            if thread.thread == ALL:
                name = thread.process.partition("'")[0]
                found[name] = found.get(name, 0.0) + thread.fraction
        return found

    def table(self) -> str:
        """Return one line for each thread, after the load average."""
        return "\n".join(
            [
                f"load average {self.load_average:.2f} before; {self.seconds:g} s",
                HEADER,
                *(thread.row() for thread in self.threads),
                f"contact and its worker: {self.summary['contact']:.2%} of a core",
            ]
        )


def run_idle(seconds: float, atlas: Path | None = None) -> IdleReport:
    """Start the nodes, wait until they are idle, and measure.

    Raises
    ------
    CellError
        If a node ended, or does not come to rest.
    """
    load = os.getloadavg()[0]
    with _nodes(atlas) as nodes:
        _settle(nodes)
        pids = {name: node.pid for name, node in nodes.items()}
        for name, pid in list(pids.items()):
            helpers = sorted(children(pid))
            pids |= {f"{name}'s helper {k}": helper for k, helper in enumerate(helpers, 1)}
        begin, first = time.monotonic(), {name: thread_times(pid) for name, pid in pids.items()}
        time.sleep(seconds)
        took, last = time.monotonic() - begin, {n: thread_times(pid) for n, pid in pids.items()}
        _require_alive(nodes)
    rows: list[IdleThread] = []
    for name, pid in pids.items():
        taken = between(first[name], last[name])
        whole = sum(thread.seconds for thread in taken.values()) / took
        woken = sum(thread.wake_ups for thread in taken.values()) / took
        rows.append(IdleThread(name, ALL, whole, woken))
        rows += [
            IdleThread(
                name,
                "main" if number == pid else thread.name,
                thread.seconds / took,
                thread.wake_ups / took,
            )
            for number, thread in taken.items()
            if thread.seconds / took >= _LEAST
        ]
    return IdleReport(load, took, tuple(rows))


@contextmanager
def _nodes(atlas: Path | None) -> Iterator[dict[str, Module]]:
    """Run the nodes, each isolated from the others."""
    of_patients = ["-p", "autostart:=false"]
    if atlas is not None:
        of_patients = ["-p", f"atlas:={atlas}", "-p", f"library_dir:={atlas.parent}"]
    asked = {
        "contact": [],
        "vademecum_loader": [],
        "patient_interpolation": ["--ros-args", *of_patients],
    }
    with ExitStack() as ended:
        found = {}
        for name, arguments in asked.items():
            found[name] = Module(name, arguments, isolated_environment())
            ended.callback(found[name].finish)
        yield found


def _settle(nodes: dict[str, Module]) -> None:
    """Wait until all nodes have been idle for ``_SETTLED`` seconds."""
    end, calm, before = time.monotonic() + _START_TIMEOUT, 0, _used(nodes)
    while calm < _SETTLED:
        if time.monotonic() > end:
            raise CellError(f"the nodes do not come to rest in {_START_TIMEOUT:g} s")
        time.sleep(1.0)
        _require_alive(nodes)
        now = _used(nodes)
        has_worker = any(children(nodes["contact"].pid))
        at_rest = all(now[name] - before[name] < _CALM for name in now)
        calm = calm + 1 if has_worker and at_rest else 0
        before = now


def _used(nodes: dict[str, Module]) -> dict[str, float]:
    """Return the processor time of each node with its helper processes so far [s]."""
    return {
        name: sum(
            thread.seconds
            for pid in (node.pid, *children(node.pid))
            for thread in thread_times(pid).values()
        )
        for name, node in nodes.items()
    }


def _require_alive(nodes: dict[str, Module]) -> None:
    for name, node in nodes.items():
        if node.poll() is not None:
            raise CellError(f"{name} ended by itself: {node.last_line()}")


def main() -> int:
    """Measure as the command line asks; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m avatar_ros.bench.idle")
    parser.add_argument("seconds", type=float, help="duration of the measurement [s]")
    parser.add_argument("--atlas", type=Path, help="atlas for the patients' service")
    parser.add_argument("--output", type=Path, help="write all figures as JSON")
    chosen = parser.parse_args()
    return print_report(lambda: run_idle(chosen.seconds, chosen.atlas), chosen.output)


if __name__ == "__main__":
    raise SystemExit(main())
