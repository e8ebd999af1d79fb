"""What the planning page writes and holds: one period's force and shape, and no others."""

from __future__ import annotations

import re
import time
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="the extra ui is not installed")

from avatar_ros.framework.templates import stamp_bytes
from avatar_ros.loop.statuses import EXPLANATIONS
from avatar_ros.nodes.planning_ui import PlanningNode
from avatar_ros.ui.alerts import alerts
from avatar_ros.ui.library import Library
from avatar_ros.ui.live import Live
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.panels import Panels
from avatar_ros.ui.recorder import Recorder
from avatar_ros.ui.shown_period import BEYOND, OTHER_ORGAN, SILENT, PeriodChooser, ShownPeriod
from avatar_ros.ui.texts import frame_text, recorded_text, warnings
from avatar_ros.ui.tool_state import N_RECENT, N_ROWS, ROW, SharedToolState, organ_number

from avatar_core.scene.model import Scene
from avatar_core.scene.recording import Clouds, Periods, Recording, load_recording
from avatar_core.vademecum.model import VademecumInfo
from avatar_ros.msg import ContactState
from tests.helpers.box_organ import organ

pytestmark = pytest.mark.ros

OK, OUT = ContactState.STATUS_OK, ContactState.STATUS_OUT_OF_RANGE
TIP = np.array([0.0, 0.1, 0.0])
TIPS = TIP[None]


def shown(force: float, error: float, fraction: float, largest: float) -> ShownPeriod:
    return ShownPeriod(TIP, np.array([0.0, force, 0.0]), error, fraction, largest)


def row(status: int, force: float, stamp: int = 1) -> np.ndarray:
    out = np.zeros(1, ROW)
    out["status"], out["stamp"], out["tip"] = status, stamp, TIP
    out["force"], out["touches"], out["sent_fraction"] = (0.0, force, 0.0), force > 0.0, 1.0
    return out


def test_a_limited_force_is_no_measurement() -> None:
    """The organ pushes with 25 N; the device gets its 20 N, and the page says both."""
    now = shown(25.0, 2.7, 0.8, 0.0071)
    text = " ".join(frame_text(now, "E 170 kPa", None))
    assert "Force <b>25.00 N</b> ± 2.70 N, device 20.00 N" in text
    assert "<b>7.1 mm</b>" in text and "E 170 kPa" in text
    (alert,) = alerts(info(0.01), [now])
    assert alert == "Force limited: the device gets 20.00 N of 25.00 N"


def test_a_force_that_the_device_gets_is_written_once() -> None:
    free = shown(0.0, 0.0, 0.0, 0.0)  # nothing is held back
    for now in (shown(3.3, 0.1, 1.0, 0.001), free):
        assert "device" not in " ".join(frame_text(now, "", None))
        assert alerts(info(0.01), [now]) == []


def test_no_displacement_is_not_none() -> None:
    """Without a surface from the contact node, 20 N stand beside no 0.0 mm."""
    text = " ".join(frame_text(shown(20.0, 1.0, 1.0, float("nan")), "", None))
    assert "20.00 N" in text and "mm" not in text and "sends no surface" in text


def test_a_force_is_that_of_the_clouds_period() -> None:
    state = SharedToolState.make()
    assert state.period(5) is None
    for n in range(3 * N_RECENT):
        state.recent[:, n % N_RECENT] = row(OK, 0.001 * n, stamp=1000 + n)
        state.all["n_recent"] = n + 1
    found = state.period(1000 + 3 * N_RECENT - 100)
    assert found is not None and found["force"][0, 1] == 0.001 * (3 * N_RECENT - 100)
    newest = state.period(77)  # of a cloud whose state has not come: the newest
    assert newest is not None and newest["stamp"].tolist() == [1000 + 3 * N_RECENT - 1]


def test_beyond_the_range_the_last_valid_shape_stays() -> None:
    chooser = PeriodChooser()
    for force in (1.0, 20.0):
        assert chooser.take(row(OK, force))
        chooser.drawn(row(OK, force), 1e-4 * force, TIPS)
    for _ in range(3):  # the organ of these periods lies at rest
        assert not chooser.take(row(OUT, 0.0))
        (held,) = chooser.drawn(row(OUT, 0.0), float("nan"), TIPS)
        assert held.is_held and held.force[1] == 20.0 and held.largest == 2e-3
    text = " ".join(frame_text(held, "", None))
    assert "No force" in text and "20.00 N" in text and "2.0 mm" in text
    (alert,) = alerts(info(0.01), [held])
    assert "No force" in alert and "beyond" in alert
    assert chooser.take(row(OK, 0.0))
    assert not chooser.drawn(row(OK, 0.0), 0.0, TIPS)[0].is_held


