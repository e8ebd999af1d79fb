"""What the planning page makes of the band of a force."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")

from avatar_ros.ui.force_band import BandRatios
from avatar_ros.ui.shown_period import ShownPeriod
from avatar_ros.ui.texts import BAND, frame_text
from avatar_ros.ui.tool_state import ROW, SharedToolState

pytestmark = pytest.mark.ros


def test_the_page_shows_a_band_in_proportion_to_the_force_beside_it() -> None:
    now = [0.0]
    ratios = BandRatios(lambda: now[0])
    assert ratios.of(2.0) is None
    ratios.note(0, 0.6, 1.0)
    assert ratios.of(2.0) is None  # of one edge alone
    ratios.note(1, 3.4, 2.0)
    ratios.note(1, 9.9, float("nan"))  # of a period that is not known
    ratios.note(1, 0.0, 0.0)
    assert ratios.of(2.0) == pytest.approx((1.2, 3.4))
    assert ratios.of(0.0) is None
    now[0] = 2.0
    assert ratios.of(2.0) is None  # nothing came lately
    ratios.note(0, 0.6, 1.0)
    ratios.forget()
    assert ratios.of(2.0) is None


def test_the_force_of_a_stamp_is_that_or_none() -> None:
    state = SharedToolState.make()
    state.use(np.zeros((2, 3)))
    for tool, force in enumerate([(0.0, 3.0, 4.0), (0.0, 0.0, 1.0)]):
        row = np.zeros(1, ROW)[0]
        row["stamp"], row["force"] = 7 + tool, force
        state.recent[tool, 3] = row
    state.all["n_recent"] = 4
    assert state.force_of(0, 7) == pytest.approx(5.0)
    assert state.force_of(1, 8) == pytest.approx(1.0)
    assert np.isnan(state.force_of(0, 8))


def test_the_band_stands_beside_the_force() -> None:
    shown = ShownPeriod(np.zeros(3), np.array([0.0, 2.0, 0.0]), 0.1, 1.0, 1e-3)
    assert BAND not in " ".join(frame_text(shown, "", None))
    lines = frame_text(shown._replace(band=(1.2, 3.4)), "", None)
    assert f"1.20 to 3.40 N: {BAND}" in lines


@pytest.fixture
def tab() -> Iterator[Any]:
    viser = pytest.importorskip("viser", reason="the extra ui is not installed")
    from avatar_ros.ui.tabs.tool import ToolTab

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield ToolTab(server.gui, SimpleNamespace())  # type: ignore[arg-type]
    server.stop()


def test_the_plot_has_the_band_for_as_long_as_it_shows_one(tab: Any) -> None:
    plain, wide = tab._plot, tab._plot_of_band
    tab.show_force(0.0, 1.0, 0.1)
    assert plain.visible and not wide.visible and len(plain.data) == 4
    tab.show_force(0.2, 1.5, 0.1, (1.0, 2.5))
    assert wide.visible and not plain.visible
    assert [row.tolist() for row in wide.data[4:]] == [[1.0, 1.0], [1.0, 2.5]]
    assert sum(BAND in series["label"] for series in wide.series) == 2
    for k in range(60):
        tab.show_force(0.4 + k, 1.0, 0.1)
    assert plain.visible and not wide.visible


def test_a_force_that_was_not_known_is_not_bridged_by_a_line(tab: Any) -> None:
    for k in range(5):
        tab.show_force(k, 50.0, 1.0)
    assert len(tab._plot.data[0]) == 5
    tab.forget_force()  # too deep, from here on
    tab.show_force(12.0, 0.0, 0.0)
    times, forces = tab._plot.data[:2]
    assert times.tolist() == [12.0] and forces.tolist() == [0.0]
