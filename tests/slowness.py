"""Bounds of time that hold on a busy machine, too."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

_WORK = 0.1  # processor time of one measurement [s]


def slowness() -> float:
    """How many times longer a fixed amount of work takes here and now than its processor time."""
    begin, used = time.monotonic(), time.thread_time()
    while time.thread_time() - used < _WORK:
        pass
    return max(1.0, (time.monotonic() - begin) / _WORK)


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Fails if its body takes longer than ``seconds`` of a machine that nothing else uses."""
    before, begin = slowness(), time.monotonic()
    yield
    took = time.monotonic() - begin
    if took > seconds:
        slow = max(before, slowness())
        assert took <= slow * seconds, f"took {took:.1f} s, more than {seconds:g} s x {slow:.1f}"
