"""Accuracy and time in the contact node: enforced and reported."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from avatar_core.errors import AccuracyError
from avatar_core.vademecum.accuracy import Budget
from avatar_interfaces.msg import ContactState, LoopStatistics
from avatar_ros.framework import qos
from avatar_ros.loop.shown_modes import ShownModes, ShownModesReport
from avatar_ros.nodes.contact_reports import ShownModesLog
from tests.helpers.contact import prepare
from tests.ros.conftest import START_TIMEOUT, Probe
from tests.ros.helpers.hand import Hand, felt
from tests.ros.helpers.parameters import parameter_values, set_parameter

pytestmark = pytest.mark.long  # it builds an organ and starts nodes

# --- Shedding, without a node ------------------------------------------------------------------


def window(missed: int, step_p99: float) -> LoopStatistics:
    return LoopStatistics(periods=1000, missed=missed, step_p99=step_p99)


def test_missed_periods_leave_out_modes_and_calm_takes_them_back(organ: Any) -> None:
    data = prepare(organ)
    accuracy = ShownModes(data, organ.certificate.curve.of("surface"))
    report = accuracy.update(window(50, 30e-6))
    assert report.shedding and report.changed
    assert data.n_shown < data.model.n_modes
    assert "5.0% of the periods missed" in report.text and "force keeps all modes" in report.text
    for _ in range(5):
        report = accuracy.update(window(0, 30e-6))
    assert not report.shedding and data.n_shown == data.model.n_modes


def test_nobody_looks_and_no_mode_is_left_out(organ: Any) -> None:
    data = prepare(organ)
    accuracy = ShownModes(data, organ.certificate.curve.of("surface"))
    accuracy.update(window(50, 30e-6), watched=True)
    assert data.n_shown < data.model.n_modes
    for _ in range(3):
        report = accuracy.update(window(50, 30e-6), watched=False)
        assert not report.shedding and data.n_shown == data.model.n_modes
    assert accuracy.update(window(50, 30e-6), watched=True).shedding


def test_the_log_names_modes_left_out_once_a_minute(probe: Probe) -> None:
    """The return is logged with another severity, which rclpy forbids in one line of code."""
    now, said = [0.0], []
    logger = probe.node.get_logger()

    class Heard:
        def warning(self, text: str) -> None:
            said.append((now[0], text))
            logger.warning(text)

        def info(self, text: str) -> None:
            said.append((now[0], text))
            logger.info(text)

    log = ShownModesLog(SimpleNamespace(get_logger=Heard), lambda: now[0])
    for second in range(130):
        now[0] = float(second)
        left_out = second % 4 < 2
        log.note(ShownModesReport("left out" if left_out else "all", left_out, second % 2 == 0))
    assert said == [
        (0, "left out"),
        (2, "all"),
        (60, "left out"),
        (62, "all"),
        (120, "left out"),
        (122, "all"),
    ]


def test_statistics_say_how_accurate_the_modes_that_were_shown_are(organ: Any) -> None:
    data = prepare(organ)
    curve = organ.certificate.curve.of("surface")
    points, accuracy = {p.detail.modes: p for p in curve.points}, ShownModes(data, curve)
    first, second = window(50, 30e-6), window(0, 30e-6)
    accuracy.update(first)
    accuracy.update(second)
    assert first.modes_shown == first.modes == data.model.n_modes
    assert first.promised_l2 == points[data.model.n_modes].l2
    assert second.modes_shown == data.n_shown
    assert second.promised_l2 == points[data.n_shown].l2 > first.promised_l2
    assert second.promised_force == first.promised_force


def test_a_budget_chooses_what_keeps_it(organ: Any) -> None:
    data, curve = prepare(organ), organ.certificate.curve.of("surface")
    shown, most = ShownModes(data, curve), data.model.n_modes
    loose = 3.0 * curve.points[-1].l2
    shown.keep(Budget(loose, 1.0))
    assert data.n_shown < most
    point = next(p for p in curve.points if p.detail.modes == data.n_shown)
    assert point.l2 <= loose and f"within {point.l2:.1%}" in shown.accuracy
    before = data.n_shown
    with pytest.raises(AccuracyError, match="nearest: "):
        shown.keep(Budget(1e-6, 1.0))
    assert data.n_shown == before
    shown.keep(None)
    assert data.n_shown == most
    shown.keep(Budget(1.0, 1.0))
    with pytest.raises(AccuracyError, match="no accuracy curve"):
        ShownModes(data, None).keep(Budget(1.0, 1.0))


# --- In the cell -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def probe(lasting_probe: Any) -> Any:
    return lasting_probe


@pytest.fixture
def hand(cell: dict[str, Any], probe: Any, touch: tuple[np.ndarray, np.ndarray]) -> Hand:
    probe.next(ContactState, "contact_state", qos.state(1), lambda state: state.vademecum_id)
    return Hand(probe, touch[0])


def set_budget(probe: Any, **value: Any) -> Any:
    """Set a parameter below ``accuracy``; return the answer."""
    ((name, wanted),) = value.items()
    return set_parameter(probe, "contact", f"accuracy.{name}", wanted)


def statistics(probe: Any, hand: Hand, wanted: Any) -> LoopStatistics:
    return probe.next(LoopStatistics, "statistics", qos.STATISTICS, wanted, 2 * START_TIMEOUT, hand)


def test_force_comes_with_its_error(probe: Any, hand: Hand) -> None:
    state = probe.next(
        ContactState,
        "contact_state",
        qos.state(1),
        lambda state: state.contacts and state.status == ContactState.STATUS_OK,
        meanwhile=hand,
    )
    force = state.contacts[0].force
    size = np.linalg.norm([force.x, force.y, force.z])
    assert 1e-4 * size < state.force_error < size


def test_a_tolerance_shows_fewer_modes_and_leaves_the_force(
    probe: Any, hand: Hand, organ: Any
) -> None:
    """On any busy machine, the fastest of all details is not the one with all modes."""
    rank = organ.n_modes
    before = statistics(probe, hand, lambda s: s.modes == rank and s.step_p99 > 0.0)
    assert before.modes_shown == rank or before.missed > 0
    _, force = felt(probe, hand)
    assert set_budget(probe, tolerance=1.0).successful
    update = statistics(probe, hand, lambda s: 0 < s.modes < rank)
    assert organ.certificate.curve.of("surface").points[-1].l2 < update.promised_l2 <= 1.0
    np.testing.assert_allclose(felt(probe, hand)[1], force, rtol=1e-6)
    assert set_budget(probe, tolerance=0.0).successful
    statistics(probe, hand, lambda s: s.modes == rank)


def test_a_tolerance_beyond_every_detail_is_refused_in_the_answer(
    probe: Any, hand: Hand, organ: Any
) -> None:
    statistics(probe, hand, lambda s: s.modes > 0)  # a vademecum is in use
    answer = set_budget(probe, tolerance=1e-6)
    best = min(p.l2 for p in organ.certificate.curve.of("surface").points)
    assert not answer.successful
    assert f"within 1e-06 of l2 in any time; nearest: {best:.3g}" in answer.reason
    kept = parameter_values(probe, "contact", ["accuracy.tolerance"])
    assert kept == {"accuracy.tolerance": 0.0}


def test_a_deadline_below_all_measured_times_is_refused(probe: Any, hand: Hand) -> None:
    answer = set_budget(probe, deadline=1e-7)
    assert not answer.successful and "nearest: " in answer.reason
    statistics(probe, hand, lambda s: s.modes_shown > 0)  # it goes on


@pytest.mark.parametrize(
    ("values", "reason"), [({"quantity": "taste"}, "l2 or force"), ({"tolerance": -1.0}, "range")]
)
def test_a_budget_without_meaning_is_refused_at_once(
    probe: Any, hand: Hand, values: dict[str, Any], reason: str
) -> None:
    answer = set_budget(probe, **values)
    assert not answer.successful and reason in answer.reason


def diagnostics(probe: Any, hand: Hand, wanted: Any) -> dict[str, DiagnosticStatus]:
    """Return the contact node's statuses by name, once they are ``wanted``."""
    named = lambda array: {status.name: status for status in array.status}  # noqa: E731
    array = probe.next(
        DiagnosticArray, "/diagnostics", qos.STATISTICS, lambda a: wanted(named(a)), 60.0, hand
    )
    return named(array)


