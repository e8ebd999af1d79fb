"""The planning page in a real browser: dragged, felt, recorded, and well again after a crash.

One cell for all tests, in this order: what a test leaves behind, the next ones bear.
"""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
import viser
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.ui.organ import Organ
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python

from avatar_core.scene.recording import load_recording
from avatar_core.scene.replay import replay
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from avatar_ros.msg import LoopStatistics
from avatar_ros.srv import LoadVademecum
from tests.ros.conftest import PATIENT, Probe
from tests.ros.helpers.browser import (
    SLOW,
    WINDOW,
    beside_pose,
    browse_in_idle_time,
    choose,
    drag,
    force_of,
    input_of,
    lift,
    news,
    open_tab,
    press,
    pressed,
    screen_of,
    until,
)
from tests.ros.helpers.doc_pages import parameter_rows
from tests.ros.helpers.sick_organ import sick_organ

# A browser that draws without a graphics card takes both cores.
pytestmark = [pytest.mark.long, pytest.mark.timing]

SIZES = (WINDOW, (900, 700), (1920, 1080))
TABS = ("Tool", "Organ", "Measure", "Plan", "Patient", "Scene", "Timing")
PROGRESS = re.compile(r"\n\w+: \d+%")
# What is seen of a page's controls: name, left, top, right, bottom [px].
CONTROLS = """() => [...document.querySelectorAll('button, input, [role=tab]')]
  .filter(e => e.checkVisibility() && e.getBoundingClientRect().width > 12)
  .map(e => [e.innerText || e.value || e.tagName, e.getBoundingClientRect()])
  .map(([name, r]) => [name, r.left, r.top, r.right, r.bottom])"""
CHOSEN_BY_ANOTHER = 150e3  # Young's modulus [Pa], as the contact node is started
DEEP = -0.002  # of the tip's centre over the surface, while it presses [m]
ENOUGH = 3.0  # force that stays one while the tool swings [N]
SWING = 10.0  # of the mouse [px]
SECONDS = 10.0  # of a measurement
PRIORITY = 80  # of the loop: without one, cores are shared by whoever runs


@pytest.fixture(scope="module")
def contact() -> list[str]:
    chosen = {"material.young_modulus": CHOSEN_BY_ANOTHER, "realtime.priority": PRIORITY}
    return [word for name, value in chosen.items() for word in ("-p", f"{name}:={value}")]


@pytest.fixture(scope="module")
def folder(folder: Path) -> Path:
    save_vademecum(sick_organ(), folder / "sick.h5")
    return folder


def test_what_another_client_chose_is_shown(page: Any) -> None:
    open_tab(page, "Organ")
    shown = input_of(page, "E [kPa]")
    until(page, lambda: shown.input_value() == f"{CHOSEN_BY_ANOTHER / 1e3:g}", "the value", 30.0)


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
    lift(page)


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
    lift(page)


def test_a_recording_replays(page: Any, shown: Organ, folder: Path) -> None:
    open_tab(page, "Tool")
    press(page, "Record")
    news(page, "natural effects runs")
    pressed(page)
    page.wait_for_timeout(1000)
    lift(page)
    press(page, "Stop and save")
    news(page, "recording-")
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


# --- The loop beside the page -----------------------------------------------------------------


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
    page: Any, shown: Organ, nodes: dict[str, Module], lasting_probe: Probe
) -> None:
    """In turns, since a machine's neighbours come and go; the tool presses all the time.

    A planner's browser draws on his own machine: what it takes from the loop on this one is not
    what the page's node takes, so that it draws in both halves.
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


# --- An organ with a tumour -------------------------------------------------------------------


def in_force(probe: Probe, name: str) -> float:
    request = GetParameters.Request(names=[f"material.{name}"])
    (value,) = probe.ask(GetParameters, "/contact/get_parameters", request).values
    return float(parameter_value_to_python(value))


def vermilion(page: Any, shot: Path) -> np.ndarray:
    """Pixels of the tumour, not of tissue, (n, 2): down, right."""
    from PIL import Image

    page.screenshot(path=shot)
    left = np.asarray(Image.open(shot).convert("RGB"))[:, :900].astype(float)
    red, green, blue = np.moveaxis(left, 2, 0)
    return np.argwhere((red > 1.5 * green) & (red > 2.6 * blue))  # tissue is twice as red as blue


def test_an_organ_that_another_client_loads_is_shown_with_its_tumour(
    page: Any, shots: Path, lasting_probe: Probe
) -> None:
    request = LoadVademecum.Request(name="sick.h5")
    assert lasting_probe.ask(LoadVademecum, "load_vademecum", request).success
    news(page, "sick is shown")
    page.mouse.click(60, 700)  # nothing is there, but the page listens
    page.keyboard.press("1")  # from the front
    until(page, lambda: len(vermilion(page, shots / "tumour.png")) > 500, "the tumour", 60.0)


@pytest.mark.parametrize(
    ("label", "name", "value", "unit"),
    [
        ("E [kPa]", "young_modulus", 300.0, 1e3),
        ("nu [-]", "poisson_ratio", 0.42, 1.0),
        ("Tumour / E [-]", "contrast", 15.0, 1.0),
    ],
)
def test_a_slider_is_felt(
    page: Any, shots: Path, lasting_probe: Probe, label: str, name: str, value: float, unit: float
) -> None:
    pressed(page)
    open_tab(page, "Organ")
    before = force_of(page)
    box = input_of(page, label)
    box.fill(f"{value:g}")
    box.press("Enter")
    until(
        page,
        lambda: abs(in_force(lasting_probe, name) / (unit * value) - 1.0) < 0.02,
        f"{name} of the contact node",
        30.0,
    )
    change = 0.2 if name == "young_modulus" else 0.005
    until(page, lambda: abs(force_of(page) - before) > change, "another force", 30.0)
    page.screenshot(path=shots / f"{name}.png")


def test_a_file_of_the_library_is_loaded_and_shown_without_a_tumour(
    page: Any, shots: Path, shown: Organ
) -> None:
    open_tab(page, "Organ")
    choose(page, "Vademecum", "liver.h5")
    press(page, "Load vademecum")
    page.get_by_text(shown.name, exact=True).wait_for(timeout=SLOW)
    until(page, lambda: len(vermilion(page, shots / "healthy.png")) == 0, "no tumour", 60.0)


# --- The whole page ---------------------------------------------------------------------------


def test_effects_are_switched(page: Any, shots: Path) -> None:
    open_tab(page, "Scene")
    choose(page, "Scene", "relaxation")
    page.get_by_text("viscoelasticity").first.wait_for()
    press(page, "Switch to scene")
    news(page, "relaxation runs, with viscoelasticity")
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
    news(page, "The contact node is not running")
    page.screenshot(path=shots / "missing.png")
    nodes["contact"] = Module("contact", PATIENT, own_domain)
    news(page, "All nodes answer")
    news(page, "relaxation runs, with viscoelasticity")
    pressed(page, 0.05)
    lift(page)


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
    news(page, "liver3 is shown")
    open_tab(page, "Organ")
    assert page.get_by_text("liver3", exact=True).count() >= 1
    page.screenshot(path=shots / "organ.png")


def test_parameters_are_those_of_the_page(page: Any, lasting_probe: Any) -> None:
    request = ListParameters.Request()
    listed = lasting_probe.ask(ListParameters, "/planning_ui/list_parameters", request)
    declared = set(listed.result.names) - {"use_sim_time", "start_type_description_service"}
    assert declared == set(parameter_rows("planning_ui"))
