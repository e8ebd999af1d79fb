"""Processor time and wake-ups of every thread of a process, as the kernel counts them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ThreadTime:
    """What one thread has taken so far.

    seconds : of a processor [s]
    wake_ups : how often it went to sleep of itself, and woke up
    """

    name: str
    seconds: float
    wake_ups: int


def thread_times(pid: int) -> dict[int, ThreadTime]:
    """Of all threads of a process, by number; that of the main thread is ``pid``."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(OSError):  # it ended meanwhile
            name = (task / "comm").read_text().strip()
            nanoseconds = int((task / "schedstat").read_text().split()[0])
            status = (task / "status").read_text()
            slept = int(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])
            found[int(task.name)] = ThreadTime(name, 1e-9 * nanoseconds, slept)
    return found


def between(begin: dict[int, ThreadTime], end: dict[int, ThreadTime]) -> dict[int, ThreadTime]:
    """What each thread took from one moment to another, the most first."""
    nothing = ThreadTime("", 0.0, 0)
    taken = {}
    for number, now in end.items():
        before = begin.get(number, nothing)
        taken[number] = ThreadTime(
            now.name, now.seconds - before.seconds, now.wake_ups - before.wake_ups
        )
    return dict(sorted(taken.items(), key=lambda item: -item[1].seconds))
