"""The process that drives the planning page's tools, and the memory it shares with the node.

Each field is written by one side and read by the other. The node writes the targets and whether to
record. The driver writes where the tools are, the recorded periods and the recent ones. A period
has a row for each tool, all of one step of the contact loop. The driver increases the number of
rows after it has written those of all tools; the stamps of recent ones are written last.
"""

from __future__ import annotations

import mmap
import os
import signal
from collections.abc import Sequence
from functools import partial

import numpy as np

from avatar_core.common.child import Child
from avatar_core.geometry.tip import MAX_TOOLS
from avatar_ros.framework import realtime

SECONDS = 600  # longest recording
N_ROWS = SECONDS * 1000
_STOP_TIMEOUT = 5.0  # time for the driver to end [s]
N_RECENT = 512  # periods that are kept to be shown with the cloud of the same period

ALL = np.dtype(
    [
        ("recording", np.int64),  # from the node
        # from the driver: arrival of the last period on the monotonic clock [ns]
        ("heard", np.int64),
        ("n_poses", np.int64),  # sent, of each tool
        ("n_rows", np.int64),
        ("n_recent", np.int64),  # periods received
    ],
    align=True,
)
EACH = np.dtype(
    [
        ("target", np.float64, 3),  # from the node: centre of the tip [m]
        ("shut", np.int64),  # whether its jaw is closed, also from the node
        ("tip", np.float64, 3),  # from the driver: position sent last [m]
    ],
    align=True,
)
ROW = np.dtype(
    [
        ("number", np.int64),
        ("stamp", np.int64),  # stamp of the tool's pose [ns]
        ("tip", np.float64, 3),
        ("force", np.float64, 3),
        ("error", np.float64),
        ("sent_fraction", np.float64),
        ("status", np.int64),  # status of avatar_interfaces/msg/ContactState
        ("touches", np.int64),
        ("held", np.int64),  # whether its jaw holds tissue
        # number of the vademecum that the contact node used, by :func:`organ_number`
        ("organ", np.uint64),
    ],
    align=True,
)


def organ_number(identity: str) -> int:
    """Return the first 64 bits of a vademecum's id, 0 without one."""
    return int(identity[:16] or "0", 16)


class SharedToolState:
    """The shared memory as arrays.

    There is room for as many tools as an organ allows; parts that are never written take no memory.

    n_tools : number of the cell's tools, whose rows are read and written
    all : fields that all tools share, one entry
    """

    def __init__(self, handle: int, n_tools: int = 1) -> None:
        self.handle, self.n_tools = handle, n_tools
        parts = (
            (ALL, 1),
            (EACH, MAX_TOOLS),
            (ROW, MAX_TOOLS * N_RECENT),
            (ROW, MAX_TOOLS * N_ROWS),
        )
        size = sum(kind.itemsize * n for kind, n in parts)
        if os.fstat(handle).st_size < size:
            os.ftruncate(handle, size)
        memory, begin, found = mmap.mmap(handle, size), 0, []
        for kind, n in parts:
            found.append(np.frombuffer(memory, kind, n, begin))
            begin += kind.itemsize * n
        self.all, self._each = found[0], found[1]
        self._recent, self._rows = found[2].reshape(MAX_TOOLS, -1), found[3].reshape(MAX_TOOLS, -1)

    @staticmethod
    def make() -> SharedToolState:
        """Make new memory, all zero."""
        return SharedToolState(os.memfd_create("avatar-tools", os.MFD_CLOEXEC))

    @property
    def each(self) -> np.ndarray:
        """Return position and target of each tool, shape (n_tools,)."""
        return self._each[: self.n_tools]

    @property
    def recent(self) -> np.ndarray:
        """Return the recent periods in turn, shape (n_tools, N_RECENT)."""
        return self._recent[: self.n_tools]

    @property
    def rows(self) -> np.ndarray:
        """Return the recorded periods, shape (n_tools, N_ROWS)."""
        return self._rows[: self.n_tools]

    def use(self, targets: np.ndarray) -> None:
        """Begin with other tools, (n_tools, 3) [m], without periods; while no driver runs."""
        self.n_tools = len(targets)
        self.each["target"] = targets
        self.each["shut"] = 0
        self.all["n_poses"] = self.all["n_recent"] = 0
        self._recent["stamp"] = 0

    @property
    def sent(self) -> np.ndarray:
        """Return a copy of the positions sent last, or of the first targets, (n_tools, 3) [m]."""
        is_driven = int(self.all["n_poses"][0]) > 0
        return np.array(self.each["tip" if is_driven else "target"])

    def period(self, stamp: int | None = None) -> np.ndarray | None:
        """Return a copy of recent rows, shape (n_tools,); None before the first.

        The rows are those of a stamp of the first tool [ns], which a cloud carries, or else the
        newest.
        """
        n = int(self.all["n_recent"][0])
        if n == 0:
            return None
        found = np.flatnonzero(self.recent[0]["stamp"] == stamp)
        return self.recent[:, found[0] if len(found) else (n - 1) % N_RECENT].copy()

    def force_of(self, tool: int, stamp: int) -> float:
        """Return the size of a tool's force in the recent period of a stamp [ns]; else NaN."""
        recent = self.recent[tool]
        found = recent[recent["stamp"] == stamp]
        return float(np.linalg.norm(found["force"][0])) if len(found) else float("nan")

    def recorded(self, begin: int = 0) -> np.ndarray:
        """Return a copy of the recorded rows from ``begin`` on, shape (n_tools, n)."""
        return self.rows[:, begin : int(self.all["n_rows"][0])].copy()


class ToolDriverProcess:
    """Runs :mod:`avatar_ros.ui.tools.tool_driver` beside the page."""

    def __init__(self, state: SharedToolState) -> None:
        self._state = state
        self._child = Child(
            "avatar_ros.ui.tools.tool_driver",
            preexec_fn=partial(realtime.die_with_parent, signal.SIGINT),
        )

    def ensure_running(self, tools: Sequence[str], all_tools: Sequence[str], frame_id: str) -> None:
        """Start the driver unless it runs; it continues from the targets in the shared memory.

        tools : names of the tools to move, some or all of the contact node's
        """
        self._child.start(frame_id, ",".join(all_tools), *tools, stdin=self._state.handle)

    def end(self) -> None:
        """End the driver; return when it has ended."""
        self._child.finish(_STOP_TIMEOUT, signal.SIGINT)
