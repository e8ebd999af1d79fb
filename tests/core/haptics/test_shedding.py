"""Shedding modes when a machine is busy, and taking them back."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from avatar_core.haptics.shedding import CALM, OVERLOADED, PATIENCE, Shedder

LEVELS = (10, 20, 40, 80)
CALM_WINDOW, BUSY = (0.0, 50e-6), (0.05, 50e-6)


def test_missed_periods_shed_a_level_each_and_never_the_last() -> None:
    """``rest`` takes all levels back at once, calm periods one by one."""
    shedder = Shedder(LEVELS)
    assert [shedder.update(*BUSY) for _ in range(5)] == [40, 20, 10, 10, 10]
    assert shedder.is_shedding
    shown = [shedder.update(*CALM_WINDOW) for _ in range(3 * PATIENCE)]
    assert shown[PATIENCE - 2 : PATIENCE] == [10, 20]
    assert shown[-1] == 80 and not shedder.is_shedding
    assert shown == sorted(shown)
    shedder.update(*BUSY)
    assert shedder.rest() == 80 and not shedder.is_shedding


def test_slow_steps_shed_without_a_missed_period() -> None:
    shedder = Shedder(LEVELS, deadline=100e-6)
    assert shedder.update(0.0, 120e-6) == 40
    assert [shedder.update(0.0, 90e-6) for _ in range(20)] == [40] * 20  # no room to take back
    assert [shedder.update(0.0, 70e-6) for _ in range(PATIENCE)][-1] == 80


def test_between_calm_and_overloaded_nothing_changes() -> None:
    shedder = Shedder(LEVELS)
    shedder.update(*BUSY)
    between = (CALM + OVERLOADED) / 2
    assert {shedder.update(between, 50e-6) for _ in range(50)} == {40}


def test_a_level_that_is_too_many_is_tried_ever_more_rarely() -> None:
    """A machine can compute 40 modes but not 80: changes must not go on at the same rate."""
    shedder = Shedder(LEVELS)
    changes, before = [], shedder.modes
    for window in range(400):
        now = shedder.update(*(BUSY if before > 40 else CALM_WINDOW))
        if now != before:
            changes.append(window)
        before = now
    first = sum(window < 100 for window in changes)
    last = sum(window >= 300 for window in changes)
    assert first >= 5 and last <= first / 2


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1e-3) | st.just(float("nan")))))
def test_any_windows_keep_to_the_levels(windows: list[tuple[float, float]]) -> None:
    shedder = Shedder(LEVELS, 200e-6)
    for window in windows:
        before = LEVELS.index(shedder.modes)
        after = LEVELS.index(shedder.update(*window))
        assert abs(after - before) <= 1
