"""A planner's session on the page: what is done there, and what the page says and writes."""

from __future__ import annotations

import json
import os
import re
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from avatar_ros.bench.footprint import Footprint, footprints
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.orientation import FOV, Pose, basis

from avatar_core.geometry.level_set import grid_points
from avatar_core.geometry.phantom import BOX, liver_level_set
from avatar_core.geometry.tip import Tip
from avatar_core.scene.recording import load_recording
from avatar_core.vademecum.storage import load_vademecum
from tests.ros.helpers.browser import (
    SLOW,
    choose,
    drag_there,
    first_pose,
    force_of,
    input_of,
    lift,
    news,
    open_tab,
    press,
    screen_of,
    until,
)

ASKED = os.environ.get("AVATAR_SESSION_MINUTES", "")
ORGAN, TUMOUR = 1, 2  # labels
VOXEL = 3e-3  # [m]
CENTRE, RADIUS = np.array([0.02, 0.045, -0.01]), 0.010  # of the tumour [m]
BESIDE = np.array([-0.018, 0.0, 0.0])  # from over the tumour to where the tool presses [m]
DEPTH = 3  # of the tip below the surface [mm]
PLANE = np.array([[-0.02, 0.03], [-0.02, -0.03], [-0.026, 0.0]])  # from the tumour, x and z [m]
PROBE = np.array([-0.018, 0.014])  # the same
NOTE = "beside the tumour"
MINUTES = float(ASKED or "0")  # of rounds, at least two
# Notes when the middle of the canvas first shows something; the buffer is kept to be read.
WATCH = """
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, given) {
  return get.call(this, kind, { ...given, preserveDrawingBuffer: true });
};
const small = new OffscreenCanvas(8, 8);
const look = () => {
  const canvas = [...document.querySelectorAll("canvas")].find(one => one.width > 400);
  if (canvas) {
    const pen = small.getContext("2d", { willReadFrequently: true });
    const { width, height } = canvas;
    pen.drawImage(canvas, 0.45 * width, 0.45 * height, 0.1 * width, 0.1 * height, 0, 0, 8, 8);
    const [red, green, blue, seen] = pen.getImageData(4, 4, 1, 1).data;
    if (seen > 0 && Math.min(red, green, blue) < 250) {
      window.firstPicture = performance.now();
      return;
    }
  }
  requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""


def labels() -> nibabel.Nifti1Image:
    """The phantom with a ball in it, with axes as a scanner has them: left, posterior, superior."""
    shape = np.ceil((np.array(BOX[1]) - BOX[0]) / VOXEL).astype(int) + 1
    points = grid_points(np.array(BOX[0]), VOXEL, shape.tolist())
    found = np.where(liver_level_set(points) < 0.0, ORGAN, 0)
    found[np.linalg.norm(points - CENTRE, axis=1) < RADIUS] = TUMOUR
    affine = np.diag([-1e3 * VOXEL, -1e3 * VOXEL, 1e3 * VOXEL, 1.0])
    affine[:3, 3] = 1e3 * (np.array(BOX[0]) + VOXEL * (shape - 1) * [1, 1, 0])
    turned = found.reshape(shape)[::-1, ::-1].astype(np.uint8)
    return nibabel.Nifti1Image(np.ascontiguousarray(turned), affine)


@dataclass
class Session:
    """What the page said and wrote.

    seconds : of the build, and to each first picture
    tip : where the tool's tip was [m]; clicks : rays of the clicks, origin and direction [m]
    numbers, measures : lines of the page while the tool pressed; back : measures on the return
    rest, pressed : exported files by suffix and structure
    played : part of the recording that was shown, and lines and alerts then
    memory : footprints of the nodes, and the heap of the page [MB], after each round
    """

    folder: Path
    built_in: float = 0.0
    first_pictures: list[float] = field(default_factory=list)
    tip: np.ndarray = field(default_factory=lambda: np.zeros(3))
    clicks: dict[str, list[tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    numbers: list[str] = field(default_factory=list)
    measures: list[str] = field(default_factory=list)
    back: list[str] = field(default_factory=list)
    rest: dict[str, Path] = field(default_factory=dict)
    pressed: dict[str, Path] = field(default_factory=dict)
    recording: Path = Path()
    played: tuple[float, list[str], str] = (0.0, [], "")
    reports: dict[str, Path] = field(default_factory=dict)
    memory: list[tuple[dict[str, Footprint], float]] = field(default_factory=list)

    def said(self, pattern: str) -> float:
        """A number that the page said while the tool pressed."""
        whole = "\n".join([*self.numbers, *self.measures])
        found = re.search(pattern, whole)
        assert found, f"{pattern} not in {whole}"
        return float(found[1])


# --- On the page ------------------------------------------------------------------------------


def lines(page: Any, name: str) -> list[str]:
    """Of a part of the page; none while there is nothing to say."""
    found = page.locator(f"#{name}")
    return [line for line in found.inner_text().splitlines() if line] if found.count() else []


def at_rest(page: Any, name: str) -> list[str]:
    """The same, once it stays."""
    before: list[str] = []

    def stays() -> bool:
        nonlocal before
        now = lines(page, name)
        stayed, before = bool(now) and now == before, now
        page.wait_for_timeout(1000)
        return stayed

    until(page, stays, f"{name} that stay")
    return before


def first_picture(page: Any, address: str) -> float:
    """Seconds from asking for the page until the organ is seen."""
    page.goto("about:blank")
    page.goto(address)
    until(page, lambda: page.evaluate("window.firstPicture > 0"), "a picture")
    return float(page.evaluate("window.firstPicture")) / 1e3


def build(page: Any, session: Session) -> None:
    open_tab(page, "Patient")
    until(page, lambda: offered(page, "Surface", "case.nii.gz"), "the label map in the list")
    page.get_by_label("Organ's label", exact=True).wait_for(timeout=SLOW)
    choose(page, "Organ's label", str(ORGAN))
    page.get_by_label(str(TUMOUR), exact=True).check()
    choose(page, "Fidelity", "interpolated")
    begin = time.monotonic()
    press(page, "Build patient")
    until(page, lambda: "case is shown" in "".join(lines(page, "state")), "the patient", 900.0)
    session.built_in = time.monotonic() - begin


def offered(page: Any, label: str, option: str) -> bool:
    """Whether a list has an option, which is chosen then."""
    page.get_by_label(label, exact=True).click()
    found = page.get_by_role("option", name=option, exact=True)
    if found.count():
        found.click()
        return True
    page.keyboard.press("Escape")
    return False


def height(page: Any) -> float:
    """Of the tip over the surface at rest, as the page says it [mm]."""
    open_tab(page, "Measure")
    found = re.search(r"Tip ([\d.]+) mm (above|below)", "\n".join(at_rest(page, "measures")))
    assert found
    return float(found[1]) * (1.0 if found[2] == "above" else -1.0)


def put_beside(page: Any, shown: Organ) -> None:
    """Drag the tool over the place beside the tumour, and press it in."""
    page.keyboard.press("1")  # from the front
    page.wait_for_timeout(1500)
    pose, start = first_pose(shown), shown.above(Tip().offset + 0.015)
    goal = start.copy()
    goal[[0, 2]] = (CENTRE + BESIDE)[[0, 2]]
    drag_there(page, pose, start, goal)
    page.mouse.up()


def press_in(page: Any) -> None:
    steps = round(height(page)) + DEPTH
    open_tab(page, "Tool")
    for _ in range(steps):
        press(page, "press 1 mm")
    until(page, lambda: force_of(page) > 0.1, "a force")


def click_at(page: Any, session: Session, shown: Organ, mode: str, places: np.ndarray) -> None:
    """Click on the organ in front of places beside the tumour, (n, 2), x and z [m]."""
    choose(page, "A click places", mode)
    pose = first_pose(shown)
    for x, z in places:
        there = np.array([CENTRE[0] + x, shown.vertices[:, 1].max(), CENTRE[2] + z])
        at = np.round(screen_of(page, pose, there))
        middle = at + 0.5  # of the pixel: viser's rays go through it
        session.clicks.setdefault(mode, []).append(ray_through(page, pose, middle))
        page.mouse.click(*at)
        page.wait_for_timeout(1000)


def ray_through(page: Any, pose: Pose, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is seen at a pixel lies on this ray."""
    right, up, towards = basis(pose)
    box = page.locator("canvas").first.bounding_box()
    scale = np.tan(0.5 * FOV) / (0.5 * box["height"])
    x = scale * (at[0] - box["x"] - 0.5 * box["width"])
    y = -scale * (at[1] - box["y"] - 0.5 * box["height"])
    return pose.position, x * right + y * up - towards


