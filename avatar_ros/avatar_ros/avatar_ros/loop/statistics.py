"""Times of the contact loop: recorded by the loop, summarised once a second by the node."""

from __future__ import annotations

import math

import numpy as np

from avatar_interfaces.msg import LoopStatistics

LATE = 1.5  # a period longer than this many nominal ones counts as missed


class TimingRecord:
    """Times of the steps since its begin [ns]. Every ``note`` method is real-time safe."""

    CAPACITY = 4096

    def __init__(self, begin: int) -> None:
        self.begin = begin
        self.n_periods = 0
        self.n_missed = 0
        self.nominal = 0  # sum of the nominal periods [ns]
        self.n_steps = 0
        self.n_ages = 0
        self.n_models = 0
        self.periods = np.zeros(self.CAPACITY, np.int64)
        self.computes = np.zeros(self.CAPACITY, np.int64)
        self.ages = np.zeros(self.CAPACITY, np.int64)
        self.models = np.zeros(self.CAPACITY, np.int64)

    def note_period(self, period: int, nominal: int) -> None:
        """Note the time since the last step, and its nominal value [ns]."""
        if self.n_periods < self.CAPACITY:
            self.periods[self.n_periods] = period
            self.n_periods += 1
            self.n_missed += period > LATE * nominal
            self.nominal += nominal

    @property
    def nominal_rate(self) -> float:
        """Return the nominal number of periods per second [Hz]; NaN without periods."""
        return 1e9 * self.n_periods / self.nominal if self.nominal else float("nan")

    def note_step(self, compute: int) -> None:
        """Note the time from the step's start until its wrenches were sent [ns]."""
        if self.n_steps < self.CAPACITY:
            self.computes[self.n_steps] = compute
            self.n_steps += 1

    def note_model(self, duration: int) -> None:
        """Note the time of the computation alone: forces and cloud, without messages [ns]."""
        if self.n_models < self.CAPACITY:
            self.models[self.n_models] = duration
            self.n_models += 1

    def note_age(self, age: int) -> None:
        """Note the age of a pose when it was taken [ns]."""
        if self.n_ages < self.CAPACITY:
            self.ages[self.n_ages] = age
            self.n_ages += 1


def statistics(record: TimingRecord, end: int) -> LoopStatistics:
    """Summarise a record that ended at ``end`` [ns]."""
    window = (end - record.begin) * 1e-9
    computes = record.computes[: record.n_steps]
    period_p50, period_p99, period_max = _percentiles(record.periods[: record.n_periods])
    compute_p50, compute_p99, compute_max = _percentiles(computes)
    age_p50, age_p99, _ = _percentiles(record.ages[: record.n_ages])
    model_p50, model_p99, _ = _percentiles(record.models[: record.n_models])
    return LoopStatistics(
        window=window,
        rate=record.n_periods / window,
        periods=record.n_periods,
        missed=record.n_missed,
        period_p50=period_p50,
        period_p99=period_p99,
        period_max=period_max,
        compute_mean=1e-9 * float(computes.mean()) if len(computes) else np.nan,
        compute_p50=compute_p50,
        compute_p99=compute_p99,
        compute_max=compute_max,
        pose_age_p50=age_p50,
        pose_age_p99=age_p99,
        step_p50=model_p50,
        step_p99=model_p99,
    )


def _percentiles(times: np.ndarray) -> tuple[float, float, float]:
    """Return median, 99th percentile and maximum of times [ns] in [s]; NaN without times.

    By nearest rank, in a tenth of the time of ``numpy.percentile``: the loop waits meanwhile.
    """
    n = len(times)
    if n == 0:
        return (math.nan, math.nan, math.nan)
    ordered = np.sort(times)
    p50, p99 = (1e-9 * int(ordered[math.ceil(part * n) - 1]) for part in (0.5, 0.99))
    return p50, p99, 1e-9 * int(ordered[-1])
