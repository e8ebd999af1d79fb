"""The planning page in a real browser: dragged, felt, recorded, and well again after a crash."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

import viser
from avatar_ros.bench.cell import Module
from avatar_ros.ui.organ import Organ
from rcl_interfaces.srv import ListParameters

from avatar_core.scene.recording import load_recording
from avatar_core.scene.replay import replay
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.ros.conftest import PATIENT
from tests.ros.helpers.browser import (
    CHROMIUM,
    SLOW,
    TOKEN,
    WINDOW,
    choose,
    drag,
    force_of,
    free_port,
    news,
    nodes_of_a_page,
    open_tab,
    opened,
    press,
    shots_in,
    until,
)
from tests.ros.helpers.doc_pages import parameter_rows

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.timing,  # a browser that draws without a graphics card takes both cores
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt install chromium"),
]

SIZES = (WINDOW, (900, 700), (1920, 1080))
TABS = ("Tool", "Organ", "Measure", "Plan", "Patient", "Scene", "Timing")
PROGRESS = re.compile(r"\n\w+: \d+%")
# What is seen of a page's controls: name, left, top, right, bottom [px].
CONTROLS = """() => [...document.querySelectorAll('button, input, [role=tab]')]
  .filter(e => e.checkVisibility() && e.getBoundingClientRect().width > 12)
  .map(e => [e.innerText || e.value || e.tagName, e.getBoundingClientRect()])
  .map(([name, r]) => [name, r.left, r.top, r.right, r.bottom])"""


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shots_in(tmp_path_factory.mktemp("shots"))


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def nodes(
    own_domain: dict[str, str], folder: Path, organ: Any, port: int
) -> Iterator[dict[str, Module]]:
    save_vademecum(organ, folder / "liver.h5")
    library = ["-p", f"library_dir:={folder}"]
    arguments = {
        "vademecum_loader": [*library, "-p", "vademecum:=liver.h5"],
        "contact": PATIENT[1:],
        "patient_interpolation": [
            *library,
            *("-p", f"atlas:={folder / 'atlas.h5'}", "-p", "vertices:=350"),
        ],
        "planning_ui": [*library, "-p", f"port:={port}", "-p", f"token:={TOKEN}"],
    }
    with nodes_of_a_page(arguments, own_domain) as running:
        yield running


@pytest.fixture(scope="module")
def page(nodes: dict[str, Module], port: int, shots: Path) -> Iterator[Any]:
    with opened(port, shots) as page:
        yield page


@pytest.fixture(scope="module")
def shown(folder: Path, nodes: Any) -> Organ:
    return Organ.of(load_vademecum(folder / "liver.h5"))


def displacement_of(page: Any) -> float:
    """The largest that the page says [mm]."""
    found = re.search(r"displacement ([\d.]+) mm", page.inner_text("body"))
    return float(found[1]) if found else 0.0


def test_a_drag_is_felt_and_the_surface_gives_way(page: Any, shown: Organ, shots: Path) -> None:
    page.screenshot(path=shots / "start.png")
    drag(page, shown, 0.020, -0.004)
    until(page, lambda: force_of(page) > 0.05, "a force")
    until(page, lambda: displacement_of(page) > 1.0, "a surface that gives way [mm]")
    page.wait_for_timeout(1500)
    page.screenshot(path=shots / "drag.png")
    page.mouse.up()
    press(page, "Lift off the organ")
    until(page, lambda: force_of(page) == 0.0, "the organ left")


def test_a_page_of_another_site_in_the_same_browser_is_refused(
    page: Any, port: int, folder: Path
) -> None:
    """On another port of this machine, to which the browser sends this page's cookie as well."""
    handler = partial(SimpleHTTPRequestHandler, directory="/dev/null")
    before = sorted(folder.iterdir())
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as site:
        Thread(target=site.serve_forever, daemon=True).start()
        other = page.context.new_page()
        other.goto(f"http://127.0.0.1:{site.server_address[1]}")
        answer = other.evaluate(
            """([port, version]) => new Promise(done => {
                const socket = new WebSocket(`ws://127.0.0.1:${port}`, [version]);
                socket.onopen = () => {  // then whatever it can send
                    for (let n = 0; n < 200; n++) socket.send(new Uint8Array([n]));
                    done("open");
                };
                socket.onerror = () => done("refused");
            })""",
            [port, f"viser-v{viser.__version__}"],
        )
        other.close()
        site.shutdown()
    assert answer == "refused" and sorted(folder.iterdir()) == before
    assert "All nodes answer" in page.inner_text("body")


def test_keys_move_the_tool(page: Any) -> None:
    page.mouse.click(60, 700)  # nothing is there, but the page listens
    for _ in range(60):
        page.keyboard.press("u")
        page.wait_for_timeout(400)  # a page that lags would press on, through the organ
        if force_of(page) > 0.05:
            break
    until(page, lambda: force_of(page) > 0.05, "a force", 5.0)
    press(page, "Lift off the organ")
    until(page, lambda: force_of(page) == 0.0, "the organ left")


def test_a_recording_replays(page: Any, shown: Organ, folder: Path) -> None:
    open_tab(page, "Tool")
    press(page, "Record")
    page.get_by_text("natural effects runs").wait_for(timeout=SLOW)
    page.wait_for_timeout(500)
    for _ in range(45):
        page.get_by_text("press 1 mm", exact=True).click()
        page.wait_for_timeout(60)
        if force_of(page) > 3.0:
            break
    page.wait_for_timeout(1000)
    press(page, "Lift off the organ")
    page.wait_for_timeout(1500)
    press(page, "Stop and save")
    page.get_by_text("recording-").wait_for(timeout=SLOW)
    (file,) = folder.glob("recording-*.h5")
    recording = load_recording(file)
    found = replay(recording, load_vademecum(folder / "liver.h5"))
    largest = np.linalg.norm(recording.periods.force, axis=2).max()
    print(
        f"{len(recording.periods)} periods, {recording.periods.lost.sum()} lost, "
        f"{len(recording.clouds.period)} clouds, largest force {largest:.2f} N, "
        f"{found.known.sum()} known, difference {found.difference(recording):.1e} N"
    )
    assert largest > 0.1
    assert found.known.mean() > 0.5
    assert found.difference(recording) <= 1e-9
    assert len(recording.clouds.period) > 5
    assert recording.clouds.displacement.max() > 1e-4


