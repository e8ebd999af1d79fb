"""How the loop keeps time while a scene is compiled, loaded and faded in."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")

from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos

from avatar_ros.msg import ContactState, LoopStatistics
from tests.ros.conftest import PATIENT
from tests.ros.prepare.test_scene import Palpation

pytestmark = [pytest.mark.ros, pytest.mark.long, pytest.mark.timing]


def test_the_loop_goes_on_while_a_scene_is_compiled(
    own_domain: dict[str, str],
    probe: Any,
    library: Path,
    touch: tuple[np.ndarray, np.ndarray],
    tmp_path: Path,
) -> None:
    environment = own_domain | {"NUMBA_CACHE_DIR": str(tmp_path)}  # nothing is compiled yet
    files = ["-p", f"library_dir:={library}", "-p", "vademecum:=liver.h5"]
    loader = Module("vademecum_loader", ["--ros-args", *files], environment)
    contact = Module("contact", PATIENT, environment)
    palpation = None
    windows: list[LoopStatistics] = []
    try:
        probe.next(
            ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id, timeout=300.0
        )
        palpation = Palpation(probe, *touch)
        probe.node.create_subscription(LoopStatistics, "statistics", windows.append, qos.STATISTICS)
        for name in ("needle_probe", "palpation", "needle_probe"):
            windows.clear()
            probe.spin(4.0)
            print(f"\nat rest: {_summary(windows)}")
            rate, missed = _rate(windows), _missed(windows)
            windows.clear()
            begin = time.monotonic()
            answer = palpation.load(name=name)
            assert answer.success, answer.message
            seconds = time.monotonic() - begin
            probe.spin(1.5)
            print(f"{name}, in use after {seconds:.1f} s: {_summary(windows)}")
            # tells a loop that goes on from one that waits for the compiler
            assert _rate(windows) > 0.6 * rate
            assert _missed(windows) < missed + 0.4
    finally:
        if palpation is not None:
            palpation.close()
        codes = [process.finish() for process in (contact, loader)]
    assert codes == [0, 0]


def _rate(windows: list[LoopStatistics]) -> float:
    """Periods per second."""
    return sum(w.periods for w in windows) / sum(w.window for w in windows)


def _missed(windows: list[LoopStatistics]) -> float:
    """Of the periods."""
    return sum(w.missed for w in windows) / sum(w.periods for w in windows)


def _summary(windows: list[LoopStatistics]) -> str:
    periods = sum(w.periods for w in windows)
    missed = sum(w.missed for w in windows)
    rate = periods / sum(w.window for w in windows)
    longest = 1e3 * max(w.period_max for w in windows)
    compute = 1e3 * max(w.compute_p99 for w in windows)
    return (
        f"{rate:.0f} Hz, {missed} of {periods} periods missed, longest {longest:.1f} ms, "
        f"step p99 {compute:.2f} ms"
    )
