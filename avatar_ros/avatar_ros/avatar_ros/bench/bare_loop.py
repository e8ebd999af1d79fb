"""A loop that only sleeps, or sleeps and works: the best timing that this machine allows.

Run as ``python -m avatar_ros.bench.bare_loop SECONDS PRIORITY [WORK]``; prints its periods as JSON.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np

from avatar_ros.framework import realtime

_BLOCK = 48  # rows of the matrices that are multiplied as work
_CALIBRATIONS = 300


def main() -> int:
    """Run the loop with the arguments of the command line; return the exit code."""
    seconds, priority = float(sys.argv[1]), int(sys.argv[2])
    work = float(sys.argv[3]) if len(sys.argv) > 3 else 0.0
    granted = realtime.claim(priority)
    realtime.bind_thread(-1)
    realtime.tune_interpreter()
    found = periods(seconds, work)
    print(json.dumps({"priority": granted.priority, "periods": found.tolist()}))
    return 0


def periods(seconds: float, work: float = 0.0, period: float = 1e-3) -> np.ndarray:
    """Return the periods of a loop that sleeps until it is due and then works, shape (n,) [s].

    work : computing time per period on an undisturbed core [s]
    """
    step = round(period * 1e9)
    starts = np.zeros(max(2, round(seconds / period)), dtype=np.int64)
    block = np.eye(_BLOCK)
    product = np.zeros_like(block)
    n = _blocks(work, block, product)
    due = time.monotonic_ns()
    for i in range(len(starts)):
        due = max(due + step, time.monotonic_ns())  # lost time is not caught up
        realtime.sleep_until(due)
        starts[i] = time.monotonic_ns()
        for _ in range(n):
            np.dot(block, block, out=product)
    return np.diff(starts) * 1e-9


def _blocks(work: float, block: np.ndarray, product: np.ndarray) -> int:
    """Return how many products take as long as ``work`` [s], by their median."""
    if work <= 0.0:
        return 0
    times = np.zeros(_CALIBRATIONS)
    for i in range(len(times)):
        begin = time.perf_counter()
        np.dot(block, block, out=product)
        times[i] = time.perf_counter() - begin
    return max(1, round(work / float(np.median(times))))


if __name__ == "__main__":
    raise SystemExit(main())
