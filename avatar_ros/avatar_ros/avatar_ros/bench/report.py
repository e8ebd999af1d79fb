"""Results of a measured cell, and how they are printed and written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from avatar_ros.bench import footprint
from avatar_ros.bench.command import Report
from avatar_ros.bench.footprint import FootprintGrowth
from avatar_ros.bench.scripted_tool import RoundTrips

PROMISED_ON_TIME = 0.99  # fraction of the contact loop's periods, on a quiet machine


@dataclass(frozen=True)
class Times:
    """Median, 99th percentile and maximum of periods or latencies [ms]."""

    p50_ms: float
    p99_ms: float
    max_ms: float

    @staticmethod
    def of(seconds: np.ndarray) -> Times:
        """Summarise times given in seconds; NaN if there are none."""
        if len(seconds) == 0:
            return Times(np.nan, np.nan, np.nan)
        return Times(*(float(x) for x in 1e3 * np.percentile(seconds, (50, 99, 100))))


@dataclass(frozen=True)
class CellMeasurement:
    """Figures of one run of the cell.

    Attributes
    ----------
    priority : int
        SCHED_FIFO priority that the tool was granted, 0 without.
    load_average : float
        Load average of the last minute before the run; other processes disturb it.
    rate_hz, on_time_fraction : float
        Periods of the contact loop by its own clock; on time: at most 1.5 ms.
    rate_at_tool_hz, on_time_at_tool_fraction : float
        Periods between wrenches that reached the tool.
    latency : Times
        Time from publishing a pose to having its wrench, measured in the tool.
    answered_fraction : float
        Fraction of poses that got their own wrench.
    compute_p99_ms : float
        99th percentile from having a pose to publishing its wrench, in the worst second.
    floor : Times
        Periods of the sleeping loop in the same seconds.
    bare_work_on_time_fraction : float
        The same for a loop that computes as long as the contact node, alone.
    cloud_hz, cloud_bytes : float, int
        Rate and size of the clouds that the viewer got.
    material_changes : int
        Changes that the contact node accepted in the run.
    force_max_n : float
        Largest force on the tool.
    growths : tuple of FootprintGrowth
        Growth of every process of the cell.
    round_trips : RoundTrips
        Every pose and its answer; not in the data file.
    """

    priority: int
    load_average: float
    seconds: float
    rate_hz: float
    on_time_fraction: float
    period_max_ms: float
    rate_at_tool_hz: float
    on_time_at_tool_fraction: float
    latency: Times
    answered_fraction: float
    compute_p99_ms: float
    floor: Times
    floor_on_time_fraction: float
    bare_work_on_time_fraction: float
    cloud_hz: float
    cloud_bytes: int
    material_changes: int
    force_max_n: float
    growths: tuple[FootprintGrowth, ...]
    round_trips: RoundTrips

    @property
    def complaints(self) -> list[str]:
        """List violations of what a run on a quiet machine must keep, one line each."""
        late = f"{1.0 - self.on_time_fraction:.2%} of the periods were late"
        found = [late] if self.on_time_fraction < PROMISED_ON_TIME else []
        return found + [growth.complaint for growth in self.growths if growth.complaint]


@dataclass(frozen=True)
class CellReport(Report):
    """Report of ``avatar bench cell``; ``real_time`` is None where priority is refused."""

    name = "cell"

    machine: str
    cores: int
    vademecum: str
    real_time: CellMeasurement | None
    ordinary: CellMeasurement | None

    @property
    def summary(self) -> dict[str, float]:
        """Return the figures of the better mode that was run, under the names of the data file."""
        best = self.real_time or self.ordinary
        if best is None:
            return {}
        return {
            "rate_hz": best.rate_hz,
            "on_time_fraction": best.on_time_fraction,
            "latency_p50_ms": best.latency.p50_ms,
            "latency_p99_ms": best.latency.p99_ms,
        }

    def figures(self) -> dict[str, Any]:
        """Return all figures except the round trips."""
        found = super().figures()
        for run in (found["real_time"], found["ordinary"]):
            if run is not None:
                del run["round_trips"]
        return found

    def table(self) -> str:
        """Return both modes side by side, one figure a line, then the growth of the processes."""
        runs = [run for run in (self.real_time, self.ordinary) if run is not None]
        names = [f"SCHED_FIFO {run.priority}" if run.priority else "ordinary" for run in runs]
        lines = [f"{'':34}" + "".join(f"{name:>16}" for name in names)]
        for label, value in _ROWS:
            lines.append(f"{label:34}" + "".join(f"{value(run):>16}" for run in runs))
        for name, run in zip(names, runs, strict=True):
            lines += ["", footprint.HEADER]
            lines += [growth.row() for growth in run.growths]
            said = "; ".join(run.complaints) or "kept"
            lines.append(
                f"{name}, {PROMISED_ON_TIME:.0%} on time, nothing grows by "
                f"{footprint.MAX_GROWTH:g} MB, a file or a thread: {said}"
            )
        return "\n".join(lines)


def _times(times: Times) -> str:
    return f"{times.p50_ms:.2f} {times.p99_ms:.2f} {times.max_ms:.1f}"


_ROWS = (
    ("load average before", lambda run: f"{run.load_average:.2f}"),
    ("contact loop rate [Hz]", lambda run: f"{run.rate_hz:.1f}"),
    ("  periods <= 1.5 ms", lambda run: f"{run.on_time_fraction:.3%}"),
    ("  longest period [ms]", lambda run: f"{run.period_max_ms:.1f}"),
    ("wrenches at the tool [Hz]", lambda run: f"{run.rate_at_tool_hz:.1f}"),
    ("  periods <= 1.5 ms", lambda run: f"{run.on_time_at_tool_fraction:.3%}"),
    ("pose to wrench p50 p99 max [ms]", lambda run: _times(run.latency)),
    ("  poses answered", lambda run: f"{run.answered_fraction:.3%}"),
    ("  computing, worst p99 [ms]", lambda run: f"{run.compute_p99_ms:.3f}"),
    ("bare sleep p50 p99 max [ms]", lambda run: _times(run.floor)),
    ("  periods <= 1.5 ms", lambda run: f"{run.floor_on_time_fraction:.3%}"),
    ("bare work alone, <= 1.5 ms", lambda run: f"{run.bare_work_on_time_fraction:.3%}"),
    ("clouds at the viewer [Hz]", lambda run: f"{run.cloud_hz:.1f}"),
    ("  bytes each", lambda run: f"{run.cloud_bytes}"),
    ("changes of the material", lambda run: f"{run.material_changes}"),
    ("largest force [N]", lambda run: f"{run.force_max_n:.2f}"),
)
