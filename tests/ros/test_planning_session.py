"""A planner's session on the page, from a patient's images to files for other programs.

One session for all tests: a patient is built from a label map with a tumour, pressed beside it,
measured, kept, recorded, replayed, reported and exported. Each test looks at one thing of it. It
takes ten minutes where no graphics card draws, and is held only if it is asked for:
``AVATAR_SESSION_MINUTES=1 pytest -m long tests/ros/test_planning_session.py -s``.
"""

from __future__ import annotations

import json
import os
import re
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import igl
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

import meshio
import nibabel
from avatar_ros.bench.footprint import Footprint, footprints
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.orientation import FOV, Pose, basis

from avatar_core.geometry.level_set import grid_points
from avatar_core.geometry.phantom import BOX, liver_level_set
from avatar_core.geometry.tip import Tip
from avatar_core.scene.recording import load_recording
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.ros.browser import (
    CHROMIUM,
    SLOW,
    TOKEN,
    choose,
    first_pose,
    force_of,
    free_port,
    input_of,
    news,
    nodes_of_a_page,
    open_tab,
    opened,
    press,
    screen_of,
    shots_in,
    until,
)
from tests.ros.conftest import PATIENT
from tests.slowness import slowness

ASKED = os.environ.get("AVATAR_SESSION_MINUTES", "")

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.timing,  # a browser that draws without a graphics card takes both cores
    pytest.mark.skipif(not ASKED, reason="takes ten minutes: set AVATAR_SESSION_MINUTES"),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt install chromium"),
]

ORGAN, TUMOUR = 1, 2  # labels
VOXEL = 3e-3  # [m]
CENTRE, RADIUS = np.array([0.02, 0.045, -0.01]), 0.010  # of the tumour [m]
BESIDE = np.array([-0.018, 0.0, 0.0])  # from over the tumour to where the tool presses [m]
DEPTH = 3  # of the tip below the surface [mm]
PLANE = np.array([[-0.02, 0.03], [-0.02, -0.03], [-0.026, 0.0]])  # from the tumour, x and z [m]
PROBE = np.array([-0.018, 0.014])  # the same
NOTE = "beside the tumour"
AGREE = 0.1  # numbers of the page and of files [mm]
FIRST_PICTURE = 3.0  # after the address was asked for, on a machine with nothing else to do [s]
MINUTES = float(ASKED or "0")  # of rounds, at least two
GROWN = 10.0  # memory that a node may take from the first round to the last [MB]
GROWN_PAGE = 5.0  # the same of the browser's page [MB]
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
    way = np.linspace(screen_of(page, pose, start), screen_of(page, pose, goal), 12)
    page.mouse.move(*way[0])
    page.wait_for_timeout(500)
    page.mouse.down()
    for x, y in way:
        page.mouse.move(x, y)
        page.wait_for_timeout(100)
    page.mouse.up()


def press_in(page: Any) -> None:
    steps = round(height(page)) + DEPTH
    open_tab(page, "Tool")
    for _ in range(steps):
        press(page, "press 1 mm")
    until(page, lambda: force_of(page) > 0.1, "a force")


def lift(page: Any) -> None:
    open_tab(page, "Tool")
    press(page, "Lift off the organ")
    until(page, lambda: force_of(page) == 0.0, "the organ left")


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
    session.tip = np.array(json.loads(file.read_text())["states"][-1]["target"])


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


# --- The session ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session(
    own_domain: dict[str, str], folder: Path, organ: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Session]:
    save_vademecum(organ, folder / "liver.h5")
    nibabel.save(labels(), folder / "case.nii.gz")
    library, port, made = ["-p", f"library_dir:={folder}"], free_port(), Session(folder)
    shots = shots_in(tmp_path_factory.mktemp("shots"))
    arguments = {
        "vademecum_loader": [*library, "-p", "vademecum:=liver.h5"],
        "contact": PATIENT[1:],
        "patient_interpolation": [
            *library,
            *("-p", f"atlas:={folder / 'atlas.h5'}", "-p", "vertices:=350"),
        ],
        "planning_ui": [*library, "-p", f"port:={port}", "-p", f"token:={TOKEN}"],
    }
    with nodes_of_a_page(arguments, own_domain) as nodes, opened(port, shots) as page:
        pids = {name: node.pid for name, node in nodes.items()}
        try:
            hold(page, made, pids, shots)
        finally:
            page.screenshot(path=shots / "session.png")
        yield made


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


