"""The planning page in a real browser: dragged, pressed, and working again after a crash.

One cell for all tests, in this order: later tests see the state that earlier ones leave.
"""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum
from avatar_interfaces.srv import LoadVademecum
from avatar_ros.bench.cell import Module
from avatar_ros.ui.session.shown_period import SILENT
from avatar_ros.ui.view.organ import Organ
from tests.helpers.slowness import Deadline
from tests.ros.conftest import PATIENT, Probe
from tests.ros.helpers.browser import (
    SLOW,
    TOKEN,
    WINDOW,
    choose,
    close_notices,
    drag,
    force_of,
    input_of,
    lift,
    news,
    open_tab,
    press,
    pressed,
    until,
)
from tests.ros.helpers.doc_pages import parameter_rows
from tests.ros.helpers.page import image
from tests.ros.helpers.parameters import parameter_names, parameter_values
from tests.ros.helpers.sick_organ import sick_organ

pytestmark = pytest.mark.long

SIZES = (WINDOW, (900, 700), (1920, 1080))
TABS = ("Tool", "Organ", "Measure", "Plan", "Patient", "Scene")
PROGRESS = re.compile(r"\n\w+: \d+%")
# visible controls of a page: name, left, top, right, bottom [px]
CONTROLS = """() => [...document.querySelectorAll('button, input, [role=tab]')]
  .filter(e => e.checkVisibility() && e.getBoundingClientRect().width > 12)
  .map(e => [e.innerText || e.value || e.tagName, e.getBoundingClientRect()])
  .map(([name, r]) => [name, r.left, r.top, r.right, r.bottom])"""
# elements without a name, and text with a contrast below 4.5:1 (WCAG 2.1)
UNNAMED = """() => [...document.querySelectorAll('button, canvas, input, [role=slider]')]
  .filter(e => e.checkVisibility() && e.ariaHidden != 'true')
  .filter(e => !(e.ariaLabel || e.innerText || e.labels?.length)).map(e => e.outerHTML)"""
PALE = """() => {
  const context = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  const over = (colours) => {
    context.fillStyle = '#fff';
    for (const colour of ['#fff', ...colours]) {
      context.fillStyle = colour;
      context.fillRect(0, 0, 1, 1);
    }
    const light = [...context.getImageData(0, 0, 1, 1).data].slice(0, 3).map(v => v / 255)
      .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.05 + 0.2126 * light[0] + 0.7152 * light[1] + 0.0722 * light[2];
  };
  const pale = (e, text) => {
    const grounds = [];
    for (let one = e; one; one = one.parentElement)
      grounds.unshift(getComputedStyle(one).backgroundColor);
    const [ground, ink] = [over(grounds), over([...grounds, getComputedStyle(e).color])];
    const ratio = Math.max(ground, ink) / Math.min(ground, ink);
    return ratio < 4.5 ? [`${text}: ${ratio.toFixed(1)}`] : [];
  };
  return [...document.querySelectorAll('#root *')].filter(e => e.checkVisibility()).flatMap(e => {
    const own = [...e.childNodes].filter(n => n.nodeType == 3).map(n => n.data).join('').trim();
    return own || e.value ? pale(e, own || e.value) : [];
  });
}"""
# position of the cube while viser moves the panel, as it does when the window changes
CUBE_WHILE_GLIDING = """() => {
  const panel = document.querySelector('[data-dock-column]');
  panel.style.transform = 'translateX(-300px)';
  const place = document.querySelector('[data-facing]').getBoundingClientRect();
  panel.style.transform = '';
  return place;
}"""
CHOSEN_BY_ANOTHER = 150e3  # Young's modulus [Pa], as the contact node is started
DEEP = -0.002  # height of the tip's centre over the surface, while it presses [m]
ENOUGH = 3.0  # force that remains while the tool swings [N]


@pytest.fixture(scope="module")
def contact() -> list[str]:
    return ["-p", f"material.young_modulus:={CHOSEN_BY_ANOTHER}"]


