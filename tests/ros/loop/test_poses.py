"""Faulty poses, through the parser and the loop, without any other process.

The loop is stepped by hand on a clock that the test sets. Tools read serialised poses from a queue
of depth one, as the subscription's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message

from avatar_interfaces.msg import ContactState
from avatar_ros.loop.contact_loop import ActiveModel
from avatar_ros.loop.diagnostics import FaultCounter
from avatar_ros.loop.statistics import statistics
from tests.ros.helpers.stepped_loop import NOW, SECOND, TIP, pose

OK, INVALID = int(ContactState.STATUS_OK), int(ContactState.STATUS_INVALID_POSE)
STALE, BARRED = int(ContactState.STATUS_STALE_POSE), int(ContactState.STATUS_OUT_OF_RANGE)
SLOW, LOST = int(ContactState.STATUS_SLOW_POSES), int(ContactState.STATUS_LOST_TOOL)
UNKNOWN_FRAME = int(ContactState.STATUS_UNKNOWN_FRAME)


@pytest.mark.parametrize("depth", [0.0, 8e-3])
def test_a_broken_pose_costs_one_period(bench: Any, touch: Any, depth: float) -> None:
    """Even if a tip is deeper than any contact may begin: 7 mm for its centre."""
    cell = bench()
    tip = cell.press(touch, depth)
    before = cell.step(pose(tip))[1]
    assert before.any()
    broken = {
        "norm 0": pose(tip, quaternion=0.0 * TIP),
        "norm 2": pose(tip, quaternion=2.0 * TIP),
        "NaN": pose(tip * np.array([1.0, math.nan, 1.0])),
        "infinite": pose(tip + math.inf),
        "no stamp": pose(tip, stamp=0),
        "cut": pose(tip)[:40],
        "empty": b"organ"[:0],
    }
    for name, message in broken.items():
        status, force = cell.step(message)
        assert status in (INVALID, UNKNOWN_FRAME), name
        assert not force.any(), name
        if status == UNKNOWN_FRAME:  # its header was cut; its sender is not known
            cell.press(touch, depth)
        status, after = cell.step(pose(tip))
        assert status == OK, name
        np.testing.assert_allclose(after, before, rtol=1e-12, err_msg=name)


def test_a_clock_that_goes_back_is_only_told(bench: Any, touch: Any) -> None:
    """Poses count by their arrival; the answer carries their stamp, whatever it is."""
    cell = bench()
    tip = cell.press(touch, 0.0)
    before = cell.step(pose(tip))[1]
    for back in (1, SECOND, 3600 * SECOND, 1_699_999_999 * SECOND, -300 * SECOND):
        status, force = cell.step(pose(tip, stamp=NOW - back))
        assert status == OK
        np.testing.assert_array_equal(force, before)
        wrench = deserialize_message(cell.poses[0].sent[-1], WrenchStamped)
        stamp = wrench.header.stamp
        assert stamp.sec * SECOND + stamp.nanosec == NOW - back
    summary = statistics(cell.loop.record, round(1e9 * cell.now))
    assert math.isfinite(summary.pose_age_p99)
    assert summary.missed == 0


def test_the_age_is_that_of_the_pose_that_was_answered(bench: Any, touch: Any) -> None:
    """A first tool without a pose must not give an age of 54 years."""
    cell = bench(n_tools=2)
    for _ in range(5):
        cell.now += 1e-3
        cell.poses[1].waiting = pose(touch[0], stamp=NOW + round(1e9 * cell.now) - 200_000)
        cell.loop._step()
    ages = cell.loop.record.ages[: cell.loop.record.n_ages]
    np.testing.assert_array_equal(ages, 200_000)


def test_5_khz_and_10_hz(bench: Any, touch: Any) -> None:
    """The last of five poses in a period counts; between two in 100 periods the last holds."""
    path = [touch[0] - 1e-3 * math.sin(k / 300) * touch[1] for k in range(3000)]
    cell = bench(timeout=0.5)
    cell.press(touch, 0.0)
    fine: list[list[float]] = []
    for k in range(0, 3000, 5):
        for tip in path[k : k + 4]:
            cell.poses[0].waiting = pose(tip)
        status, force = cell.step(pose(path[k + 4]))
        assert status == OK
        if k % 500 == 0:
            fine.append([k, *force])
    cell = bench(timeout=0.5)
    cell.press(touch, 0.0)
    for k, *force in fine:
        for period in range(100):
            status, held = cell.step(pose(path[int(k) + 4]) if period == 0 else None)
            assert status == OK
            np.testing.assert_array_equal(held, force)
    assert np.ptp(np.linalg.norm(np.array(fine)[:, 1:], axis=1)) > 0.1


@pytest.mark.long
@pytest.mark.parametrize("hertz", [1, 5, 20, 33, 45])
def test_a_slow_stream_is_called_so_before_its_second_pose(
    bench: Any, touch: Any, hertz: int
) -> None:
    """A first pose is answered; a late second one is a slow rate, not an end."""
    cell = bench(timeout=0.02)
    cell.step(None, after=60.0)  # as if nobody was there
    counter = FaultCounter(cell.tools)
    period, said = 1000 // hertz, set()
    for k in range(3000):
        status, _ = cell.step(pose(touch[0]) if k % period == 0 else None)
        if k != 20:  # at the timeout itself
            assert status == (OK if k < 20 else SLOW)
        if k % 1000 == 50:
            said |= {faults.text for faults in counter.window()}
    assert len(said) == 1 and "more slowly than pose_timeout allows" in said.pop()


def test_one_pose_and_no_other_is_a_stream_that_ended(bench: Any, touch: Any) -> None:
    cell = bench(timeout=0.02)
    statuses = [cell.step(pose(touch[0]) if k == 0 else None)[0] for k in range(3000)]
    assert statuses[:20] == [OK] * 20 and statuses[2600:] == [STALE] * 400


@pytest.mark.parametrize("publishers", [0, 1])
def test_a_stream_is_not_slow_for_the_one_before_it(
    bench: Any, touch: Any, publishers: int
) -> None:
    cell = bench(timeout=0.02)
    slow = [cell.step(pose(touch[0]) if k % 30 == 0 else None)[0] for k in range(600)]
    assert slow[-1] == SLOW
    cell.tools[0].publishers = publishers
    ended = [cell.step(None)[0] for _ in range(3000)]
    assert ended[-1] == (STALE if publishers else LOST)
    statuses = {cell.step(pose(touch[0]) if k % 10 == 0 else None)[0] for k in range(600)}
    assert SLOW not in statuses and OK in statuses


@pytest.mark.parametrize("hertz", [100, 1000])
def test_one_gap_in_a_stream_makes_it_not_slow(bench: Any, touch: Any, hertz: int) -> None:
    cell = bench(timeout=0.02)
    tip = cell.press(touch, 0.0)
    period = 1000 // hertz
    found = [
        cell.step(pose(tip) if k % period == 0 and not 40 < k < 140 else None)[0]
        for k in range(300)
    ]
    assert found[45:60] == [OK] * 15 and found[62:140] == [STALE] * 78
    assert found[140:] == [OK] * 160


@pytest.mark.parametrize("hertz", [100, 1000])
def test_a_tool_that_joins_an_idle_loop_is_not_slow(bench: Any, touch: Any, hertz: int) -> None:
    """Its first poses are taken before and after a long sleep, without a model and any tool."""
    cell = bench(timeout=0.02)
    loop, tool = cell.loop, cell.tools[0]
    loop.active = loop._used = ActiveModel("", None, cell.settings)
    sent, times = 0, []
    for _ in range(100):
        cell.now = max(cell.now, 1e-9 * loop._due)
        times.append(cell.now)
        if len(times) > 3 and cell.now * hertz >= sent + 1:
            sent = math.floor(cell.now * hertz)
            cell.poses[0].waiting = pose(touch[0])
        loop._step()
    np.testing.assert_allclose(np.diff(times)[:2], 0.1)
    np.testing.assert_allclose(np.diff(times)[-9:], 0.005)
    assert tool.status == OK
    assert list(np.flatnonzero(tool.faults)) == [OK]


@pytest.mark.long
@pytest.mark.parametrize("hertz", [1, 5, 20, 33, 100, 1000])
@pytest.mark.parametrize("fault", ["frame", "stamp", "NaN", "quaternion"])
def test_what_came_last_says_why_there_is_no_force(
    bench: Any, touch: Any, hertz: int, fault: str
) -> None:
    """Also between two refused poses, however slow, and after the first."""
    cell = bench(timeout=0.02)
    spoilt, expected = {
        "frame": (pose(touch[0], frame="world"), UNKNOWN_FRAME),
        "stamp": (pose(touch[0], stamp=0), INVALID),
        "NaN": (pose(np.full(3, np.nan)), INVALID),
        "quaternion": (pose(touch[0], quaternion=np.zeros(4)), INVALID),
    }[fault]
    cell.tools[0].publishers = 0  # as counted before this one joined
    period = 1000 // hertz
    found = [cell.step(spoilt if k % period == 0 else None) for k in range(2500)]
    assert {status for status, _ in found} == {expected}
    assert not np.array([force for _, force in found]).any()
    for _ in range(2600):
        status = cell.step(None)[0]
    assert status == STALE
    cell.step(spoilt)
    cell.tools[0].publishers = 0
    assert cell.step(None)[0] == LOST


@pytest.mark.parametrize("hertz", [1, 5, 20, 33, 45, 100, 1000])
@pytest.mark.parametrize("age", [0, 3600], ids=["valid", "old"])
def test_a_stream_is_judged_by_when_it_comes(bench: Any, touch: Any, hertz: int, age: int) -> None:
    """Stamps are not compared: another machine's clock may be an hour behind."""
    cell = bench(timeout=0.02)
    tip = cell.press(touch, 0.0)
    counter = FaultCounter(cell.tools)
    period, expected = 1000 // hertz, OK if hertz > 67 else SLOW
    said = set()
    for k in range((3 + math.ceil(1200 / period)) * period):
        stamp = NOW - age * SECOND + k * 1_000_000
        status, force = cell.step(pose(tip, stamp=stamp) if k % period == 0 else None)
        if k == 3 * period:
            counter.window()
        if k >= 3 * period:
            assert status == expected
            assert force.any() == (expected == OK)
        if k > 3 * period and k % 1000 == 0:
            said |= {faults.text for faults in counter.window()}
    what = "more slowly than pose_timeout allows" if expected == SLOW else ""
    assert said and all(what in text and bool(text) == bool(what) for text in said)
    again = [cell.step(pose(tip)) for _ in range(5)]  # at 1 kHz
    assert [status == OK for status, _ in again] == [expected == OK] * 2 + [True] * 3
    assert again[-1][1].any()


