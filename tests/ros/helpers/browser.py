"""A real browser on the planning page, and a user's actions there."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from avatar_ros.bench.cell import Module
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.orientation import FOV, Pose, basis, standard_view, view_beside
from tests.helpers.slowness import Deadline, end_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
TOKEN = "a-token-for-tests"  # token of the page
WINDOW = (1280, 800)  # [px]
SLOW = 300_000  # time limit for starts, compilation or builds on a busy machine [ms]
# software rendering: there is no graphics card here
OPTIONS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def shots_in(folder: Path) -> Path:
    """Return the folder of screenshots: AVATAR_SHOTS, if given."""
    path = Path(os.environ.get("AVATAR_SHOTS") or folder)
    path.mkdir(exist_ok=True)
    return path


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextmanager
def nodes_of_a_page(
    arguments: dict[str, list[str]], domain: dict[str, str]
) -> Iterator[dict[str, Module]]:
    """Run nodes by name; a test restarts those that it kills, and all end well."""
    running = {
        name: Module(name, ["--ros-args", *words], domain) for name, words in arguments.items()
    }
    try:
        yield running
    finally:  # a page that did not open leaves no nodes to other tests
        for process in running.values():
            process.send_signal(signal.SIGINT)
        # `finish` is impatient if a browser shares the cores with all of them
        codes = {name: end_of(process, 60.0) for name, process in running.items()}
    assert codes == dict.fromkeys(running, 0)


@contextmanager
def browsing(address: str, size: tuple[int, int] = WINDOW) -> Iterator[Any]:
    """Open a browser at an address of this machine; it may contact no other address."""
    from playwright.sync_api import Error, sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        page = context.new_page()
        page.set_default_timeout(SLOW)  # also for screenshots of a busy machine
        foreign: list[str] = []
        page.on("request", lambda asked: foreign.append(asked.url))
        for _ in range(60):
            try:
                page.goto(address)
                break
            except Error:  # not there yet
                page.wait_for_timeout(1000)
        yield page
        browser.close()
        local = ("http://127.0.0.1", "ws://127.0.0.1", "data:", "blob:")
        assert not [url for url in foreign if not url.startswith(local)]


def close_notices(page: Any) -> None:
    """Close the notices of slow software rendering."""
    from playwright.sync_api import Error

    page.wait_for_timeout(3000)
    for close in page.locator(".mantine-Notification-closeButton").all():
        with suppress(Error):  # it closed by itself
            close.click(timeout=2000)


@contextmanager
def opened(port: int, shots: Path) -> Iterator[Any]:
    """Open the page, and wait until an organ and all nodes are there."""
    with browsing(f"http://127.0.0.1:{port}/?token={TOKEN}") as page:
        try:
            page.get_by_text("is shown").wait_for(timeout=SLOW)
            page.get_by_text("All nodes answer").wait_for(timeout=SLOW)
        finally:
            page.screenshot(path=shots / "first.png")
        close_notices(page)
        yield page


def browse_in_idle_time() -> None:
    """Give the cores to all others first, as a browser on another machine would.

    Chromium raises the priority of drawing above that of ordinary processes, if it may.
    """
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended
            if (process / "comm").read_text().startswith("chrom"):
                for thread in (process / "task").iterdir():
                    os.sched_setscheduler(int(thread.name), os.SCHED_IDLE, os.sched_param(0))


def force_of(page: Any, tool: str = "") -> float:
    """Read the force on the page [N]; with several tools the named one's, 0 if not shown."""
    on = f"on {tool} " if tool else ""
    found = re.search(rf"Force {on}([\d.]+) N", page.inner_text("body"))
    return float(found[1]) if found else 0.0


def until(page: Any, reached: Callable[[], bool], what: str, seconds: float = 120.0) -> None:
    passed = Deadline(seconds)
    while not reached():
        assert not passed, f"{what}: not within {seconds:g} s; {page.inner_text('body')[:400]}"
        page.wait_for_timeout(250)


def first_pose(shown: Organ) -> Pose:
    """Return the camera's pose before the view was turned."""
    return standard_view("A", shown.centre, shown.size)


def beside_pose(shown: Organ) -> Pose:
    """Return the camera's pose beside the tool of a new organ."""
    return view_beside(shown.normal, shown.centre, shown.size)


def screen_of(page: Any, pose: Pose, point: np.ndarray) -> tuple[float, float]:
    """Return where a point [m] is on the page, seen by a camera [px]."""
    right, up, towards = basis(pose)
    box = page.locator("canvas").first.bounding_box()
    way = point - pose.position
    scale = 0.5 * box["height"] / np.tan(0.5 * FOV) / -(way @ towards)
    x = box["x"] + 0.5 * box["width"] + scale * (way @ right)
    return float(x), float(box["y"] + 0.5 * box["height"] - scale * (way @ up))


def look_beside(page: Any) -> None:
    page.keyboard.press("7")  # the view beside the chosen tool
    page.wait_for_timeout(1500)


def drag(page: Any, shown: Organ, begin: float, end: float) -> None:
    """Drag the tool from one height over the organ to another; the button stays down."""
    look_beside(page)
    drag_there(page, beside_pose(shown), shown.above(begin), shown.above(end))


def drag_there(page: Any, pose: Pose, begin: np.ndarray, end: np.ndarray) -> None:
    """Drag from a point to another [m], seen by a camera that is there already."""
    way = np.linspace(screen_of(page, pose, begin), screen_of(page, pose, end), 20)
    page.mouse.move(*way[0])
    page.wait_for_timeout(500)
    page.mouse.down()
    for x, y in way:
        page.mouse.move(x, y)
        page.wait_for_timeout(60)


def choose(page: Any, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def input_of(page: Any, label: str) -> Any:
    """Find the text, or the number beside a slider, by its label, which is none in HTML."""
    return (
        page.get_by_text(label, exact=True)
        .locator("xpath=ancestor::*[.//input[not(@type='hidden')]][1]//input[not(@type='hidden')]")
        .first
    )


def open_tab(page: Any, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()
    page.get_by_role("tab", name=name, exact=True, selected=True).wait_for()


def news(page: Any, text: str) -> None:
    """Wait until the page shows a message."""
    page.get_by_text(text).first.wait_for(timeout=SLOW)


def press(page: Any, button: str) -> None:
    page.get_by_role("button", name=button, exact=True).click()


def lift(page: Any) -> None:
    open_tab(page, "Tool")
    press(page, "Lift off the organ")
    until(page, lambda: force_of(page) == 0.0, "the organ left")


def pressed(page: Any, least: float = 0.5, tool: str = "") -> None:
    """Press the tool until the page shows this force [N]; a drag ends within 3 mm of its aim."""
    open_tab(page, "Tool")
    for _ in range(60):
        if force_of(page, tool) > least:
            return
        page.get_by_text("press 1 mm", exact=True).click()
        page.wait_for_timeout(300)
    raise AssertionError("no force")
