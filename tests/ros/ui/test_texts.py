"""Numbers that the planning page writes and draws for a period: its own force, and no other."""

from __future__ import annotations

import re
import time
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viser import ViserServer

from avatar_core.vademecum.record import VademecumInfo
from avatar_interfaces.msg import ContactState
from avatar_ros.framework.templates import stamp_bytes
from avatar_ros.loop.statuses import EXPLANATIONS, explanation
from avatar_ros.nodes.planning_ui import PlanningNode
from avatar_ros.ui.panels import Panels
from avatar_ros.ui.scan.library import Library
from avatar_ros.ui.session.alerts import alerts, alerts_of_organ
from avatar_ros.ui.session.force_band import BandRatios
from avatar_ros.ui.session.live import Live
from avatar_ros.ui.session.recorder import Recorder
from avatar_ros.ui.session.shown_period import (
    OTHER_ORGAN,
    OTHER_UNKNOWN,
    SILENT,
    PeriodChooser,
    ShownPeriod,
)
from avatar_ros.ui.session.texts import (
    BAND,
    COVERS,
    frame_text,
    other_scenes,
    plain,
    scene_texts,
    warnings,
)
from avatar_ros.ui.tabs.scene import SceneTab
from avatar_ros.ui.tools.tool_state import N_RECENT, SharedToolState, organ_number
from avatar_ros.ui.view.organ import Organ
from tests.ros.helpers.page import NAMES, OK, OUT, PLACES, TIP, Noted, rows, send

# statuses of a period whose step computed no force, though the tool may press
NO_FORCE = (OUT, ContactState.STATUS_SLOW_POSES, ContactState.STATUS_LEAP)


def shown(force: float, error: float, largest: float) -> ShownPeriod:
    return ShownPeriod(TIP, np.array([0.0, force, 0.0]), error, largest)


def info(error: float) -> VademecumInfo:
    """Return the info of a vademecum with an expected error of its displacement."""
    values: dict[str, Any] = {field.name: 0 for field in fields(VademecumInfo)}
    return VademecumInfo(**values | {"l2_mean": error, "force_mean": 0.01})


EXACT = info(0.01)


@pytest.fixture
def chooser() -> PeriodChooser:
    return PeriodChooser()


def drawn(
    chooser: PeriodChooser, now: np.ndarray, largest: float = 1e-3
) -> tuple[ShownPeriod, ...]:
    """Return the shown numbers of a period, with a cloud of a largest displacement [m]."""
    chooser.take(now)
    return chooser.drawn(now, largest, PLACES[: len(now)])


@pytest.mark.parametrize("status", [OK, ContactState.STATUS_ENGAGING])
def test_no_device_is_spoken_of_at_tools_that_the_page_moves(
    chooser: PeriodChooser, status: int
) -> None:
    """A device's force would be limited or faded in; the page shows the organ's own."""
    now = rows((status, 25.0))
    now["sent_fraction"] = 0.0
    (period,) = drawn(chooser, now, 0.0071)
    numbers = [line for line in frame_text(period, "E 170 kPa", None) if " N" in line]
    assert numbers == ["Force <b>25.00 N</b> ± 0.00 N"]
    assert alerts(EXACT, (), [period]) == []


def test_no_displacement_is_not_none() -> None:
    """Without a surface from the contact node, 20 N do not stand beside 0.0 mm."""
    text = " ".join(frame_text(shown(20.0, 1.0, float("nan")), "", None))
    assert "20.00 N" in text and "mm" not in text and "sends no surface" in text


def test_a_force_is_that_of_the_clouds_period(state: SharedToolState) -> None:
    assert state.period(5) is None
    for n in range(3 * N_RECENT):
        send(state, rows((OK, 0.001 * n), (OK, 0.0), stamp=1000 + n))
    found = state.period(1000 + 3 * N_RECENT - 100)
    assert found is not None and found["force"][0, 1] == 0.001 * (3 * N_RECENT - 100)
    newest = state.period(77)  # the cloud's state has not come: the newest
    assert newest is not None and (newest["stamp"] == 1000 + 3 * N_RECENT - 1).all()