def test_a_tool_whose_device_is_not_ready_enters_no_organ(bench: Any, touch: Any) -> None:
    """A hand moves it there without resistance: once ready, it has no force before it came out."""
    cell = bench()
    cell.tools[0].device = ContactState.STATUS_NOT_ENABLED
    for d in np.arange(-6e-3, 20e-3, 1e-3):
        status, force = cell.step(pose(touch[0] - d * touch[1]))
        assert status == ContactState.STATUS_NOT_ENABLED and not force.any()
    cell.tools[0].device = OK
    for _ in range(300):
        status, force = cell.step(pose(touch[0] - 20e-3 * touch[1]))
        assert status == BARRED and not force.any()
    cell.step(pose(touch[0] + 20e-3 * touch[1]))
    tip = cell.press(touch, 1e-3)
    assert cell.step(pose(tip))[1].any()


def test_a_tip_that_stays_out_of_range_is_a_fault_that_lasts(bench: Any, touch: Any) -> None:
    """It lasts until the tip has left the organ; its poses are valid all the time."""
    cell = bench()
    cell.press(touch, 0.0)
    cell.step(None, after=60.0)
    counter = FaultCounter(cell.tools)
    for _ in range(3):
        found = [cell.step(pose(touch[0] - 30e-3 * touch[1]))[0] for _ in range(10)]
        assert found == [BARRED] * 10
        assert counter.window()[0].text.startswith(
            "no force: the tool is off the accessible surface, too deep"
        )
    for _ in range(2):
        cell.step(pose(touch[0] + 12e-3 * touch[1]))
        said = counter.window()[0].text
    assert said == ""


@pytest.mark.parametrize(("depth", "expected"), [(0.0, OK), (10e-3, BARRED)])
def test_a_minutes_silence(bench: Any, touch: Any, depth: float, expected: int) -> None:
    """A tip that returns where a contact may begin has force again; a deeper one must come out."""
    cell = bench()
    tip = cell.press(touch, depth)
    before = cell.step(pose(tip))[1]
    status, force = cell.step(None, after=60.0)
    assert status == STALE and not force.any()
    status, force = cell.step(pose(tip))
    assert status == expected
    if expected == OK:
        np.testing.assert_array_equal(force, before)
        return
    assert not force.any()
    cell.step(pose(touch[0] + 12e-3 * touch[1]))
    np.testing.assert_array_equal(cell.step(pose(cell.press(touch, depth)))[1], before)