@pytest.fixture(scope="module")
def folder(folder: Path) -> Path:
    save_vademecum(sick_organ(), folder / "sick.h5")
    image(folder / "ct.nii.gz", *ct_of(sick_organ()))
    return folder


def ct_of(organ: Vademecum) -> tuple[np.ndarray, np.ndarray]:
    """Return an image of tissue in fat [HU], on the organ's distance grid, with its place."""
    field = organ.tip_field
    affine = np.diag([*np.full(3, 1e3 * field.spacing[0]), 1.0])
    affine[:3, 3] = 1e3 * np.asarray(field.origin)
    return np.where(np.asarray(field.distance) < 0.0, 60, -600).astype(np.int16), affine


def test_what_another_client_chose_is_shown(page: Any) -> None:
    open_tab(page, "Organ")
    shown = input_of(page, "E [kPa]")
    until(page, lambda: shown.input_value() == f"{CHOSEN_BY_ANOTHER / 1e3:g}", "the value", 30.0)


def displacement_of(page: Any) -> float:
    """Read the largest displacement on the page [mm]."""
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


def test_keys_move_the_tool(page: Any) -> None:
    page.mouse.click(60, 700)  # nothing is there, but the page listens
    for _ in range(60):
        page.keyboard.press("u")
        page.wait_for_timeout(400)  # a slow page would press on, through the organ
        if force_of(page) > 0.05:
            break
    until(page, lambda: force_of(page) > 0.05, "a force", 5.0)
    lift(page)


def test_a_list_that_was_chosen_from_gives_the_keys_back_to_the_tool(page: Any) -> None:
    open_tab(page, "Organ")
    choose(page, "Show organ", "glass")
    for _ in range(60):
        page.keyboard.press("u")
        page.wait_for_timeout(400)
        if force_of(page) > 0.05:
            break
    assert page.get_by_label("Show organ", exact=True).input_value() == "glass"
    assert force_of(page) > 0.05
    choose(page, "Show organ", "whole")
    lift(page)


# --- When something is slow -------------------------------------------------------------------


@contextmanager
def held(page: Any, shown: Organ) -> Iterator[str]:
    """Press the tool until its number of newtons [N] stands still."""
    drag(page, shown, 0.020, -0.004)
    page.mouse.up()
    pressed(page, ENOUGH)
    until(page, lambda: is_still(page), "a tool at rest")
    try:
        yield numbers(page)
    finally:
        lift(page)


def is_still(page: Any) -> bool:
    before = numbers(page)
    page.wait_for_timeout(3000)  # a busy page is late
    return numbers(page) == before


def numbers(page: Any) -> str:
    """Read force, its error and displacement, as the panel writes them."""
    return "\n".join(page.inner_text("#numbers").splitlines()[:2])


def driver_of(node: Module) -> int:
    """Return the process that sends the poses of the page."""
    children = Path(f"/proc/{node.pid}/task").glob("*/children")
    for child in (int(word) for path in children for word in path.read_text().split()):
        if "tool_driver" in Path(f"/proc/{child}/cmdline").read_text():
            return child
    raise AssertionError("no tool driver")


def test_a_driver_that_stands_still_leaves_no_number_and_comes_back_as_it_was(
    page: Any, shown: Organ, nodes: dict[str, Module], shots: Path
) -> None:
    driver = driver_of(nodes["planning_ui"])
    with held(page, shown) as before:
        os.kill(driver, signal.SIGSTOP)
        try:
            news(page, f"No force: {SILENT}")
            assert "No force, no displacement" in numbers(page)
            page.wait_for_timeout(5000)
            page.screenshot(path=shots / "driver-stopped.png")
        finally:
            os.kill(driver, signal.SIGCONT)
        until(page, lambda: numbers(page) == before, f"again {before}", 30.0)