def export(page: Any, session: Session, suffix: str) -> Path:
    """Write the surfaces that are shown; returns the organ's."""
    open_tab(page, "Plan")
    before = set(session.folder.glob(f"deformed-*{suffix}"))
    choose(page, "Format", suffix)
    press(page, "Export deformed surfaces")
    until(
        page,
        lambda: len(set(session.folder.glob(f"deformed-*{suffix}")) - before) == 2,
        "organ and tumour",
    )
    new = set(session.folder.glob(f"deformed-*{suffix}")) - before
    return min(new, key=lambda path: len(path.name))


def keep(page: Any, session: Session) -> None:
    open_tab(page, "Plan")
    input_of(page, "Note").fill(NOTE)
    page.wait_for_timeout(500)
    press(page, "Keep this state")
    news(page, "kept in plan-")
    (file,) = session.folder.glob("plan-*.json")
    session.tip = np.array(json.loads(file.read_text())["states"][-1]["targets"][0])


def record(page: Any, session: Session) -> None:
    """From rest, into the organ and out again."""
    open_tab(page, "Tool")
    press(page, "Record")
    news(page, "natural effects runs")
    press_in(page)
    page.wait_for_timeout(1500)
    lift(page)
    press(page, "Stop and save")
    news(page, "recording-")
    (session.recording,) = session.folder.glob("recording-*.h5")


