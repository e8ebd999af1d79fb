"""Colours and sides in the browser: they agree with the legend and the patient.

The view alone, without nodes: a known displacement is drawn, and pixels are read.
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from viser import ViserServer

from avatar_core.geometry.tip import Tip
from avatar_ros.ui.view.colours import N_BANDS, TISSUE, band_colours
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.view import CUT, GLASS, OrganView
from tests.ros.helpers.browser import browsing, close_notices, first_pose, screen_of

pytestmark = pytest.mark.long

TOP = 5e-3  # largest value of the drawn field [m]
CLOSE = 0.05 * 255  # distance of a colour from that of the legend


@pytest.fixture(scope="module")
def view(viser_server: ViserServer, cube: Organ) -> OrganView:
    viser_server.scene.reset()
    viser_server.gui.reset()
    viser_server.gui.main_panel.minimize()
    made = OrganView(viser_server, lambda tool, place, along_shaft: None)
    made.show(cube, (Tip(),))
    return made


@pytest.fixture(scope="module")
def browser(chromium: str, viser_server: ViserServer, view: OrganView) -> Iterator[Any]:
    with browsing(f"http://127.0.0.1:{viser_server.get_port()}", (700, 600)) as page:
        page.locator("canvas").first.wait_for()
        close_notices(page)
        yield page


def picture(page: Any) -> np.ndarray:
    """Return pixels, shape (down, right, 3), once they no longer change."""
    from PIL import Image

    before = np.zeros(1)
    for _ in range(60):
        page.wait_for_timeout(500)
        now = np.asarray(Image.open(BytesIO(page.screenshot())).convert("RGB")).astype(int)
        if before.shape == now.shape and np.array_equal(before, now):
            return now
        before = now
    raise AssertionError("the picture never rests")


def ramp(cube: Organ) -> np.ndarray:
    """Return a cloud displaced along z, from 0 to TOP towards the patient's right [m]."""
    rest = cube.vertices.astype(float)
    x = rest[:, 0]
    moved = np.zeros_like(rest)
    moved[:, 2] = TOP * (x - x.min()) / (x.max() - x.min())
    return np.hstack([rest + moved, moved])


def test_pixels_have_the_colours_of_the_legend_and_right_is_on_the_left(
    view: OrganView, browser: Any, cube: Organ, shots: Path
) -> None:
    """From the front, the patient's right is at the left: there the field is largest."""
    cloud = ramp(cube)
    view.move(cloud)
    pixels, pose = picture(browser), first_pose(cube)
    browser.screenshot(path=shots / "ramp.png")
    low, high = cube.vertices.min(axis=0), cube.vertices.max(axis=0)
    checked = 0
    for part in (np.arange(N_BANDS) + 0.5) / N_BANDS:
        z = 0.7 * low[2] + 0.3 * high[2] + part * TOP  # below the panel
        point = np.array([low[0] + part * (high[0] - low[0]), high[1], z])
        x, y = screen_of(browser, pose, point)
        seen, wanted = pixels[round(y), round(x)], band_colours()[int(part * N_BANDS)]
        if part > 1.0 / N_BANDS:
            assert np.abs(seen - wanted).max() < CLOSE, (part, seen, wanted)
            checked += 1
    assert checked == N_BANDS - 1
    left, _ = screen_of(browser, pose, np.array([high[0], high[1], 0.0]))
    right, _ = screen_of(browser, pose, np.array([low[0], high[1], 0.0]))
    assert left < right
    for place in ((high[0], "R"), (low[0], "L")):
        outside = cube.centre.copy()
        outside[0] = place[0] + np.sign(place[0] - cube.centre[0]) * 0.06 * cube.size
        x, y = screen_of(browser, pose, outside)
        around = pixels[round(y) - 8 : round(y) + 9, round(x) - 8 : round(x) + 9]
        assert around.min() < 120, f"no letter {place[1]}"


def test_glass_has_no_dark_patch_and_rest_is_tissue(
    view: OrganView, browser: Any, cube: Organ
) -> None:
    rest = np.hstack([cube.vertices, np.zeros_like(cube.vertices)])
    view.move(rest)
    pose = first_pose(cube)
    grid = [
        cube.centre + np.array([u, 0.5, v]) * (np.ptp(cube.vertices, axis=0) * 0.7)
        for u in np.linspace(-0.5, 0.5, 7)
        for v in (-0.4, -0.2, 0.2, 0.4)
    ]
    front = [p * [1, 0, 1] + [0, cube.vertices[:, 1].max(), 0] for p in grid]
    places = [tuple(map(round, screen_of(browser, pose, p))) for p in front]

    def seen() -> np.ndarray:
        pixels = picture(browser)
        return np.array([pixels[y, x] for x, y in places])

    whole = seen()
    red = np.array(TISSUE)
    assert (np.abs(whole / whole.sum(axis=1, keepdims=True) - red / red.sum()) < 0.05).all()
    view.look(GLASS)
    glass = seen()
    assert (glass > whole).any(axis=1).all() and glass.min() > 120  # lighter on a white background
    assert np.ptp(glass.sum(axis=1)) < 90
    view.look(CUT, "A", 0.5)
    cut = seen()
    assert np.abs(cut - whole).max(axis=1).mean() > 20  # the far wall, darker