def test_a_tool_that_never_touched_holds_nothing() -> None:
    chooser = PeriodChooser()
    assert chooser.take(row(OUT, 0.0))
    assert not chooser.drawn(row(OUT, 0.0), 0.0, TIPS)[0].is_held
    chooser.take(row(OK, 3.0))
    chooser.drawn(row(OK, 3.0), 1e-3, TIPS)
    chooser.forget()  # another organ
    assert chooser.take(row(OUT, 0.0))


@pytest.mark.parametrize("missing", [BEYOND, SILENT, OTHER_ORGAN])
def test_what_is_not_known_is_not_zero(missing: str) -> None:
    """Pressed too deep from afar, a contact node that is gone, forces of another patient."""
    now = ShownPeriod.without_force(TIP, missing)
    if missing == BEYOND:
        chooser = PeriodChooser()
        chooser.take(row(OUT, 0.0))
        (now,) = chooser.drawn(row(OUT, 0.0), 0.0, TIPS)
    assert re.search(r"\d (N|mm)", " ".join(frame_text(now, "", None))) is None
    assert alerts(info(0.01), [now]) == [f"No force: {missing}"]
    assert np.isnan(now.size)


def test_a_cloud_of_another_organ_is_not_drawn() -> None:
    """The contact node still uses the last patient, whose cloud may have as many points."""
    state, drawn, greys = SharedToolState.make(), [], []
    stamp = stamp_bytes(5)
    view: Any = SimpleNamespace(move=lambda *given: drawn.append(given) or 1e-3, grey=greys.append)
    live = Live(None, state, Recorder(state))  # type: ignore[arg-type]
    cloud: Any = SimpleNamespace(take=lambda: (stamp, np.ones((4, 6), np.float32)))
    live._cloud, live.organ = cloud, organ_number("b" * 64)
    state.recent[:, 0], state.all["n_recent"] = row(OK, 3.0, stamp=5), 1
    state.all["heard"] = time.monotonic_ns()
    for identity, missing in (("a" * 64, OTHER_ORGAN), ("", OTHER_ORGAN), ("b" * 64, "")):
        state.recent["organ"][0, 0] = organ_number(identity)
        (found,) = live.draw(view)
        assert found.missing == missing
    assert len(drawn) == 1 and greys == [True, True, False]
    assert found.size == 3.0 and found.largest == 1e-3


def test_an_error_that_was_never_measured_is_not_zero() -> None:
    chooser, pressed = PeriodChooser(), row(OK, 12.0)
    pressed["error"] = np.nan
    chooser.take(pressed)
    text = frame_text(chooser.drawn(pressed, 1e-3, TIPS)[0], "", None)[0]
    assert text == "Force <b>12.00 N</b> (error unknown)"


def test_a_name_is_no_html() -> None:
    """Anybody may have named an organ, and a page that ran it would move the tool for them."""
    named = replace(Organ.of(organ("cube")), name="<img src=x onerror=alert(1)>")
    assert "<img" not in named.summary() and "&lt;img" in named.summary()
    page: Any = SimpleNamespace(_banner=SimpleNamespace(content=""))
    Panels.show_alerts(page, [f"Image {named.name}"])
    assert "<img" not in page._banner.content and "&lt;img" in page._banner.content


def test_a_library_that_is_gone_is_said_and_ends_nothing(tmp_path: Path) -> None:
    said: list[str] = []
    panels = SimpleNamespace(offer=lambda *names: None)
    page: Any = SimpleNamespace(
        _library=Library(tmp_path / "gone"), _say=said.append, _panels=panels
    )
    PlanningNode._offer_files(page)
    assert said == ["the library cannot be read: No such file or directory"]


def test_a_recording_ends_where_nothing_more_is_kept() -> None:
    state = SharedToolState.make()
    recorder = Recorder(state)
    state.all["recording"] = 1
    assert not recorder.is_full
    state.all["n_rows"] = N_ROWS
    assert recorder.is_full
    recorder.drop()
    assert not recorder.is_full
    state.all["n_rows"], state.all["recording"] = 0, 1
    recorder._clouds = 3 * [np.broadcast_to(np.float32(0.0), (100_000_000, 1))]
    assert recorder.is_full


