"""Memory, files and threads of processes, and their growth."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

MAX_GROWTH = 5.0  # largest growth of a process in a run without a leak [MB]


@dataclass(frozen=True)
class Footprint:
    """Resources of one process at one moment.

    Attributes
    ----------
    memory_mb : float
        Memory that the system cannot reclaim: no code, no pages of files.
    pss_mb : float
        Proportional share of all its pages in memory, code and files included.
    files : int
        Open descriptors, including sockets.
    """

    memory_mb: float
    pss_mb: float
    files: int
    threads: int

    @staticmethod
    def of(pid: int) -> Footprint:
        """Read the footprint of a process.

        Raises
        ------
        OSError
            If there is no such process or it may not be inspected.
        """
        lines = (line.split(":") for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        status = {name: text.split() for name, text in lines}
        if "RssAnon" not in status:
            raise ProcessLookupError(f"process {pid} has ended")
        held = sum(int(status[name][0]) for name in ("RssAnon", "RssShmem", "VmSwap"))
        shares = Path(f"/proc/{pid}/smaps_rollup").read_text()
        pss = int(shares.partition("\nPss:")[2].split()[0])
        files, threads = len(os.listdir(f"/proc/{pid}/fd")), int(status["Threads"][0])
        return Footprint(1024e-6 * held, 1024e-6 * pss, files, threads)


@dataclass(frozen=True)
class FootprintGrowth:
    """The growth of one process over a run."""

    process: str
    begin: Footprint
    end: Footprint

    @property
    def memory_mb(self) -> float:
        """Growth of the memory that the system cannot reclaim [MB]."""
        return self.end.memory_mb - self.begin.memory_mb

    @property
    def complaint(self) -> str:
        """State what has grown, in words; empty if nothing has."""
        found = []
        if self.memory_mb >= MAX_GROWTH:
            found.append(f"{self.memory_mb:.1f} MB")
        for name in ("files", "threads"):
            more = getattr(self.end, name) - getattr(self.begin, name)
            if more > 0:
                found.append(f"{more} {name}")
        return f"{self.process} took {' and '.join(found)} more" if found else ""

    def row(self) -> str:
        """Return a line of the table under ``HEADER``."""
        a, b = self.begin, self.end
        return (
            f"{self.process:34}{f'{a.memory_mb:.1f}':>10} {f'{self.memory_mb:+.1f}':>6}"
            f"{f'{b.pss_mb:.1f}':>10}"
            f"{f'{a.files} {b.files}':>10}{f'{a.threads} {b.threads}':>10}"
        )


HEADER = f"{'process':34}{'MB':>10} {'growth':>6}{'PSS':>10}{'files':>10}{'threads':>10}"


def footprints(pids: dict[str, int]) -> dict[str, Footprint]:
    """Read the footprints of processes, by name."""
    return {name: Footprint.of(pid) for name, pid in pids.items()}


def growths(begin: dict[str, Footprint], end: dict[str, Footprint]) -> tuple[FootprintGrowth, ...]:
    """Pair footprints from the begin and the end of a run."""
    return tuple(FootprintGrowth(name, begin[name], end[name]) for name in begin)


def children(pid: int) -> Iterable[int]:
    """Yield the running processes that a process has started."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rsplit(")", 1)[1].split()[1])
        except OSError:  # the process has just ended
            continue
        if parent == pid:
            yield int(stat.parent.name)
