"""What a browser shows of the organ: the colours of the legend, and left on its side.

The view alone, without nodes: a known displacement is drawn, and pixels are read.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("avatar_ros.ui.view", reason="avatar_ros is not installed")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

import viser
from avatar_ros.ui.colours import N_BANDS, TISSUE, band_colours
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.view import CUT, GLASS, WHOLE, OrganView

from avatar_core.geometry.tip import Tip
from tests.helpers.box_organ import organ
from tests.ros.helpers.browser import CHROMIUM, OPTIONS, SLOW, first_pose, screen_of, shots_in

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt install chromium"),
]

TOP = 5e-3  # of the field that is drawn [m]
CLOSE = 0.05 * 255  # of a colour to that of the legend


@pytest.fixture(scope="module")
def shown() -> Organ:
    return Organ.of(organ("cube"))


@pytest.fixture(scope="module")
def view_and_page(shown: Organ) -> Iterator[tuple[OrganView, Any]]:
    from playwright.sync_api import sync_playwright

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = viser.ViserServer("127.0.0.1", port, verbose=False)
    server.gui.main_panel.minimize()
    view = OrganView(server, lambda tool, place, along_shaft: None)
    view.show(shown, (Tip(),))
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        page = browser.new_page(viewport={"width": 700, "height": 600})
        page.set_default_timeout(SLOW)
        page.goto(f"http://127.0.0.1:{port}")
        page.locator("canvas").first.wait_for(timeout=120_000)
        page.wait_for_timeout(5000)
        for close in page.locator(".mantine-Notification-closeButton").all():
            close.click()
        yield view, page
        browser.close()
    server.stop()


def picture(page: Any) -> np.ndarray:
    """Pixels, shape (down, right, 3), once they no longer change."""
    from PIL import Image

    before = np.zeros(1)
    for _ in range(60):
        page.wait_for_timeout(500)
        now = np.asarray(Image.open(BytesIO(page.screenshot())).convert("RGB")).astype(int)
        if before.shape == now.shape and np.array_equal(before, now):
            return now
        before = now
    raise AssertionError("the picture never rests")


def ramp(shown: Organ) -> np.ndarray:
    """A cloud that moves along z by more the farther to the patient's right, 0 to TOP [m]."""
    rest = shown.vertices.astype(float)
    x = rest[:, 0]
    moved = np.zeros_like(rest)
    moved[:, 2] = TOP * (x - x.min()) / (x.max() - x.min())
    return np.hstack([rest + moved, moved])


def test_pixels_have_the_colours_of_the_legend_and_right_is_on_the_left(
    view_and_page: tuple[OrganView, Any], shown: Organ, tmp_path: Path
) -> None:
    """Seen from the front, the patient's right is at the left: there the field is largest."""
    view, page = view_and_page
    cloud = ramp(shown)
    view.move(cloud, np.ones((1, 3)), np.zeros((1, 3)))
    pixels, pose = picture(page), first_pose(shown)
    page.screenshot(path=shots_in(tmp_path) / "ramp.png")
    low, high = shown.vertices.min(axis=0), shown.vertices.max(axis=0)
    checked = 0
    for part in (np.arange(N_BANDS) + 0.5) / N_BANDS:
        z = 0.7 * low[2] + 0.3 * high[2] + part * TOP  # below the panel
        point = np.array([low[0] + part * (high[0] - low[0]), high[1], z])
        x, y = screen_of(page, pose, point)
        seen, wanted = pixels[round(y), round(x)], band_colours()[int(part * N_BANDS)]
        if part > 1.0 / N_BANDS:
            assert np.abs(seen - wanted).max() < CLOSE, (part, seen, wanted)
            checked += 1
    assert checked == N_BANDS - 1
    left, _ = screen_of(page, pose, np.array([high[0], high[1], 0.0]))
    right, _ = screen_of(page, pose, np.array([low[0], high[1], 0.0]))
    assert left < right
    for place in ((high[0], "R"), (low[0], "L")):
        outside = shown.centre.copy()
        outside[0] = place[0] + np.sign(place[0] - shown.centre[0]) * 0.06 * shown.size
        x, y = screen_of(page, pose, outside)
        around = pixels[round(y) - 8 : round(y) + 9, round(x) - 8 : round(x) + 9]
        assert around.min() < 120, f"no letter {place[1]}"


def test_glass_has_no_dark_patch_and_rest_is_tissue(
    view_and_page: tuple[OrganView, Any], shown: Organ
) -> None:
    view, page = view_and_page
    rest = np.hstack([shown.vertices, np.zeros_like(shown.vertices)])
    view.move(rest, np.ones((1, 3)), np.zeros((1, 3)))
    pose = first_pose(shown)
    grid = [
        shown.centre + np.array([u, 0.5, v]) * (np.ptp(shown.vertices, axis=0) * 0.7)
        for u in np.linspace(-0.5, 0.5, 7)
        for v in (-0.4, -0.2, 0.2, 0.4)
    ]
    front = [p * [1, 0, 1] + pose_front(shown) for p in grid]
    places = [tuple(map(round, screen_of(page, pose, p))) for p in front]
    whole = np.array([picture(page)[y, x] for x, y in places])
    red = np.array(TISSUE)
    assert (np.abs(whole / whole.sum(axis=1, keepdims=True) - red / red.sum()) < 0.05).all()
    view.look(GLASS)
    glass = np.array([picture(page)[y, x] for x, y in places])
    assert (glass > whole).any(axis=1).all() and glass.min() > 120  # lighter before white ground
    assert np.ptp(glass.sum(axis=1)) < 90
    view.look(CUT, "A", 0.5)
    cut = np.array([picture(page)[y, x] for x, y in places])
    assert np.abs(cut - whole).max(axis=1).mean() > 20  # the far wall, darker
    view.look(WHOLE)


def pose_front(shown: Organ) -> np.ndarray:
    """The front of the organ, anterior [m]."""
    return np.array([0.0, shown.vertices[:, 1].max(), 0.0])
