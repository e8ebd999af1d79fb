"""The planning page in a real browser against the clock: the loop beside it, and a slow browser."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from avatar_interfaces.msg import LoopStatistics
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.ui.view.organ import Organ
from tests.ros.conftest import Probe
from tests.ros.helpers.browser import (
    beside_pose,
    browse_in_idle_time,
    drag,
    force_of,
    lift,
    news,
    pressed,
    screen_of,
    until,
)

# a browser that draws without a graphics card takes both cores
pytestmark = [pytest.mark.long, pytest.mark.timing]

DEEP = -0.002  # height of the tip's centre over the surface, while it presses [m]
ENOUGH = 3.0  # force that remains while the tool swings [N]
SWING = 10.0  # way of the mouse [px]
SECONDS = 6.0  # duration of a measurement
PRIORITY = 80  # the loop's; without a priority, all processes share the cores


@pytest.fixture(scope="module")
def contact() -> list[str]:
    return ["-p", f"realtime.priority:={PRIORITY}"]


def figures(probe: Probe, meanwhile: Callable[[], None]) -> np.ndarray:
    """Return rate [Hz] and fraction of periods on time: medians of the windows."""
    windows: list[tuple[float, float]] = []

    def note(window: LoopStatistics) -> None:
        on_time = 1.0 - window.missed / max(window.periods, 1)
        windows.append((window.rate, on_time))

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
    page: Any, shown: Organ, nodes: dict[str, Module], lasting_probe: Probe
) -> None:
    """Measured in turns, since a machine's neighbors come and go; the tool presses all the time.

    A planner's browser draws on another machine. Its load on this one does not count as that of
    the page's node, so the browser draws in both halves.
    """
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
    for name, (rate, on_time) in (("without", without), ("dragged", beside)):
        print(f"{name}: {rate:.0f} Hz, {on_time:.2%} on time")
    assert abs(beside[0] / without[0] - 1.0) < 0.1
    assert beside[1] > 0.9 * without[1]


@contextmanager
def stopped(node: Module) -> Iterator[None]:
    """Stop a node meanwhile."""
    node.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        node.send_signal(signal.SIGCONT)


def dragged(page: Any, shown: Organ, probe: Probe) -> np.ndarray:
    """Measure while the mouse swings the tool about where it presses."""
    found = swung(page, shown, probe)
    until(page, lambda: force_of(page) > 0.05, "a force after it swung", 20.0)
    return found


def swung(page: Any, shown: Organ, probe: Probe) -> np.ndarray:
    """Measure while the mouse swings about the tool, whether or not the page's node follows."""
    x, y = screen_of(page, beside_pose(shown), shown.above(DEEP))
    swing = iter(SWING * np.sin(np.arange(100_000) / 5.0))
    page.mouse.move(x, y)
    page.mouse.down()
    found = figures(probe, lambda: page.mouse.move(x, y + next(swing)))
    page.mouse.move(x, y)
    page.mouse.up()
    return found


def test_a_browser_that_is_slow_shows_what_is_now(page: Any, shown: Organ) -> None:
    """With a tenth of its processor it neither lags nor stores pictures not drawn yet."""
    browser = page.context.new_cdp_session(page)
    heap = []
    drag(page, shown, 0.020, DEEP)
    browser.send("Emulation.setCPUThrottlingRate", {"rate": 10})
    for k in range(20):
        page.mouse.move(640 + 5 * (k % 2), 400)
        page.wait_for_timeout(500)
        heap.append(page.evaluate("performance.memory.usedJSHeapSize"))
    begin = time.monotonic()
    page.mouse.up()
    lift(page)
    lag = time.monotonic() - begin
    browser.send("Emulation.setCPUThrottlingRate", {"rate": 1})
    print(f"lag {lag:.1f} s, heap {min(heap) / 1e6:.0f} to {max(heap) / 1e6:.0f} MB")
    assert lag < 10.0
    assert max(heap[10:]) < 1.5 * max(heap[:10])