def test_the_force_of_a_stamp_is_that_or_none(state: SharedToolState) -> None:
    period = rows((OK, 0.0), (OK, 1.0))
    period["stamp"], period["force"][0] = [7, 8], [0.0, 3.0, 4.0]
    send(state, period)
    assert state.force_of(0, 7) == pytest.approx(5.0)
    assert state.force_of(1, 8) == pytest.approx(1.0)
    assert np.isnan(state.force_of(0, 8))


# --- Shown numbers of a period ----------------------------------------------------------------


@pytest.mark.parametrize("status", NO_FORCE)
def test_without_a_force_the_last_valid_shape_stays(chooser: PeriodChooser, status: int) -> None:
    for force in (1.0, 20.0):
        assert chooser.take(rows((OK, force)))
        drawn(chooser, rows((OK, force)), 1e-4 * force)
    for _ in range(3):  # the organ of these periods lies at rest
        assert not chooser.take(rows((status, 0.0)))
        (held,) = drawn(chooser, rows((status, 0.0)), float("nan"))
        assert held.is_held and held.force[1] == 20.0 and held.largest == 2e-3
    text = " ".join(frame_text(held, "", None))
    assert "No force" in text and "20.00 N" in text and "2.0 mm" in text
    assert alerts(EXACT, (), [held]) == [f"No force: {explanation(status)}"]
    assert chooser.take(rows((OK, 0.0)))
    assert not drawn(chooser, rows((OK, 0.0)), 0.0)[0].is_held


def test_a_tool_that_never_touched_holds_nothing(chooser: PeriodChooser) -> None:
    assert chooser.take(rows((OUT, 0.0)))
    assert not drawn(chooser, rows((OUT, 0.0)), 0.0)[0].is_held
    drawn(chooser, rows((OK, 3.0)))
    chooser.forget()  # another organ
    assert chooser.take(rows((OUT, 0.0)))


@pytest.mark.parametrize("missing", [*NO_FORCE, SILENT, OTHER_ORGAN])
def test_what_is_not_known_is_not_zero(chooser: PeriodChooser, missing: int | str) -> None:
    """Poses that are too slow, a contact node that is gone, forces of another patient."""
    if isinstance(missing, str):
        now = ShownPeriod.without_force(TIP, missing)
    else:
        (now,) = drawn(chooser, rows((missing, 0.0)), 0.0)
        missing = explanation(missing)
    assert re.search(r"\d (N|mm)", " ".join(frame_text(now, "", None))) is None
    assert alerts(EXACT, (), [now]) == [f"No force: {missing}"]
    assert np.isnan(now.size)


def test_an_error_that_was_never_measured_is_not_zero(chooser: PeriodChooser) -> None:
    pressed = rows((OK, 12.0))
    pressed["error"] = np.nan
    text = frame_text(drawn(chooser, pressed)[0], "", None)[0]
    assert text == "Force <b>12.00 N</b> (error unknown)"


def test_a_tool_without_a_pose_is_drawn_where_it_was_sent(chooser: PeriodChooser) -> None:
    far = rows((ContactState.STATUS_STALE_POSE, 0.0))
    for away in (np.full(3, 1e3), np.full(3, np.nan)):
        far["tip"] = away
        np.testing.assert_array_equal(drawn(chooser, far, 0.0)[0].tip, TIP)


def test_numbers_are_of_their_own_tool_and_say_whose(chooser: PeriodChooser) -> None:
    shown = drawn(chooser, rows((OK, 1.0), (OK, 2.5)))
    assert [one.size for one in shown] == [1.0, 2.5]
    assert frame_text(shown[1], "", None, "right")[0].startswith("Force on right <b>2.50 N</b>")
    assert frame_text(shown[1], "", None)[0].startswith("Force <b>2.50 N</b>")