def test_effects_are_switched(page: Any, shots: Path) -> None:
    open_tab(page, "Scene")
    choose(page, "Scene", "relaxation")
    page.get_by_text("viscoelasticity").first.wait_for()
    press(page, "Switch to scene")
    page.get_by_text("relaxation runs, with viscoelasticity").wait_for(timeout=SLOW)
    page.screenshot(path=shots / "scene.png")


def settle(page: Any, misplaced: Callable[[], list[str]], tab: str) -> None:
    """Wait until nothing is misplaced any more."""
    for _ in range(40):
        found = misplaced()
        if not found:
            return
        page.wait_for_timeout(250)
    raise AssertionError(f"{tab}: {'; '.join(found)}")


def misplaced(boxes: list[Any], width: int) -> list[str]:
    """Controls that are missing, cut, or lie over others."""
    found = [] if len(boxes) >= len(TABS) else [f"{len(boxes)} controls"]
    found += [f"{b[0]} is cut" for b in boxes if b[1] < 0 or b[3] > width or b[2] < 0]
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            across = min(a[3], b[3]) - max(a[1], b[1])
            down = min(a[4], b[4]) - max(a[2], b[2])
            least = min(a[3] - a[1], b[3] - b[1]), min(a[4] - a[2], b[4] - b[2])
            within = across >= least[0] - 1 and down >= least[1] - 1  # arrows of a number
            if across >= 2 and down >= 2 and not within:
                found.append(f"{a[0]} lies over {b[0]}")
    return found


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_nothing_overlaps_or_is_cut(page: Any, shots: Path, size: tuple[int, int]) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.wait_for_timeout(1500)
    for tab in TABS:
        open_tab(page, tab)
        # a busy browser lays out late
        settle(page, lambda: misplaced(page.evaluate(CONTROLS), size[0]), tab)
        page.screenshot(path=shots / f"{tab}-{size[0]}.png")
    open_tab(page, "Tool")
    record = page.get_by_role("button", name="Record")

    def is_seen() -> bool:
        box = record.bounding_box()
        return box is not None and box["y"] + box["height"] <= size[1]

    until(page, is_seen, "Record on the screen", 10.0)
    page.set_viewport_size({"width": SIZES[0][0], "height": SIZES[0][1]})
    page.wait_for_timeout(1000)


def test_a_killed_contact_node_is_missed_and_found_again(
    page: Any, nodes: dict[str, Module], own_domain: dict[str, str], shots: Path
) -> None:
    open_tab(page, "Tool")
    nodes["contact"].send_signal(signal.SIGKILL)
    nodes["contact"].wait()
    page.get_by_text("The contact node is not running").wait_for(timeout=SLOW)
    page.screenshot(path=shots / "missing.png")
    nodes["contact"] = Module("contact", PATIENT, own_domain)
    page.get_by_text("All nodes answer").wait_for(timeout=SLOW)
    page.get_by_text("relaxation runs, with viscoelasticity").wait_for(timeout=SLOW)
    for _ in range(60):
        page.get_by_text("press 1 mm", exact=True).click()
        page.wait_for_timeout(100)
        if force_of(page) > 0.05:
            break
    until(page, lambda: force_of(page) > 0.05, "a force again")
    press(page, "Lift off the organ")


def test_a_patient_is_not_built_to_the_end_if_nobody_wants_it(page: Any, folder: Path) -> None:
    open_tab(page, "Patient")
    choose(page, "Surface", "liver3.obj")
    choose(page, "Fidelity", "solved")
    press(page, "Build patient")
    until(page, lambda: bool(PROGRESS.search(page.inner_text("body"))), "progress")
    press(page, "Cancel")
    news(page, "cancelled; no file was written")
    assert not list(folder.glob("liver3-*.h5"))
    choose(page, "Fidelity", "reduced")


def test_a_new_patient_is_built_and_shown(page: Any, shots: Path) -> None:
    open_tab(page, "Patient")
    choose(page, "Surface", "liver3.obj")
    press(page, "Build patient")
    until(page, lambda: bool(PROGRESS.search(page.inner_text("body"))), "progress")
    page.screenshot(path=shots / "patient.png")
    page.get_by_text("liver3 is shown").wait_for(timeout=SLOW)
    open_tab(page, "Organ")
    assert page.get_by_text("liver3", exact=True).count() >= 1
    page.screenshot(path=shots / "organ.png")


def test_a_file_of_the_library_is_loaded_and_shown(page: Any, shown: Organ) -> None:
    open_tab(page, "Organ")
    choose(page, "Vademecum", "liver.h5")
    press(page, "Load vademecum")
    page.get_by_text(shown.name, exact=True).wait_for(timeout=SLOW)


def test_parameters_are_those_of_the_page(page: Any, lasting_probe: Any) -> None:
    request = ListParameters.Request()
    listed = lasting_probe.ask(ListParameters, "/planning_ui/list_parameters", request)
    declared = set(listed.result.names) - {"use_sim_time", "start_type_description_service"}
    assert declared == set(parameter_rows("planning_ui"))