def test_diagnostics_say_what_is_shown_and_how_the_loop_is(probe: Any, hand: Hand) -> None:
    state, _ = felt(probe, hand)
    found = diagnostics(probe, hand, lambda named: "/contact: accuracy" in named)
    accuracy = found["/contact: accuracy"]
    assert accuracy.level in (DiagnosticStatus.OK, DiagnosticStatus.WARN)
    assert "modes shown" in accuracy.message
    assert {v.key: v.value for v in found["/contact: vademecum"].values}["id"] == state.vademecum_id
    loop = {v.key: float(v.value) for v in found["/contact: loop"].values}
    assert loop["rate [Hz]"] == pytest.approx(1e6 / loop["period mean [us]"], rel=1e-3)
    assert loop["execution mean [us]"] <= loop["execution max [us]"]


def test_diagnostics_name_a_fault_its_remedy_and_its_end(probe: Any, hand: Hand) -> None:
    hand.pose.header.frame_id = "world"
    fault = diagnostics(probe, hand, lambda n: "another frame" in n["/contact: tool"].message)
    assert fault["/contact: tool"].level == DiagnosticStatus.WARN
    assert "tool_transform" in fault["/contact: tool"].message
    hand.pose.header.frame_id = "organ"
    sound = diagnostics(probe, hand, lambda n: n["/contact: tool"].level == DiagnosticStatus.OK)
    assert sound["/contact: tool"].message == "poses valid, full force sent"
    assert sound["/contact: tool"].hardware_id == "/tool"  # named after its driver
    assert sound["/contact: loop"].hardware_id == socket.gethostname()