def test_a_tool_beyond_the_range_is_named_and_nothing_else_is_shown_as_of_now(
    chooser: PeriodChooser,
) -> None:
    """The organ of that period lies as if it were not there, and so do the other tools' forces."""
    before = rows((OK, 1.0), (OK, 2.0))
    for now in (before, rows((OK, 4.0), (OUT, 0))):
        assert chooser.take(now) == (now is before)
        shown = drawn(chooser, now)
    beyond = explanation(OUT)
    assert [one.missing for one in shown] == [OTHER_UNKNOWN, beyond]
    assert all(one.is_held for one in shown) and shown[0].force[1] == 1.0
    assert alerts(EXACT, (), shown, NAMES) == [
        f"left: No force: {OTHER_UNKNOWN}",
        f"right: No force: {beyond}",
    ]


def test_what_is_extrapolated_on_another_tool_is_not_missed(chooser: PeriodChooser) -> None:
    shown = drawn(chooser, rows((OK, 1.0), (ContactState.STATUS_EXTRAPOLATED, 25.0)))
    expected = "Extrapolated: beyond the computed range; do not rely on the force"
    assert alerts(EXACT, (), shown, NAMES) == [f"right: {expected}"]
    assert alerts(EXACT, (), [shown[1], shown[1]], NAMES) == [expected]  # both tools: shown once


def test_a_patient_of_large_expected_error_is_marked() -> None:
    """Interpolated patients are 16 % wrong; an unmeasured error is no better."""
    now = shown(0.0, 0.0, 0.0)
    (alert,) = alerts(info(0.16), (), [now])
    assert alert.startswith("Large expected error of displacement:")
    assert "never measured" in alerts(info(float("nan")), (), [now])[0]
    assert alerts(info(0.02), (), [now]) == []


def test_a_stiffness_that_nobody_chose_is_called_assumed() -> None:
    default = replace(EXACT, young_modulus=170e3)
    (alert,) = alerts_of_organ(default, ("poisson",))
    assert "Young's modulus is assumed: 170 kPa" in alert
    assert alerts_of_organ(default, ("young",)) == []  # given by a scene, a calibration or a user
    assert alerts_of_organ(replace(EXACT, young_modulus=8e3), ()) == []  # it was given for the file


def test_one_error_of_the_force_is_written_and_what_it_covers(cube: Organ) -> None:
    lines = frame_text(shown(4.9, 0.1, 1e-3), "", None)
    assert plain(lines[-1]) == COVERS and "±" in lines[0]
    unknown = frame_text(shown(4.9, float("nan"), 1e-3), "", None)
    assert COVERS not in map(plain, unknown)
    assert "force" not in cube.summary()


def test_an_extrapolated_force_is_marked_and_one_that_fades_in_is_not() -> None:
    now = shown(3.0, 0.1, 1e-3)
    extrapolated = now._replace(status=ContactState.STATUS_EXTRAPOLATED)
    assert "Extrapolated" in alerts(EXACT, (), [extrapolated])[0]
    assert alerts(EXACT, (), [now._replace(status=ContactState.STATUS_ENGAGING)]) == []


# --- The cloud --------------------------------------------------------------------------------


def test_a_cloud_is_drawn_with_all_tools_and_one_of_another_organ_is_not(
    state: SharedToolState,
) -> None:
    """The contact node may still use the last patient, whose cloud may have as many points."""
    page: Any = Noted(move=lambda *given: 1e-3)
    live = Live(None, state, Recorder(state))  # type: ignore[arg-type]
    cloud: Any = Noted(take=lambda: (stamp_bytes(5), np.ones((4, 6), np.float32)))
    live._cloud, live.organ = cloud, organ_number("b" * 64)
    state.all["heard"] = time.monotonic_ns()
    for identity, missing in (("a" * 64, OTHER_ORGAN), ("", OTHER_ORGAN), ("b" * 64, "")):
        state.all["n_recent"] = 0
        send(state, rows((OK, 1.0), (OK, 3.0), organ=organ_number(identity)))
        shown = live.draw(page)
        assert [one.missing for one in shown] == [missing, missing]
    assert page.of("grey") == [True, True, False]
    assert len(page.of("move")) == 1
    assert [one.size for one in shown] == [1.0, 3.0]
    assert shown[0].largest == 1e-3 and live.statuses == (OK, OK)


