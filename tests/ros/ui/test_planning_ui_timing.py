"""The loop keeps its figures while the planning page is open and its tool dragged."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.ui.organ import Organ

from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from avatar_ros.msg import LoopStatistics
from tests.ros.conftest import PATIENT, Probe
from tests.ros.helpers.browser import (
    CHROMIUM,
    TOKEN,
    beside_pose,
    browse_in_idle_time,
    drag,
    force_of,
    free_port,
    news,
    nodes_of_a_page,
    opened,
    pressed,
    screen_of,
    shots_in,
    until,
)

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.timing,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt install chromium"),
]

DEEP = -0.002  # of the tip's centre over the surface, while it presses [m]
ENOUGH = 3.0  # force that stays one while the tool swings [N]
SWING = 10.0  # of the mouse [px]
SECONDS = 10.0  # of a measurement
PRIORITY = 80  # of the loop: without one, cores are shared by whoever runs


@pytest.fixture(scope="module")
def folder(organ: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("timing")
    save_vademecum(organ, folder / "liver.h5")
    return folder


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def nodes(folder: Path, own_domain: dict[str, str], port: int) -> Iterator[dict[str, Module]]:
    library = ["-p", f"library_dir:={folder}"]
    arguments = {
        "vademecum_loader": [*library, "-p", "vademecum:=liver.h5"],
        "contact": [*PATIENT[1:], "-p", f"realtime.priority:={PRIORITY}"],
        "planning_ui": [*library, "-p", f"port:={port}", "-p", f"token:={TOKEN}"],
    }
    with nodes_of_a_page(arguments, own_domain) as running:
        yield running


@pytest.fixture(scope="module")
def page(nodes: Any, port: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with opened(port, shots_in(tmp_path_factory.mktemp("shots"))) as page:
        yield page


def figures(probe: Probe, meanwhile: Callable[[], None]) -> np.ndarray:
    """Rate [Hz], share of the periods on time, and p50 of a step [s]: medians of the windows."""
    windows: list[tuple[float, float, float]] = []

    def note(window: LoopStatistics) -> None:
        on_time = 1.0 - window.missed / max(window.periods, 1)
        windows.append((window.rate, on_time, window.step_p50))

    subscription = probe.node.create_subscription(
        LoopStatistics, "statistics", note, qos.STATISTICS
    )
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        meanwhile()
        probe.spin(0.02)
    probe.node.destroy_subscription(subscription)
    return np.median(windows[1:-1], axis=0)


def test_the_loop_keeps_its_figures_while_the_page_is_dragged(
    page: Any, folder: Path, nodes: dict[str, Module], lasting_probe: Probe
) -> None:
    """In turns, since a machine's neighbours come and go; the tool presses all the time.

    A planner's browser draws on his own machine: what it takes from the loop on this one is not
    what the page's node takes, so that it draws in both halves.
    """
    shown = Organ.of(load_vademecum(folder / "liver.h5"))
    drag(page, shown, 0.020, DEEP)
    page.mouse.up()
    pressed(page, ENOUGH)
    browse_in_idle_time()
    page.keyboard.press("7")  # the view beside the tool
    page.wait_for_timeout(1500)
    found = []
    for _ in range(3):
        with stopped(nodes["planning_ui"]):
            without = swung(page, shown, lasting_probe)
        news(page, "All nodes answer")
        pressed(page, ENOUGH)
        found.append((without, dragged(page, shown, lasting_probe)))
    without, beside = np.median(found, axis=0)
    for name, (rate, on_time, step) in (("without", without), ("dragged", beside)):
        print(f"{name}: {rate:.0f} Hz, {on_time:.2%} on time, {1e6 * step:.0f} us a step")
    assert abs(beside[0] / without[0] - 1.0) < 0.1
    assert beside[1] > 0.9 * without[1]
    assert beside[2] < 1.1 * without[2]


@contextmanager
def stopped(node: Module) -> Iterator[None]:
    """A node that stands still meanwhile."""
    node.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        node.send_signal(signal.SIGCONT)


def dragged(page: Any, shown: Organ, probe: Probe) -> np.ndarray:
    """Figures while the mouse swings the tool about where it presses."""
    found = swung(page, shown, probe)
    until(page, lambda: force_of(page) > 0.05, "a force after it swung", 20.0)
    return found


def swung(page: Any, shown: Organ, probe: Probe) -> np.ndarray:
    """Figures while the mouse swings about the tool, whether or not the page's node follows."""
    x, y = screen_of(page, beside_pose(shown), shown.above(DEEP))
    swing = iter(SWING * np.sin(np.arange(100_000) / 5.0))
    page.mouse.move(x, y)
    page.mouse.down()
    found = figures(probe, lambda: page.mouse.move(x, y + next(swing)))
    page.mouse.move(x, y)
    page.mouse.up()
    return found
