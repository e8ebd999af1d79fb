"""Processor time and wake-ups of every thread of a process, as the kernel counts them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ThreadTime:
    """Load of one thread so far.

    Attributes
    ----------
    seconds : float
        Processor time [s].
    wake_ups : int
        Number of times it went to sleep voluntarily and woke up.
    """

    name: str
    seconds: float
    wake_ups: int


def thread_times(pid: int) -> dict[int, ThreadTime]:
    """Read the times of all threads of a process, by number; ``pid`` is the main thread."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(OSError):  # the thread has ended
            name = (task / "comm").read_text().strip()
            nanoseconds = int((task / "schedstat").read_text().split()[0])
            status = (task / "status").read_text()
            slept = int(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])
            found[int(task.name)] = ThreadTime(name, 1e-9 * nanoseconds, slept)
    return found


def between(begin: dict[int, ThreadTime], end: dict[int, ThreadTime]) -> dict[int, ThreadTime]:
    """Return the load of each thread between two moments, the largest first."""
    nothing = ThreadTime("", 0.0, 0)
    taken = {}
    for number, now in end.items():
        before = begin.get(number, nothing)
        taken[number] = ThreadTime(
            now.name, now.seconds - before.seconds, now.wake_ups - before.wake_ups
        )
    return dict(sorted(taken.items(), key=lambda item: -item[1].seconds))