def test_slow_poses_are_no_force_of_zero(
    page: Any, shown: Organ, nodes: dict[str, Module], shots: Path
) -> None:
    driver = driver_of(nodes["planning_ui"])
    with held(page, shown) as before:
        seen: list[str] = []
        passed = Deadline(120.0)
        while len(seen) < 20 or not (passed or any("No force" in text for text in seen)):
            os.kill(driver, signal.SIGSTOP)
            page.wait_for_timeout(150)
            os.kill(driver, signal.SIGCONT)
            seen.append(numbers(page))
            page.wait_for_timeout(2)
        page.screenshot(path=shots / "slow-poses.png")
        assert any("No force" in text for text in seen)
        assert not [text for text in seen if "0.00 N" in text]
        until(page, lambda: numbers(page) == before, f"again {before}", 30.0)


# --- An organ with a tumour -------------------------------------------------------------------


def in_force(probe: Probe, name: str) -> float:
    name = f"material.{name}"
    return float(parameter_values(probe, "contact", [name])[name])


def vermilion(page: Any, shot: Path) -> np.ndarray:
    """Return pixels of the tumour, not of tissue, (n, 2): down, right."""
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


def test_a_slider_is_felt(page: Any, shots: Path, lasting_probe: Probe) -> None:
    pressed(page)
    open_tab(page, "Organ")
    before = force_of(page)
    box = input_of(page, "Tumour / E [-]")
    box.fill("15")
    box.press("Enter")
    until(
        page,
        lambda: abs(in_force(lasting_probe, "contrast") / 15.0 - 1.0) < 0.02,
        "contrast of the contact node",
        30.0,
    )
    until(page, lambda: abs(force_of(page) - before) > 0.005, "another force", 30.0)
    page.screenshot(path=shots / "contrast.png")


