"""Times that the contact node reports are percentiles by nearest rank."""

from __future__ import annotations

import math

import numpy as np
import pytest

from avatar_ros.loop.statistics import TimingRecord, statistics

PERIOD = 1_000_000  # [ns]


@pytest.mark.parametrize("n", [1, 2, 3, 99, 100, 101, 1000])
def test_percentiles_are_those_of_numpy(n: int) -> None:
    times = np.random.default_rng(n).integers(200_000, 5_000_000, n)
    record = TimingRecord(0)
    for time in times:
        record.note_period(int(time), PERIOD)
        record.note_step(int(time) // 2)
    window = statistics(record, n * PERIOD)
    p50, p99 = 1e-9 * np.percentile(times, (50, 99), method="inverted_cdf")
    assert window.period_p50 == pytest.approx(p50)
    assert window.period_p99 == pytest.approx(p99)
    assert window.period_max == pytest.approx(1e-9 * times.max())
    assert window.compute_mean == pytest.approx(1e-9 * (times // 2).mean())
    assert window.missed == np.count_nonzero(times > 1.5 * PERIOD)
    assert window.rate == pytest.approx(1000.0)


def test_nothing_measured_is_not_a_number() -> None:
    window = statistics(TimingRecord(0), PERIOD)
    assert window.periods == window.missed == 0
    assert math.isnan(window.period_p99) and math.isnan(window.compute_mean)
    assert math.isnan(window.pose_age_p50) and math.isnan(window.step_p50)
