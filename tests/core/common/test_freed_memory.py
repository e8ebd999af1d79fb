"""Freed arrays do not stay with a long-lived process."""

from __future__ import annotations

import subprocess
import sys

import pytest

_SCRIPT = """
import sys
import numpy as np
from avatar_core.common.processes import free_at_once

def resident():
    with open("/proc/self/statm") as source:
        return int(source.read().split()[1]) * 4096 / 1e6

if sys.argv[1] == "at once":
    free_at_once()
before = resident()
for _ in range(3):  # a small one that stays lies above each large one that goes
    large, small = np.ones(3_000_000), np.ones(20_000)
    kept = [small, np.ones(20_000)]
    del large
    kept.append(np.ones(10_000))
print(resident() - before)
"""


def kept(how: str) -> float:
    """Return how much of freed arrays of 24 MB a process keeps [MB]."""
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, how], capture_output=True, text=True, check=True
    )
    return float(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_large_arrays_go_back_to_the_system() -> None:
    assert kept("at once") < 5.0
    assert kept("by default") > 15.0  # otherwise there is nothing to do
