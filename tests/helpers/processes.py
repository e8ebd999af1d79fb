"""Other processes, as the kernel tells of them."""

from __future__ import annotations

from pathlib import Path


def state_of(pid: int) -> str:
    """Letter of a process's state, as ps shows it: T for stopped; Z, too, where there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def has_ended(pid: int) -> bool:
    """Whether a process has ended, though its parent may not have asked how."""
    return state_of(pid) in "ZX"
