"""What the processes of a measured cell take more and more of, if anything; no times are asked."""

from __future__ import annotations

import mmap
import os
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")

from avatar_ros.bench.cell import run_cell
from avatar_ros.bench.footprint import Footprint, Growth

pytestmark = pytest.mark.ros


@pytest.mark.long
def test_nothing_grows_in_a_minute(library: Path) -> None:
    """The times of a soak are measured by `avatar bench cell --seconds 600` on a quiet machine."""
    report = run_cell(library / "liver.h5", 60.0, real_time=False)
    run = report.ordinary
    assert run is not None
    print(f"\n{report.table()}")
    named = {growth.process for growth in run.growths}
    assert named >= {"vademecum_loader", "contact", "contact's helper 1", "scripted_tool"}
    assert [growth.complaint for growth in run.growths if growth.complaint] == []


def test_what_grows_is_complained_of(tmp_path: Path) -> None:
    begin = Footprint.of(os.getpid())
    taken = mmap.mmap(-1, 8_000_000)
    taken.write(bytes(len(taken)))
    with (tmp_path / "file").open("w"):
        end = Footprint.of(os.getpid())
    growth = Growth("test", begin, end)
    assert growth.memory_mb == pytest.approx(8.0, abs=0.5)
    assert growth.complaint.endswith("MB and 1 files more")
    assert Growth("test", end, begin).complaint == ""
