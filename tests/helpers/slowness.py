"""Time limits that also hold on a busy machine."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_WORK = 0.2  # processor time of one measurement [s]
_AGAIN = 5.0  # seconds between two measurements, so that waiting costs little


def slowness() -> float:
    """Return how many times longer work takes than on an idle machine.

    It measures a fixed amount of work now, and reads the load of the last minute.
    """
    begin, used = time.monotonic(), time.thread_time()
    while time.thread_time() - used < _WORK:
        pass
    here = (time.monotonic() - begin) / _WORK
    return max(1.0, here, os.getloadavg()[0] / len(os.sched_getaffinity(0)))


class Deadline:
    """Time limit of ``seconds`` from now on an idle machine."""

    def __init__(self, seconds: float) -> None:
        self._seconds, self._begin = seconds, time.monotonic()
        self._end = self._begin + seconds

    def __bool__(self) -> bool:
        """Return whether the limit has passed."""
        if time.monotonic() < self._end:
            return False
        took = time.monotonic() - self._begin
        if took > self._seconds * slowness():
            return True
        self._end = time.monotonic() + _AGAIN
        return False


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Fail if the body takes longer than ``seconds`` of an idle machine."""
    passed = Deadline(seconds)
    yield
    assert not passed, f"took longer than {seconds:g} s"


def wait_until(reached: Callable[[], bool], seconds: float, missed: str = "not reached") -> None:
    """Wait for a condition that takes at most ``seconds`` on an idle machine."""
    passed = Deadline(seconds)
    while not reached():
        assert not passed, f"{missed} within {seconds:g} s"
        time.sleep(0.01)


def end_of(process: subprocess.Popen[Any], seconds: float) -> int:
    """Return the exit code of a process; kill it after ``seconds`` of an idle machine."""
    try:
        wait_until(lambda: process.poll() is not None, seconds, "did not end")
    finally:
        process.kill()
    return int(process.returncode)