# --- What it shows ----------------------------------------------------------------------------


def opened_vtp(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles, as any reader of XML finds them."""
    piece = ElementTree.parse(path).getroot().find("PolyData/Piece")
    assert piece is not None
    (points,) = piece.iterfind("Points/DataArray")
    faces = piece.find("Polys/DataArray[@Name='connectivity']")
    assert faces is not None
    return (
        np.fromstring(str(points.text), sep=" ").reshape(-1, 3),
        np.fromstring(str(faces.text), int, sep=" ").reshape(-1, 3),
    )


def opened_stl(path: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = meshio.read(path)
    return mesh.points.astype(float), mesh.cells_dict["triangle"]


def tumour_of(organ: Path) -> Path:
    return organ.with_name(f"{organ.stem}_label_{TUMOUR}{organ.suffix}")


def lps(point: np.ndarray) -> np.ndarray:
    """A point or direction, RAS [m], as the files have it, LPS [mm]."""
    return 1e3 * point * [-1.0, -1.0, 1.0]


def distance(point: np.ndarray, body: tuple[np.ndarray, np.ndarray]) -> float:
    """From a point to a surface [mm]."""
    square, _, _ = igl.point_mesh_squared_distance(point[None], *body)
    return float(np.sqrt(square[0]))


def places(session: Session, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """What was clicked on, at rest and pressed, (n, 3) [mm]."""
    (rest, faces), (moved, _) = (opened_vtp(s[".vtp"]) for s in (session.rest, session.pressed))
    found = []
    for origin, direction in session.clicks[mode]:
        hits = igl.ray_mesh_intersect(lps(origin), lps(direction), rest, faces)
        k, _, u, v = min(hits, key=lambda hit: hit[1])
        corners = faces[k]
        found.append([np.array([1.0 - u - v, u, v]) @ points[corners] for points in (rest, moved)])
    at = np.array(found)
    return at[:, 0], at[:, 1]


def test_the_patient_lies_where_its_image_does(session: Session) -> None:
    """Whichever way its voxels run."""
    print(f"\nbuilt in {session.built_in:.0f} s")
    points, _ = opened_vtp(tumour_of(session.rest[".vtp"]))
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    np.testing.assert_allclose(middle, lps(CENTRE), atol=1e3 * VOXEL)


def test_depth_and_way_to_the_tumour_are_those_of_the_files(session: Session) -> None:
    tip, radius = lps(session.tip), 1e3 * Tip().radius
    depth = radius - distance(tip, opened_vtp(session.rest[".vtp"]))
    way = distance(tip, opened_stl(tumour_of(session.pressed[".stl"]))) - radius
    said = session.said(r"Tip ([\d.]+) mm below"), session.said(r"Tool to label 2: ([\d.]+) mm")
    print(f"\ndepth {depth:.2f} mm, said {said[0]}; to the tumour {way:.2f} mm, said {said[1]}")
    assert said[0] == pytest.approx(depth, abs=AGREE)
    assert said[1] == pytest.approx(way, abs=AGREE)


def test_the_margin_is_that_of_the_files_at_rest_and_pressed(session: Session) -> None:
    for when, corners, files in zip(
        ("at rest", "now"),
        places(session, "plane (3 points)"),
        (session.rest, session.pressed),
        strict=True,
    ):
        tumour, _ = opened_vtp(tumour_of(files[".vtp"]))
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        margin = np.abs((tumour - corners[0]) @ normal / np.linalg.norm(normal)).min()
        said = session.said(rf"Margin to label 2:.* ([\d.]+) mm {when}")
        print(f"\nmargin {margin:.2f} mm {when}, said {said}")
        assert said == pytest.approx(margin, abs=AGREE)


def test_displacements_are_those_of_the_files(session: Session) -> None:
    rest, pressed = places(session, "probe")
    moved = float(np.linalg.norm(pressed - rest))
    (before, _), (after, _) = opened_vtp(session.rest[".vtp"]), opened_vtp(session.pressed[".vtp"])
    largest = np.linalg.norm(after - before, axis=1).max()
    said = (
        session.said(r"Probe: displacement ([\d.]+) mm"),
        session.said(r"displacement ([\d.]+) mm"),
    )
    print(f"\nprobe {moved:.3f} mm, said {said[0]}; largest {largest:.2f} mm, said {said[1]}")
    assert said[0] == pytest.approx(moved, abs=AGREE)


def test_both_formats_hold_the_same_surfaces(session: Session) -> None:
    for of in (lambda path: path, tumour_of):
        (a, p), (b, q) = (
            opened_stl(of(session.pressed[".stl"])),
            opened_vtp(of(session.pressed[".vtp"])),
        )
        assert len(p) == len(q)
        np.testing.assert_allclose(a[p].mean(axis=1), b[q].mean(axis=1), atol=1e-3)


def test_a_kept_state_comes_back(session: Session) -> None:
    assert session.back == session.measures


def test_a_recording_is_replayed_as_it_was(session: Session) -> None:
    part, numbers, alerts = session.played
    since, forces = recorded(session)
    at = np.abs(since - part * since[-1]) <= 0.001 * since[-1] + 1.0 / 30.0
    found = re.search(r"Force ([\d.]+) N", "".join(numbers))
    assert found
    print(f"\n{since[-1]:.1f} s, force at {part:.0%}: {forces[at]}, said {found[1]}")
    assert np.abs(forces[at] - float(found[1])).min() < 0.01
    assert float(found[1]) > 0.1
    assert session.recording.name in alerts and "not what the tool feels now" in alerts


def test_reports_hold_what_the_page_said(session: Session) -> None:
    html = session.reports["HTML"].read_text()
    pdf = text_of(session.reports["PDF"].read_bytes())
    for line in [*session.numbers, *session.measures, NOTE]:
        assert line in html
        assert re.sub(r"\W", "", line) in pdf


def text_of(pdf: bytes) -> str:
    """The letters and numbers of a PDF of matplotlib, without what is between them."""
    streams = re.findall(rb"stream\r?\n(.*?)endstream", pdf, re.DOTALL)
    found = []
    for stream in streams:
        try:
            page = zlib.decompress(stream)
        except zlib.error:  # an image
            continue
        found += re.findall(rb"\(((?:\\.|[^()\\])*)\)", page)
    return re.sub(r"\W", "", b"".join(found).decode("latin-1"))


def test_memory_of_page_and_nodes_is_flat(session: Session) -> None:
    """What no system can reclaim of each node, and what the page's scripts keep after a collection,
    from the end of the first round to that of the last."""
    (begin, heap_then), (end, heap_now) = session.memory[0], session.memory[-1]
    print(f"\n{len(session.memory)} rounds; page {heap_then:.1f} MB, {heap_now - heap_then:+.1f}")
    for name, before in begin.items():
        grown = end[name].memory_mb - before.memory_mb
        rounds = " ".join(f"{now[name].memory_mb:.0f}" for now, _ in session.memory)
        print(f"{name}: {before.memory_mb:.0f} MB, {grown:+.1f}; {rounds}")
        assert grown < GROWN, name
        assert end[name].files <= before.files + 2 and end[name].threads <= before.threads + 2
    assert heap_now - heap_then < GROWN_PAGE


def test_the_organ_is_seen_soon(session: Session) -> None:
    median = float(np.median(session.first_pictures))
    print(f"\nfirst picture after {session.first_pictures} s")
    assert median < FIRST_PICTURE * slowness()
