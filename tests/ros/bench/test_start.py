"""The measured start: its stages come in order, its figures agree, and no process stays."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from avatar_ros.bench.cell import CellError
from avatar_ros.bench.start import STAGES, run_start
from tests.helpers.slowness import wait_until

pytestmark = pytest.mark.long


MARK = "AVATAR_MEASURED_START"  # in the environment of all processes of the measured start


def marked(value: str) -> set[int]:
    """Return processes with this value of the mark, except this one."""
    found = set()
    for environment in Path("/proc").glob("[0-9]*/environ"):
        try:
            if f"{MARK}={value}".encode() in environment.read_bytes().split(b"\0"):
                found.add(int(environment.parent.name))
        except OSError:  # it has ended
            continue
    return found - {os.getpid()}


def test_a_start_is_measured_stage_by_stage(
    library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(MARK, str(tmp_path))
    report = run_start(library / "liver.h5")
    report.save(tmp_path / "start.json")
    print("\n" + report.table())
    assert {stage.name for stage in report.stages} == {*STAGES}
    times = [stage.seconds for stage in report.stages]
    assert times == sorted(times)
    order = [stage.name for stage in report.stages]
    assert order.index(STAGES[1]) < order.index(STAGES[2])
    last = report.stages[-1].cpu
    assert {"cell", "vademecum_loader", "contact", "contact's worker", "contact's reader"} <= {
        *last
    }
    for stage, following in zip(report.stages, report.stages[1:], strict=False):
        for name, seconds in stage.cpu.items():
            assert seconds <= following.cpu.get(name, seconds)
    data = json.loads((tmp_path / "start.json").read_text())
    assert data["summary"] == report.summary
    wait_until(lambda: not marked(str(tmp_path)), 20.0, "something stays")


def test_a_cell_that_does_not_start_is_named(library: Path) -> None:
    with pytest.raises(CellError, match="ended with code 3"):
        run_start(library / "liver.h5", [sys.executable, "-c", "raise SystemExit(3)"])
