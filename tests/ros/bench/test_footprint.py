"""Growth of a measured cell's processes; no times are required."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from avatar_ros.bench.cell import run_cell
from avatar_ros.bench.footprint import Footprint, FootprintGrowth


@pytest.mark.long
def test_nothing_grows_in_a_minute(library: Path) -> None:
    """`avatar bench cell --seconds 600` on a quiet machine measures the times of a soak."""
    report = run_cell(library / "liver.h5", 60.0, real_time=False)
    run = report.ordinary
    assert run is not None
    print(f"\n{report.table()}")
    named = {growth.process for growth in run.growths}
    assert named >= {"vademecum_loader", "contact", "contact's helper 1", "scripted_tool"}
    assert [growth.complaint for growth in run.growths if growth.complaint] == []


_GROWING = """
import mmap, sys
print(flush=True), sys.stdin.readline()
taken = mmap.mmap(-1, 8_000_000)
taken.write(bytes(len(taken)))
held = open(sys.argv[1], "w")
print(flush=True), sys.stdin.readline()
"""


def test_what_grows_is_complained_of(tmp_path: Path) -> None:
    """The process does nothing else, unlike this one with threads of other tests."""
    with subprocess.Popen(
        [sys.executable, "-S", "-c", _GROWING, str(tmp_path / "file")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        process.stdout.readline()
        begin = Footprint.of(process.pid)
        process.stdin.write("\n")
        process.stdin.flush()
        process.stdout.readline()
        end = Footprint.of(process.pid)
        process.stdin.close()
    growth = FootprintGrowth("test", begin, end)
    assert growth.memory_mb == pytest.approx(8.0, abs=0.5)
    assert growth.complaint.endswith("MB and 1 files more")
    assert FootprintGrowth("test", end, begin).complaint == ""
