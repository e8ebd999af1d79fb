"""A session at the planning page by script: from a segmentation to a report and an export.

AVATAR_SESSION_MINUTES makes it go on pressing and lifting for so long, to watch memory.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

import meshio
import nibabel
from avatar_ros.bench.cell import Module
from avatar_ros.ui.measures import Now, depth_of
from avatar_ros.ui.measuring import gap
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.tip_body import tip_body, turn_to
from scipy.spatial.transform import Rotation

from avatar_core.geometry.tip import Tip
from avatar_core.scene.recording import load_recording
from avatar_core.scene.replay import replay
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.ros.browser import (
    CHROMIUM,
    SLOW,
    TOKEN,
    choose,
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
from tests.ros.conftest import PATIENT

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.timing,  # a browser that draws without a graphics card takes both cores
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt install chromium"),
]

VOXEL = 3e-3  # [m]
TUMOUR = 0.016  # radius [m]
CYCLES = 6  # of pressing and lifting, over which memory is watched
MINUTES = float(os.environ.get("AVATAR_SESSION_MINUTES", "0"))
CLOSE = 0.1  # [mm]
GROWTH = 25e6  # of a process that does the same again and again [bytes]


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shots_in(tmp_path_factory.mktemp("shots"))


@pytest.fixture(scope="module")
def scans(folder: Path, livers: list[Any], organ: Any) -> Path:
    """The last liver with a tumour as a label map, 1 and 2, and as an image."""
    save_vademecum(organ, folder / "liver.h5")
    liver = livers[-1]
    low, high = liver.vertices.min(axis=0) - 2 * VOXEL, liver.vertices.max(axis=0) + 2 * VOXEL
    axes = [np.arange(a, b, VOXEL) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    labels = liver.skin.contains(points.reshape(-1, 3)).reshape(points.shape[:3]).astype(np.uint8)
    centre = liver.vertices.mean(axis=0) + np.array([0.0, 0.02, 0.0])
    labels[(np.linalg.norm(points - centre, axis=-1) < TUMOUR) & (labels > 0)] = 2
    affine = np.diag([1e3 * VOXEL] * 3 + [1.0])
    affine[:3, 3] = 1e3 * low
    nibabel.save(nibabel.Nifti1Image(labels, affine), folder / "case.nii.gz")
    grey = np.array([-1000, 60, 110], np.int16)[labels]
    nibabel.save(nibabel.Nifti1Image(grey, affine), folder / "ct.nii.gz")
    return folder


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def nodes(scans: Path, own_domain: dict[str, str], port: int) -> Iterator[dict[str, Module]]:
    library = ["-p", f"library_dir:={scans}"]
    arguments = {
        "vademecum_loader": [*library, "-p", "vademecum:=liver.h5"],
        "contact": PATIENT[1:],
        "patient_interpolation": [
            *library,
            *("-p", f"atlas:={scans / 'atlas.h5'}", "-p", "vertices:=350", "-p", "certify:=4"),
        ],
        "planning_ui": [*library, "-p", f"port:={port}", "-p", f"token:={TOKEN}"],
    }
    with nodes_of_a_page(arguments, own_domain) as running:
        yield running


@pytest.fixture(scope="module")
def page(nodes: Any, port: int, shots: Path) -> Iterator[Any]:
    with opened(port, shots) as page:
        yield page


def build(page: Any) -> None:
    """The file, its labels, and how exactly."""
    open_tab(page, "Patient")
    choose(page, "Surface", "case.nii.gz")
    label = page.get_by_label("Organ's label", exact=True)
    until(page, label.is_visible, "labels", 120.0)
    choose(page, "Organ's label", "1")
    page.get_by_label("2", exact=True).check()


def alert_of(page: Any) -> str:
    return str(page.locator("#alerts").inner_text())


def test_labels_are_offered_and_the_clamp_is_seen_before_anything_is_built(
    page: Any, shots: Path
) -> None:
    build(page)
    press(page, "Preview the clamp")
    until(page, lambda: "what would be clamped" in alert_of(page), "a preview", 300.0)
    page.wait_for_timeout(3000)
    page.screenshot(path=shots / "preview.png")
    assert "hidden" in alert_of(page)
    choose(page, "A click paints", "clamp")
    page.mouse.click(400, 420)
    until(page, lambda: "as painted" in alert_of(page), "a painted clamp", 30.0)
    page.wait_for_timeout(2000)
    page.screenshot(path=shots / "painted.png")
    press(page, "Back to the organ in use")
    until(page, lambda: "clamped" not in alert_of(page), "the organ in use", 30.0)


@pytest.fixture(scope="module")
def patient(page: Any, scans: Path, shots: Path) -> Organ:
    """That was built from the label map, with what lies inside."""
    build(page)
    press(page, "Build patient")
    try:
        news(page, "case is shown")
    finally:
        page.screenshot(path=shots / "built.png")
    return Organ.of(load_vademecum(scans / "case-reduced.h5"))


def number(page: Any, what: str) -> float:
    """A length that the page says [mm]."""
    found = re.search(rf"{what}\D*?(-?[\d.]+) mm", page.inner_text("#measures"))
    return float(found[1]) if found else float("nan")


def pressed(page: Any, force: float) -> None:
    open_tab(page, "Tool")
    for _ in range(60):
        if force_of(page) > force:
            break
        page.get_by_text("press 1 mm", exact=True).click()
        page.wait_for_timeout(250)
    until(page, lambda: force_of(page) > force, "a force", 20.0)


def lifted(page: Any) -> None:
    open_tab(page, "Tool")
    press(page, "Lift off the organ")
    until(page, lambda: force_of(page) == 0.0, "the organ left", 60.0)


def test_numbers_of_page_files_and_export_agree(
    page: Any, patient: Organ, scans: Path, shots: Path
) -> None:
    assert set(patient.structures) == {"label 2"}
    open_tab(page, "Tool")
    press(page, "Record")
    news(page, "natural effects runs")
    page.wait_for_timeout(1000)
    pressed(page, 0.5)
    page.wait_for_timeout(3000)  # at rest there
    open_tab(page, "Measure")
    depth, way = number(page, "Tip"), number(page, "Tool to label 2:")
    force = force_of(page)
    page.screenshot(path=shots / "measured.png")
    open_tab(page, "Plan")
    page.get_by_label("Note", exact=True).fill("beside the tumour")
    press(page, "Keep this state")
    news(page, "kept in plan-")
    press(page, "HTML")
    until(page, lambda: bool(list(scans.glob("report-*.html"))), "a report", 60.0)
    press(page, "PDF")
    until(page, lambda: bool(list(scans.glob("report-*.pdf"))), "a PDF", 60.0)
    press(page, "Export deformed surfaces")
    until(page, lambda: bool(list(scans.glob("deformed-*_label_2.stl"))), "an export", 60.0)
    page.screenshot(path=shots / "plan.png")
    lifted(page)
    press(page, "Stop and save")
    until(page, lambda: bool(list(scans.glob("recording-*.h5"))), "a recording", 60.0)

    (kept,) = json.loads(next(scans.glob("plan-*.json")).read_text())["states"]
    assert kept["picture"]
    assert f"Force {force:.2f} N" in kept["lines"][0]
    tip, ball = np.array(kept["target"]), tip_body(Tip())[0]
    now = Now(patient.vertices, tip, 1.0)
    assert 1e3 * depth_of(patient, now, ball) == pytest.approx(depth, abs=CLOSE)
    (export,) = scans.glob("deformed-*_label_2.stl")
    tumour = meshio.read(export)
    points = tumour.points * [-1e-3, -1e-3, 1e-3]  # of LPS in mm
    w, x, y, z = turn_to(patient.outward(tip))
    body = tip + Rotation.from_quat([x, y, z, w]).apply(ball)
    found = gap(body, points, tumour.cells_dict["triangle"])
    assert 1e3 * found.length == pytest.approx(way, abs=CLOSE)
    report = next(scans.glob("report-*.html")).read_text()
    assert f"{depth:.1f} mm below" in report
    assert f"Tool to label 2: {way:.1f} mm" in report
    assert next(scans.glob("report-*.pdf")).read_bytes().startswith(b"%PDF")

    recording = load_recording(next(scans.glob("recording-*.h5")))
    again = replay(recording, patient.vademecum)
    assert again.difference(recording) <= 1e-9
    largest = np.linalg.norm(recording.periods.force, axis=2).max()
    assert largest == pytest.approx(force, abs=0.02)


def test_the_recording_is_played_and_scrubbed(
    page: Any, patient: Organ, scans: Path, shots: Path
) -> None:
    (file,) = scans.glob("recording-*.h5")
    recording = load_recording(file)
    assert np.isin(recording.clouds.period, recording.periods.number).all()
    open_tab(page, "Tool")
    page.get_by_text("Recordings", exact=True).click()
    until(page, lambda: file.name in page.inner_text("body") or True, "the recording", 5.0)
    press(page, "play")
    until(page, lambda: "not what the tool feels now" in alert_of(page), "a recording", 60.0)
    until(page, lambda: force_of(page) > 0.3, "the force of then", 60.0)
    press(page, "pause")
    page.wait_for_timeout(1000)
    page.screenshot(path=shots / "played.png")
    shown = [force_of(page) for _ in range(3) if page.wait_for_timeout(400) is None]
    assert len(set(shown)) == 1  # it stays
    rows = np.searchsorted(recording.periods.number, recording.clouds.period)
    sizes = np.linalg.norm(recording.periods.force[rows, 0], axis=1)
    assert np.abs(sizes - shown[0]).min() < 0.006
    press(page, "back to now")
    until(page, lambda: force_of(page) == 0.0 and not alert_of(page), "what is now", 30.0)


def test_planes_of_an_image_and_structures_are_shown(
    page: Any, patient: Organ, shots: Path
) -> None:
    open_tab(page, "Organ")
    page.get_by_text("CT or MR", exact=True).click()
    choose(page, "Image", "ct.nii.gz")
    page.get_by_text("they do not move with the organ").wait_for(timeout=SLOW)
    page.wait_for_timeout(3000)
    page.screenshot(path=shots / "scan.png")
    choose(page, "Image", "none")
    choose(page, "Show organ", "cut open")
    page.wait_for_timeout(3000)
    page.screenshot(path=shots / "cut.png")
    choose(page, "Show organ", "glass")
    for width, height in ((1280, 800), (900, 700)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(1500)
        for tab in ("Tool", "Organ", "Plan", "Patient"):
            open_tab(page, tab)
            page.screenshot(path=shots / f"{tab}-{width}.png")


def resident(process: Module) -> int:
    """Memory of a process [bytes]."""
    text = Path(f"/proc/{process.pid}/status").read_text()
    return 1024 * int(re.search(r"VmRSS:\s+(\d+)", text)[1])  # type: ignore[index]


def test_memory_is_flat(page: Any, patient: Organ, nodes: dict[str, Module]) -> None:
    end = time.monotonic() + 60.0 * MINUTES
    watched = ("planning_ui", "contact", "vademecum_loader")
    sizes: list[list[int]] = []
    while len(sizes) < CYCLES or time.monotonic() < end:
        pressed(page, 0.3)
        lifted(page)
        sizes.append([resident(nodes[name]) for name in watched])
    half = len(sizes) // 2
    grown = np.array(sizes[-1]) - np.array(sizes[half - 1])
    heap = page.evaluate("performance.memory.usedJSHeapSize")
    print(f"{len(sizes)} cycles; grown {dict(zip(watched, grown, strict=True))}; heap {heap:,}")
    assert (grown < GROWTH).all(), dict(zip(watched, grown, strict=True))