def dark_part(page: Any, shot: Path) -> float:
    """Return the fraction of the picture, left of the panel, as black as air in an image."""
    from PIL import Image

    page.wait_for_timeout(1000)
    page.screenshot(path=shot)
    seen = np.asarray(Image.open(shot).convert("RGB"))
    return float((seen[:, : seen.shape[1] // 2] < 12).all(axis=2).mean())


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_an_image_is_seen_until_it_is_put_away(
    page: Any, shots: Path, size: tuple[int, int]
) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    open_tab(page, "Organ")
    page.get_by_text("CT or MR", exact=True).click()
    choose(page, "Image", "ct.nii.gz")
    choose(page, "See", "axial")
    news(page, "Image ct.nii.gz: check that it is of this patient")
    settle(page, lambda: page.evaluate(PALE), "Organ")
    until(page, lambda: dark_part(page, shots / f"image-axial-{size[0]}.png") > 0.1, "the plane")
    choose(page, "See", "all planes")
    page.mouse.click(60, size[1] - 100)  # nothing is there, but the page listens
    page.keyboard.press("1")  # from the front
    until(page, lambda: dark_part(page, shots / f"image-{size[0]}.png") > 0.1, "all planes")
    choose(page, "Image", "none")
    until(page, lambda: dark_part(page, shots / "no-image.png") < 0.02, "no plane")
    page.get_by_text("CT or MR", exact=True).click()  # closed again, and the tab at its top
    page.mouse.move(size[0] - 100, size[1] - 150)
    page.mouse.wheel(0, -4000)
    page.set_viewport_size({"width": SIZES[0][0], "height": SIZES[0][1]})
    page.wait_for_timeout(1000)


def test_a_report_is_read_at_any_size(page: Any, shots: Path) -> None:
    pressed(page)
    open_tab(page, "Plan")
    input_of(page, "Note").fill("over the tumour")
    input_of(page, "Note").press("Enter")
    press(page, "Keep this state")
    news(page, "kept in plan-")
    press(page, "HTML")
    with page.expect_download() as coming:
        page.locator("a[download]").click()
    close_notices(page)
    assert re.fullmatch(r"report-\w+-[\d-]+\.html", coming.value.suggested_filename)
    coming.value.save_as(shots / "report.html")
    read = page.context.new_page()
    for size in SIZES:
        read.set_viewport_size({"width": size[0], "height": size[1]})
        read.set_content((shots / "report.html").read_text())
        picture = read.locator("img")
        assert picture.evaluate("e => e.naturalWidth") >= 1600
        assert read.evaluate("document.documentElement.scrollWidth") <= size[0]
        assert "over the tumour" in read.inner_text("body")
        read.screenshot(path=shots / f"report-{size[0]}.png", full_page=True)
    read.close()
    lift(page)


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
    news(page, "scene in use: relaxation (viscoelasticity)")
    page.screenshot(path=shots / "scene.png")


def settle(page: Any, misplaced: Callable[[], list[str]], tab: str) -> None:
    """Wait until nothing is misplaced."""
    for _ in range(40):
        found = misplaced()
        if not found:
            return
        page.wait_for_timeout(250)
    raise AssertionError(f"{tab}: {'; '.join(found)}")


def misplaced(boxes: list[Any], width: int) -> list[str]:
    """List controls that are missing, cut, or lie over others."""
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


def begins_below_the_top(part: Any) -> bool:
    """Return whether it begins below the top; not while it is drawn anew, without a box."""
    box = part.bounding_box()
    return box is not None and box["y"] > 0


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_nothing_overlaps_or_is_cut(page: Any, shots: Path, size: tuple[int, int]) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.wait_for_timeout(1500)
    for tab in TABS:
        open_tab(page, tab)
        # a busy browser lays out late
        settle(page, lambda: misplaced(page.evaluate(CONTROLS), size[0]), tab)
        settle(page, lambda: page.evaluate(UNNAMED), tab)
        assert page.get_by_role("button", name="Commands").is_visible()
        assert not page.locator("button:has(.tabler-icon-adjustments)").is_visible()
        settle(page, lambda: page.evaluate(PALE), tab)
        page.screenshot(path=shots / f"{tab}-{size[0]}.png")
        page.mouse.move(size[0] - 100, size[1] - 150)  # over the tab, whose end is seen then
        page.mouse.wheel(0, 2000)
        until(page, lambda: begins_below_the_top(page.locator("#numbers")), "numbers in view", 10.0)
    assert page.evaluate(CUBE_WHILE_GLIDING)["left"] < 30
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
    news(page, "scene in use: relaxation (viscoelasticity)")
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
    use = page.get_by_role("button", name="Use liver3")
    use.wait_for(timeout=SLOW)
    page.screenshot(path=shots / "built.png")
    use.click()
    news(page, "liver3 is shown")
    open_tab(page, "Organ")
    assert page.get_by_text("liver3", exact=True).count() >= 1
    page.screenshot(path=shots / "organ.png")


def test_parameters_are_those_of_the_page(page: Any, lasting_probe: Any) -> None:
    assert parameter_names(lasting_probe, "planning_ui") == set(parameter_rows("planning_ui"))


def test_a_tab_says_that_its_cell_was_started_again(
    page: Any, nodes: dict[str, Module], own_domain: dict[str, str], folder: Path, port: int
) -> None:
    def start_again(token: str) -> None:
        nodes["planning_ui"].kill()
        nodes["planning_ui"].wait()
        given = [f"library_dir:={folder}", f"port:={port}", f"token:={token}"]
        words = [word for one in given for word in ("-p", one)]
        nodes["planning_ui"] = Module("planning_ui", ["--ros-args", *words], own_domain)

    over = page.locator("#restarted")
    start_again("another")
    over.get_by_text("started again and has another address").wait_for(timeout=SLOW)
    start_again(TOKEN)
    news(page, "is shown")
    over.wait_for(state="hidden", timeout=SLOW)
    assert page.evaluate("performance.getEntriesByType('navigation')[0].type") == "reload"
