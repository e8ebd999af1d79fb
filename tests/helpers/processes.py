"""State of other processes, as the kernel reports it."""

from __future__ import annotations

from pathlib import Path


def state_of(pid: int) -> str:
    """Return the letter of a process's state as in ps, e.g. T for stopped; Z if there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def has_ended(pid: int) -> bool:
    """Return whether a process has ended, even if its parent has not yet waited for it."""
    return state_of(pid) in "ZX"
