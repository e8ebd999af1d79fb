"""The measured cell runs, its figures agree, and the loop keeps the machine's own pace."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from avatar_ros.bench.cell import CellError, run_cell
from avatar_ros.bench.report import CellMeasurement, CellReport
from tests.helpers.slowness import slowness


def test_a_missing_vademecum_is_named(tmp_path: Path) -> None:
    with pytest.raises(CellError, match="no such file"):
        run_cell(tmp_path / "missing.h5", 1.0)


@pytest.mark.long  # five processes for one line
def test_a_broken_vademecum_ends_the_measurement(library: Path) -> None:
    with pytest.raises(CellError, match="build"):
        run_cell(library / "short.h5", 1.0, real_time=False)


def on_time(run: CellMeasurement) -> bool:
    """Return whether a loop missed no more than the sleeping loop in the same seconds, plus 5 %.

    The 5 % allow for chance in two different loops on a shared machine. The targets are measured by
    `avatar bench cell` on a quiet machine.
    """
    return run.on_time_fraction > run.floor_on_time_fraction - 0.05


def best_of(tries: int, measure: Callable[[], CellReport]) -> CellReport:
    """Return the first report in which every loop was on time, or the last one.

    Other load of a machine makes a loop late, never early.
    """
    for _ in range(tries):
        report = measure()
        if all(on_time(run) for run in (report.real_time, report.ordinary) if run is not None):
            break
    return report


@pytest.mark.long
@pytest.mark.timing
def test_the_cell_keeps_time(library: Path, tmp_path: Path) -> None:
    report = best_of(3, lambda: run_cell(library / "liver.h5", 10.0))
    report.save(tmp_path / "cell.json")
    data = json.loads((tmp_path / "cell.json").read_text())
    assert data["summary"] == report.summary
    assert set(report.summary) == {
        "rate_hz",
        "on_time_fraction",
        "latency_p50_ms",
        "latency_p99_ms",
    }
    for run in (report.real_time, report.ordinary):
        if run is None:
            continue
        assert on_time(run)
        assert 0.0 < run.bare_work_on_time_fraction <= 1.0
        assert run.material_changes == 0
        assert run.answered_fraction > 0.9
        assert run.latency.p50_ms < 1.0
        assert run.cloud_hz > 0.5 * run.rate_hz
        touched = np.linalg.norm(run.round_trips.forces, axis=1) > 0.1
        assert 0.3 < touched.mean() < 0.9  # pushing and sliding make 0.7 of a touch


@pytest.mark.long
@pytest.mark.timing
def test_the_cell_keeps_time_while_the_material_changes(library: Path) -> None:
    # each change follows once the last is in use: a busy machine makes fewer of the twenty
    seconds = 10.0 * min(slowness(), 5.0)
    report = best_of(
        3, lambda: run_cell(library / "liver.h5", seconds, ordinary=False, changes=2.0)
    )
    run = report.real_time
    if run is None:
        pytest.skip("no real-time priority here, without which other processes decide")
    assert run.material_changes >= 3
    assert on_time(run)