def test_organs_are_told_apart_by_their_ids() -> None:
    ids = ("", 64 * "a", "b" + 63 * "a", 15 * "a" + 49 * "b")
    assert len({organ_number(identity) for identity in ids}) == len(ids)
    rows((OK, 1.0), organ=organ_number(64 * "f"))  # fits


# --- The band of the material's distributions -------------------------------------------------


def test_the_page_shows_a_band_in_proportion_to_the_force_beside_it() -> None:
    now = [0.0]
    ratios = BandRatios(lambda: now[0])
    assert ratios.of(2.0) is None
    ratios.note(0, 0.6, 1.0)
    assert ratios.of(2.0) is None  # one edge alone is known
    ratios.note(1, 3.4, 2.0)
    ratios.note(1, 9.9, float("nan"))  # the force of the period is not known
    ratios.note(1, 0.0, 0.0)
    assert ratios.of(2.0) == pytest.approx((1.2, 3.4))
    assert ratios.of(0.0) is None
    now[0] = 2.0
    assert ratios.of(2.0) is None  # nothing came lately
    ratios.note(0, 0.6, 1.0)
    ratios.forget()
    assert ratios.of(2.0) is None


def test_the_band_stands_beside_the_force() -> None:
    now = shown(2.0, 0.1, 1e-3)
    assert BAND not in " ".join(frame_text(now, "", None))
    lines = frame_text(now._replace(band=(1.2, 3.4)), "", None)
    assert f"1.20 to 3.40 N: {BAND}" in lines


# --- Nodes and scenes -------------------------------------------------------------------------


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


def test_an_organ_that_is_being_prepared_is_not_called_missing() -> None:
    no_model = (ContactState.STATUS_NO_MODEL,)
    assert "it is preparing it" in warnings((), True, no_model)
    assert "No vademecum is loaded" in warnings((), False, no_model)


def test_a_fault_of_one_tool_is_said_with_its_name() -> None:
    lost = ContactState.STATUS_LOST_TOOL
    assert warnings((), True, (OK, lost), NAMES).startswith("⚠ right: ")
    assert "right" not in warnings((), True, (lost, lost), NAMES)
    assert warnings((), True, (OK, OK), NAMES) == "All nodes answer."


def test_scenes_are_those_of_as_many_tools_and_how_to_come_to_the_others_is_said(
    server: ViserServer,
) -> None:
    one, two = scene_texts(1), scene_texts(2)
    assert "two_tools" in two and "two_tools" not in one
    assert "palpation" in one and "palpation" not in two
    assert "`avatar cell --tools left,right`" in other_scenes(1) and "two_tools" in other_scenes(1)
    assert "palpation" in other_scenes(2) and "two_tools" not in other_scenes(2)
    tab = SceneTab(server.gui, Noted())  # type: ignore[arg-type]
    tab.offer(2)
    assert tab._scenes.options == tuple(two) and tab._others.content == other_scenes(2)


# --- Foreign text -----------------------------------------------------------------------------


def test_a_name_is_no_html(cube: Organ) -> None:
    """Anybody may have named an organ; a page that ran its name would move the tool for them."""
    named = replace(cube, name="<img src=x onerror=alert(1)>")
    assert "<img" not in named.summary() and "&lt;img" in named.summary()
    page: Any = SimpleNamespace(_banner=SimpleNamespace(content=""))
    Panels.show_alerts(page, [f"Image {named.name}"])
    assert "<img" not in page._banner.content and "&lt;img" in page._banner.content


def test_a_library_that_is_gone_is_said_and_ends_nothing(tmp_path: Path) -> None:
    said: list[str] = []
    library = Library(tmp_path / "gone", Noted())  # type: ignore[arg-type]
    page: Any = SimpleNamespace(_library=library, _say=said.append, _panels=Noted())
    PlanningNode._offer_files(page)
    assert said == ["the library cannot be read: No such file or directory"]
