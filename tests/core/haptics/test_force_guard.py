"""Limits, ramps and engagement of the sent force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar_core.errors import ContactError
from avatar_core.haptics.force_guard import (
    DEVICES,
    ENGAGEMENT,
    LEVER,
    RAMP,
    SETTLING,
    ForceGuard,
    ForceLimits,
)
from tests.helpers.examples import examples

PERIOD = 1e-3
LIMITS = ForceLimits(5.0, 1000.0)


class Drive:
    """A guard that is updated period by period; it keeps the sent forces."""

    def __init__(self, limits: ForceLimits = LIMITS) -> None:
        self.guard = ForceGuard(limits)
        self.now = 0.0
        self.sent: list[np.ndarray] = []

    def step(self, force: np.ndarray, sound: bool = True, period: float = PERIOD) -> np.ndarray:
        self.now += period
        wrench = np.array([*force, *(0.01 * np.asarray(force))])
        self.guard.update(self.now, sound, wrench[:3], wrench[3:])
        self.sent.append(wrench)
        return wrench

    def engage(self, force: np.ndarray) -> None:
        for _ in range(round((SETTLING + ENGAGEMENT) / PERIOD) + 10):
            self.step(force)
        assert self.guard.engaged


def test_ordinary_forces_go_through_to_the_bit() -> None:
    drive = Drive(DEVICES["sigma"])
    drive.engage(np.zeros(3))
    for k in range(1000):  # 15 N, 5 times a second, as in palpation by hand
        force = 7.5 * (1.0 - math.cos(2 * math.pi * 5 * k * PERIOD)) * np.array([0.6, 0.0, 0.8])
        np.testing.assert_array_equal(drive.step(force)[:3], force)
        assert not drive.guard.limited and drive.guard.sent_fraction == 1.0


def test_a_torque_that_leaps_follows_at_the_slew_rate() -> None:
    """At most the torque that a force at the largest tip's radius could change by."""
    guard, force, torque = ForceGuard(LIMITS), np.zeros(3), np.zeros(3)
    for k in range(300):
        force[:], torque[:] = (1.0, 0.0, 0.0), (0.0, 0.2, 0.0)
        guard.update(k * PERIOD, True, force, torque)
    assert torque[1] == 0.2
    sent = []
    for k in range(300, 330):
        force[:], torque[:] = (1.0, 0.0, 0.0), (0.0, -0.2, 0.0)
        guard.update(k * PERIOD, True, force, torque)
        sent.append(torque[1])
        assert force[0] == 1.0
    steps = -np.diff([0.2, *sent])
    assert steps.max() <= LIMITS.slew * PERIOD * LEVER * (1.0 + 1e-9) and sent[-1] == -0.2


def test_the_sent_part_counts_what_other_limits_took() -> None:
    guard, force, torque = ForceGuard(LIMITS), np.zeros(3), np.zeros(3)
    for k in range(300):
        force[:] = 1.0, 0.0, 0.0
        guard.update(k * PERIOD, True, force, torque, 0.25)
    assert guard.sent_fraction == 0.25
    torque[:] = np.nan
    guard.update(300 * PERIOD, True, force, torque)
    assert np.isfinite(torque).all()


def test_a_force_that_is_too_large_keeps_its_direction() -> None:
    drive = Drive()
    force = np.array([0.0, -30.0, 40.0])
    drive.engage(force)
    np.testing.assert_allclose(drive.sent[-1][:3], force / 10.0)
    np.testing.assert_allclose(drive.sent[-1][3:], force / 1000.0)
    assert drive.guard.limited
    assert drive.guard.sent_fraction == pytest.approx(0.1)


def test_engagement_is_soft() -> None:
    drive = Drive()
    drive.engage(np.array([0.0, 0.0, 4.0]))
    sent = np.array(drive.sent)[:, 2]
    settled = round(SETTLING / PERIOD)
    assert not sent[:settled].any()
    grows = np.diff(sent[settled : settled + round(ENGAGEMENT / PERIOD)])
    np.testing.assert_allclose(grows, 4.0 * PERIOD / ENGAGEMENT, rtol=1e-6)
    assert sent[-1] == 4.0


def test_a_fault_ramps_down_whatever_the_slew_is_and_latches() -> None:
    drive = Drive(ForceLimits(5.0, 10.0))  # the slew limit alone would take half a second
    drive.engage(np.array([0.0, 0.0, 0.5]))
    for _ in range(1000):
        drive.step(np.array([0.0, 0.0, 4.0]))
    before = drive.sent[-1].copy()
    n = len(drive.sent)
    drive.step(np.array([9.0, 9.0, 9.0]), sound=False)  # one faulty period, then sound ones
    for _ in range(round(SETTLING / PERIOD)):
        drive.step(np.array([9.0, 9.0, 9.0]))
    fallen = np.array(drive.sent)[n:]
    zero = round(10e-3 / PERIOD)
    assert not fallen[zero:].any()
    assert (np.diff(fallen[:zero, 2]) <= 0.0).all()
    np.testing.assert_allclose(
        fallen[:9], np.outer(1.0 - np.arange(9) * PERIOD / RAMP, before), atol=1e-9
    )
    drive.step(np.array([0.0, 0.0, 4.0]))
    for _ in range(3):
        assert drive.step(np.array([0.0, 0.0, 4.0]))[2] > 0.0


PERIODS = st.floats(0.2e-3, 2e-3)
FORCES = st.one_of(st.floats(-100.0, 100.0), st.sampled_from([math.nan, math.inf, 0.0]))
STRETCH = st.tuples(st.booleans(), st.integers(1, 120), FORCES, FORCES, PERIODS)


@examples(200)
@given(st.lists(STRETCH, min_size=1, max_size=12))
def test_nothing_that_comes_breaks_a_limit(
    stretches: list[tuple[bool, int, float, float, float]],
) -> None:
    """Size always; slew except in a ramp; none from 10 ms after a fault to 50 ms of sound poses."""
    drive = Drive()
    last, fault, sound_since = np.zeros(6), -math.inf, math.inf
    for sound, n, x, z, period in stretches:
        for _ in range(n):
            sent = drive.step(np.array([x, 0.0, z]), sound, period)
            if not sound or not math.isfinite(math.hypot(x, z)):
                if drive.now - sound_since >= SETTLING:
                    fault = drive.now
                sound_since = math.inf
            elif math.isinf(sound_since):
                sound_since = drive.now
            size, change = np.linalg.norm(sent[:3]), np.linalg.norm((sent - last)[:3])
            assert size <= LIMITS.force * (1 + 1e-12)
            if drive.now - sound_since < SETTLING or math.isinf(sound_since):
                assert change <= LIMITS.force * period / RAMP + 1e-12
                assert drive.now - fault < RAMP or not sent.any()
            else:
                assert change <= LIMITS.slew * period * (1 + 1e-9) + 1e-12
            last = sent


@pytest.mark.parametrize("values", [(0.0, 1.0), (1.0, -1.0), (math.nan, 1.0)])
def test_limits_without_meaning_are_refused(values: tuple[float, float]) -> None:
    with pytest.raises(ContactError, match="must be positive"):
        ForceLimits(*values)