def test_a_recording_without_a_surface_is_written(tmp_path: Path) -> None:
    """Of a contact node that sends none."""
    state, cube = SharedToolState.make(), replace(organ("cube"), id="a" * 64)
    recorder = Recorder(state)
    recorder.open(cube, Scene(effects=()), 1000.0)
    recorder.begin()
    state.rows[:, 0], state.all["n_rows"] = row(OK, 1.0), 1
    saved = recorder.save(tmp_path)
    assert saved is not None and len(saved[1].clouds.period) == 0
    assert len(load_recording(saved[0]).periods) == 1


def test_organs_are_told_apart_by_their_ids() -> None:
    ids = ("", 64 * "a", "b" + 63 * "a", 15 * "a" + 49 * "b")
    assert len({organ_number(identity) for identity in ids}) == len(ids)
    row(OK, 1.0)["organ"] = organ_number(64 * "f")  # fits


def test_a_tool_without_a_pose_is_drawn_where_it_was_sent() -> None:
    chooser, far = PeriodChooser(), row(ContactState.STATUS_STALE_POSE, 0.0)
    for away in (np.full(3, 1e3), np.full(3, np.nan)):
        far["tip"] = away
        chooser.take(far)
        np.testing.assert_array_equal(chooser.drawn(far, 0.0, TIPS)[0].tip, TIP)


def test_missed_periods_are_said_beside_nodes_that_answer() -> None:
    assert warnings((), True, (OK,), missed=0.001) == "All nodes answer."
    busy = warnings((), True, (OK,), missed=0.2)
    assert busy.startswith("⚠ All nodes answer, but 20% of the periods come late")
    alone = warnings(("vademecum_loader",), True, (OK,), missed=0.2)
    assert "nodes answer" not in alone and "20% of the periods come late" in alone


@pytest.mark.parametrize("statuses", [(), (OK,), *((status,) for status in EXPLANATIONS)])
def test_each_line_ends_with_one_mark(statuses: tuple[int, ...]) -> None:
    for line in warnings(("vademecum_loader",), False, statuses, missed=0.2).splitlines():
        assert line[0] == "⚠" and not line[2].islower()
        assert line[-1] in ".?" and line[-2].isalnum() | (line[-2] in "`')")


def test_a_patient_of_large_expected_error_is_marked() -> None:
    """Interpolated patients are 16 % wrong; what was never measured is no better."""
    now = shown(0.0, 0.0, 1.0, 0.0)
    (alert,) = alerts(info(0.16), [now])
    assert "Large expected error" in alert and "16%" in alert
    assert "never measured" in alerts(info(float("nan")), [now])[0]
    assert alerts(info(0.02), [now]) == []


def test_an_extrapolated_force_is_marked_and_one_that_fades_in_is_not() -> None:
    now = shown(3.0, 0.1, 0.5, 1e-3)
    extrapolated = now._replace(status=ContactState.STATUS_EXTRAPOLATED)
    assert "Extrapolated" in alerts(info(0.01), [extrapolated])[0]
    assert alerts(info(0.01), [now._replace(status=ContactState.STATUS_ENGAGING)]) == []


def info(error: float) -> VademecumInfo:
    """Of a vademecum with an expected error of its displacement."""
    values: dict[str, Any] = {field.name: 0 for field in fields(VademecumInfo)}
    return VademecumInfo(**values | {"l2_mean": error, "force_mean": 0.01})


def test_a_recording_says_what_it_lacks() -> None:
    number = np.concatenate([np.arange(300), np.arange(310, 500)])
    n = len(number)
    periods = Periods(
        number=number,
        stamp=1_000_000 * np.linspace(0, 999, n).astype(np.int64),
        tip=np.zeros((n, 1, 3)),
        turn=np.zeros((n, 1, 3)),
        status=np.zeros((n, 1), np.uint8),
        force=np.zeros((n, 1, 3)),
        error=np.zeros((n, 1)),
        sent_fraction=np.ones((n, 1)),
    )
    clouds = Clouds(np.zeros(0, np.int64), np.zeros((0, 0, 3), np.float32))
    made = Recording("0" * 64, "liver", "", 1000.0, True, periods, clouds)
    assert recorded_text(made) == (
        "recorded 1.0 s, 490 of 1,000 periods (500 came late in the loop, 10 lost)"
    )
    often = replace(periods, stamp=periods.stamp // 5, number=np.arange(n))  # of several tools
    assert recorded_text(replace(made, periods=often)) == "recorded 0.2 s, 490 of 490 periods"
