"""Building a patient's vademecum beside a node that goes on answering.

A process of its own keeps the atlas and does the work, which holds Python's global lock for
seconds. To cancel is to end that process, which works in every stage; another one then takes its
place. It cannot be ended only while it writes, so a file is there as a whole or not at all.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection

import numpy as np

from avatar_core.common.processes import ModuleProcess
from avatar_core.errors import AvatarError

_LATENCY = 0.05  # longest until a cancellation is noticed [s]
_REPEAT = 0.5  # a stage is told again, for whoever did not listen yet [s]
_STOP_TIMEOUT = 5.0  # for writing a file, which is not interrupted [s]


class BuildError(AvatarError):
    """A patient's vademecum was not built."""


class BusyError(BuildError):
    """Another one is being built."""


class CancelledError(BuildError):
    """It was cancelled before anything was written."""


@dataclass(frozen=True)
class Rules:
    """What is the same for all patients of a node.

    atlas : path; n_vertices : of a patient's mesh; max_modes, weighting : see PatientOptions
    n_certified : unseen loads of the certificate, -1 for the default of the fidelity
    """

    atlas: str
    n_vertices: int
    max_modes: int
    weighting: str
    n_certified: int


@dataclass(frozen=True, eq=False)
class Order:
    """One patient, all paths absolute.

    surface : file, or empty if there are vertices, shape (n, 3) [m], and faces, shape (m, 3)
    unit, axes : of the file
    neighbors : 0 for all; tolerance : 0 for the default
    output : file to write
    """

    surface: str
    vertices: np.ndarray | None
    faces: np.ndarray | None
    unit: str
    axes: str
    leave_out: tuple[str, ...]
    neighbors: int
    fidelity: str
    tolerance: float
    name: str
    output: str


@dataclass(frozen=True)
class Stage:
    """Where the work is: ``fraction`` of ``stage``, ``error`` so far (NaN: unknown)."""

    stage: str
    fraction: float
    error: float


@dataclass(frozen=True)
class Ready:
    """The atlas is loaded, with so many anatomies that have a response."""

    n_anatomies: int


@dataclass(frozen=True)
class Refused:
    """Nothing was written, for this reason."""

    reason: str


@dataclass(frozen=True)
class Built:
    """What was written; fields as in InterpolatePatient.srv."""

    vademecum_id: str
    file: str
    neighbours: list[str]
    weights: list[float]
    weight_abs_sum: float
    hull_distance: float
    volume_error: float
    displacement_error: float
    notices: list[str]
    seconds: float = 0.0


class PatientBuilder:
    """Keeps the building process running and gives it one order at a time.

    Raises
    ------
    BuildError
        If the atlas cannot be used, with the reason.
    """

    def __init__(self, rules: Rules, threads: int) -> None:
        self._rules, self._threads = rules, threads
        self._stop, self._cancel = threading.Event(), threading.Event()
        self._slot = threading.Lock()
        self._subject = ""
        self._start()
        self.n_anatomies = self._wait_until_ready()

    def build(
        self,
        order: Order,
        on_stage: Callable[[Stage], None],
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Built:
        """Build and write one patient; returns when that is done.

        on_stage : called in the caller's thread with each step of progress, and twice a second
        cancelled : asked many times a second

        Raises
        ------
        BusyError : another thread's order is at work
        CancelledError : nothing was written
        BuildError : the order was refused, or the process ended
        """
        if not self._slot.acquire(blocking=False):
            raise self._busy()
        begin = time.monotonic()
        try:
            self._subject = os.path.basename(order.output)
            built = self._built(order, on_stage, cancelled)
            return replace(built, seconds=time.monotonic() - begin)
        finally:
            self._subject = ""
            self._slot.release()

    def require_idle(self) -> None:
        """Raise BusyError if an order is at work."""
        if self._slot.locked():
            raise self._busy()

    def cancel(self) -> None:
        """Cancel the order at work, if any; returns when it is over."""
        self._cancel.set()
        if self._slot.acquire(timeout=2 * _STOP_TIMEOUT):
            self._slot.release()
        self._cancel.clear()

    def stop(self) -> None:
        """End the process; an order at work is cancelled."""
        self._stop.set()
        self.cancel()
        self._end()

    def _busy(self) -> BusyError:
        return BusyError(
            f"busy with {self._subject or 'another patient'}; ask again when that is done, or "
            "cancel it"
        )

    def _built(
        self, order: Order, on_stage: Callable[[Stage], None], cancelled: Callable[[], bool]
    ) -> Built:
        ending = False
        stage, told = Stage("loading", 0.0, float("nan")), time.monotonic()
        try:
            if self._process.poll() is not None:
                self._restart()
            self._notes.send(order)
            while True:
                if not ending and (self._cancel.is_set() or cancelled()):
                    self._process.terminate()
                    ending = True  # but what it was just writing counts
                if not self._notes.poll(_LATENCY):
                    if time.monotonic() - told > _REPEAT:
                        on_stage(stage)
                        told = time.monotonic()
                    continue
                note = self._notes.recv()
                if isinstance(note, Stage):
                    stage, told = note, time.monotonic()
                    on_stage(stage)
                elif isinstance(note, Built):
                    return note
                elif isinstance(note, Refused):
                    raise BuildError(note.reason)
        except (EOFError, OSError) as error:  # its end of the line is closed
            if ending:
                raise CancelledError("cancelled; no file was written") from error
            raise BuildError(
                f"the building process ended ({self._code()}), perhaps for want of memory; no "
                "file was written: ask again, or for fewer vertices"
            ) from error
        finally:
            if ending or self._process.poll() is not None:
                self._restart()

    def _wait_until_ready(self) -> int:
        try:
            note = self._notes.recv()
        except (EOFError, OSError) as error:
            raise BuildError(f"the building process did not start ({self._code()})") from error
        if isinstance(note, Ready):
            return note.n_anatomies
        self._end()
        raise BuildError(note.reason)

    def _restart(self) -> None:
        self._end()
        if not self._stop.is_set():
            self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = ModuleProcess(
                "avatar_ros.patients.worker",
                json.dumps(asdict(self._rules)),
                n_threads=self._threads,
                stdin=theirs.fileno(),
            )
        self._notes = Connection(ours.detach())

    def _end(self) -> None:
        self._process.finish(_STOP_TIMEOUT)
        with contextlib.suppress(OSError):
            self._notes.close()

    def _code(self) -> str:
        """How the process ended."""
        try:
            code = self._process.wait(_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            return "it does not answer"
        return f"signal {-code}" if code < 0 else f"exit code {code}"
