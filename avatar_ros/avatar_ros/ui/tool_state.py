"""The process that drives the tool of the planning page, and the memory it shares with the node.

Each field is written by one side and read by the other: the node writes the target and whether to
record, the driver writes the tool's state, the recorded periods and the recent ones. The driver
increases the number of rows after it has written a row; the stamp of a recent row is written last.
"""

from __future__ import annotations

import mmap
import os
import signal
from functools import partial

import numpy as np

from avatar_core.common.processes import ModuleProcess
from avatar_ros.framework import realtime

SECONDS = 600  # of a recording, at most
N_ROWS = SECONDS * 1000
N_RECENT = 512  # periods that are kept to be shown with the cloud of the same period

LIVE = np.dtype(
    [
        ("target", np.float64, 3),  # from the node: centre of the tip [m]
        ("recording", np.int64),
        ("tip", np.float64, 3),  # from the driver: as sent last [m]
        ("force", np.float64, 3),  # of the organ [N]
        ("error", np.float64),  # [N]
        ("sent_fraction", np.float64),  # of the force, that the device gets
        ("status", np.int64),  # of avatar_ros/msg/ContactState
        ("touches", np.int64),
        ("heard", np.int64),  # when the last state came, monotonic clock [ns]
        ("n_poses", np.int64),  # sent
        ("n_states", np.int64),  # received
        ("n_rows", np.int64),
        ("n_recent", np.int64),
    ],
    align=True,
)
ROW = np.dtype(
    [
        ("number", np.int64),
        ("stamp", np.int64),  # [ns]
        ("tip", np.float64, 3),
        ("force", np.float64, 3),
        ("error", np.float64),
        ("sent_fraction", np.float64),
        ("status", np.int64),
        ("touches", np.int64),
        ("organ", np.uint64),  # that the contact node used, by :func:`organ_number`
    ],
    align=True,
)


def organ_number(identity: str) -> int:
    """The first 64 bits of a vademecum's id, 0 of none."""
    return int(identity[:16] or "0", 16)


class SharedToolState:
    """The shared memory as arrays: ``live``, of one entry, ``recent`` and recorded ``rows``."""

    def __init__(self, handle: int) -> None:
        self.handle = handle
        size = LIVE.itemsize + (N_RECENT + N_ROWS) * ROW.itemsize
        if os.fstat(handle).st_size < size:
            os.ftruncate(handle, size)
        memory = mmap.mmap(handle, size)
        self.live = np.frombuffer(memory, LIVE, 1)[0:1]
        self.recent = np.frombuffer(memory, ROW, N_RECENT, LIVE.itemsize)
        self.rows = np.frombuffer(memory, ROW, N_ROWS, LIVE.itemsize + self.recent.nbytes)

    @staticmethod
    def make() -> SharedToolState:
        """New memory, all zero."""
        return SharedToolState(os.memfd_create("avatar-tool", os.MFD_CLOEXEC))

    def period(self, stamp: int | None = None) -> np.ndarray | None:
        """A copy of the recent row of a stamp [ns], or else of the newest; None before the first.

        A cloud and the state of its period carry the same stamp.
        """
        n = int(self.live["n_recent"][0])
        if n == 0:
            return None
        found = np.flatnonzero(self.recent["stamp"] == stamp)
        return self.recent[found[0] if len(found) else (n - 1) % N_RECENT].copy()

    def force_of(self, stamp: int) -> float:
        """Size of the organ's force in the recent period of a stamp [ns]; NaN if it is not kept."""
        found = self.recent[self.recent["stamp"] == stamp]
        return float(np.linalg.norm(found["force"][0])) if len(found) else float("nan")

    def recorded(self, begin: int = 0) -> np.ndarray:
        """A copy of the recorded rows from ``begin`` on."""
        return self.rows[begin : int(self.live["n_rows"][0])].copy()


class ToolDriverProcess:
    """Runs :mod:`avatar_ros.ui.tool_driver` beside the page."""

    def __init__(self, state: SharedToolState) -> None:
        self._state = state
        self._process: ModuleProcess | None = None

    def ensure_running(self, tool: str, frame_id: str) -> None:
        """Start the driver unless it runs; it continues from the target in the shared memory."""
        if self._process is not None and self._process.poll() is None:
            return
        self._process = ModuleProcess(
            "avatar_ros.ui.tool_driver",
            tool,
            frame_id,
            stdin=self._state.handle,
            preexec_fn=partial(realtime.die_with_parent, signal.SIGINT),
        )

    def end(self) -> None:
        """End the driver; returns when it has ended."""
        if self._process is not None:
            self._process.send_signal(signal.SIGINT)
            self._process.wait()
            self._process = None