def replay(page: Any, session: Session) -> None:
    """Play the recording, stop where the force is largest, and return to now."""
    since, forces = recorded(session)
    largest = round(100.0 * since[int(np.argmax(forces))] / since[-1])
    open_tab(page, "Tool")
    if not page.get_by_role("button", name="play", exact=True).is_visible():
        page.get_by_text("Recordings", exact=True).click()
    until(page, lambda: offered(page, "Recording", session.recording.name), "the recording")
    press(page, "play")
    until(page, lambda: "not what the tool feels" in "".join(lines(page, "alerts")), "a playback")
    press(page, "pause")
    time_of = input_of(page, "Time [%]")
    time_of.fill(str(largest))
    time_of.press("Enter")
    numbers = at_rest(page, "numbers")
    session.played = float(time_of.input_value()) / 100.0, numbers, "".join(lines(page, "alerts"))
    press(page, "back to now")
    until(page, lambda: "Recording" not in "".join(lines(page, "alerts")), "what is now")


def recorded(session: Session) -> tuple[np.ndarray, np.ndarray]:
    """Of each surface of the recording, the time since the first [s] and the force [N]."""
    recording = load_recording(session.recording)
    periods = recording.periods
    rows = np.searchsorted(periods.number, recording.clouds.period)
    since = (periods.stamp[rows] - periods.stamp[rows[0]]) * 1e-9
    return since, np.linalg.norm(periods.force[rows, 0], axis=1)


def report(page: Any, session: Session, kind: str) -> Path:
    open_tab(page, "Plan")
    before = set(session.folder.glob(f"report-*.{kind.lower()}"))
    press(page, kind)
    until(
        page,
        lambda: len(set(session.folder.glob(f"report-*.{kind.lower()}")) - before) == 1,
        "a report",
    )
    (path,) = set(session.folder.glob(f"report-*.{kind.lower()}")) - before
    return path


def return_to_kept(page: Any) -> list[str]:
    open_tab(page, "Plan")
    press(page, "return to it")
    news(page, "back at")
    until(page, lambda: force_of(page) > 0.1, "a force")
    open_tab(page, "Measure")
    return at_rest(page, "measures")


def heap(page: Any) -> float:
    """What the page's scripts keep [MB]."""
    tools = page.context.new_cdp_session(page)
    tools.send("Performance.enable")
    for _ in range(2):
        tools.send("HeapProfiler.collectGarbage")
    found = {one["name"]: one["value"] for one in tools.send("Performance.getMetrics")["metrics"]}
    tools.detach()
    return float(found["JSHeapUsedSize"]) / 1e6


def hold(page: Any, made: Session, pids: dict[str, int], shots: Path) -> None:
    """All of the session."""
    build(page, made)
    shown = Organ.of(load_vademecum(made.folder / "case-1-interpolated.h5"))
    made.rest[".vtp"] = export(page, made, ".vtp")
    put_beside(page, shown)
    open_tab(page, "Measure")
    click_at(page, made, shown, "plane (3 points)", PLANE)
    click_at(page, made, shown, "probe", PROBE[None])
    press_in(page)
    open_tab(page, "Measure")
    made.measures = at_rest(page, "measures")
    made.numbers = lines(page, "numbers")
    page.screenshot(path=shots / "measured.png")
    keep(page, made)
    for suffix in (".stl", ".vtp"):
        made.pressed[suffix] = export(page, made, suffix)
    lift(page)
    record(page, made)
    end = time.monotonic() + 60.0 * MINUTES
    while len(made.memory) < 2 or time.monotonic() < end:
        made.back = return_to_kept(page)
        lift(page)
        replay(page, made)
        made.reports = {kind: report(page, made, kind) for kind in ("HTML", "PDF")}
        export(page, made, ".stl")
        made.memory.append((footprints(pids), heap(page)))
    address = page.url
    page.add_init_script(WATCH)
    made.first_pictures = [first_picture(page, address) for _ in range(3)]
