"""Builds a patient's vademecum while the node continues to answer requests.

A worker process (:mod:`avatar_ros.patients.worker`) keeps the atlas and builds, because that holds
Python's global lock for seconds. Cancelling ends that process at any point, and starts another. The
process cannot be ended only while it writes a file, so a file is complete or does not exist.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace

from avatar_core.common.child import Child, EndedError
from avatar_ros.patients.protocol import (
    BuildError,
    BuildRefused,
    BuildSettings,
    Built,
    BusyError,
    CancelledError,
    PatientRequest,
    Previewed,
    Ready,
    Stage,
)

_LATENCY = 0.05  # longest delay until a cancellation is noticed [s]
_NOTHING = "; no file was written"
_REPEAT = 0.5  # time after which a stage is reported again, for late clients [s]
_STOP_TIMEOUT = 5.0  # time for writing a file, which is not interrupted [s]


class PatientBuilder:
    """Keeps the worker running and gives it one request at a time.

    Raises
    ------
    BuildError
        If the atlas cannot be used, with the reason.
    """

    def __init__(self, settings: BuildSettings, threads: int) -> None:
        self._worker = Child(
            "avatar_ros.patients.worker", json.dumps(asdict(settings)), n_threads=threads
        )
        self._stop, self._cancel = threading.Event(), threading.Event()
        self._slot = threading.Lock()
        self._subject = ""
        self.n_anatomies = self._wait_until_ready()

    def build(
        self,
        request: PatientRequest,
        on_stage: Callable[[Stage], None],
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Built | Previewed:
        """Build and write one patient, or preview it; return when that is done.

        Parameters
        ----------
        request : PatientRequest
            Patient to build.
        on_stage : callable
            Called in the caller's thread at each step of progress, at least twice a second.
        cancelled : callable
            Returns whether to stop; called many times a second.

        Raises
        ------
        BusyError
            If another patient is being built.
        CancelledError
            If it was cancelled; nothing was written.
        BuildError
            If the request was refused, or the worker ended.
        """
        if not self._slot.acquire(blocking=False):
            raise self._busy()
        begin = time.monotonic()
        try:
            self._subject = os.path.basename(request.output)
            built = self._built(request, on_stage, cancelled)
            return replace(built, seconds=time.monotonic() - begin)
        finally:
            self._subject = ""
            self._slot.release()

    def require_idle(self) -> None:
        """Raise BusyError while a patient is being built."""
        if self._slot.locked():
            raise self._busy()

    def cancel(self) -> None:
        """Cancel the running build, if any; return when it is over."""
        self._cancel.set()
        if self._slot.acquire(timeout=2 * _STOP_TIMEOUT):
            self._slot.release()
        self._cancel.clear()

    def stop(self) -> None:
        """End the worker; a running build is cancelled."""
        self._stop.set()
        self.cancel()
        self._worker.finish(_STOP_TIMEOUT)

    def _busy(self) -> BusyError:
        return BusyError(
            f"busy with {self._subject or 'another patient'}; ask again when that is done, or "
            "cancel it"
        )

    def _built(
        self,
        request: PatientRequest,
        on_stage: Callable[[Stage], None],
        cancelled: Callable[[], bool],
    ) -> Built | Previewed:
        ending = False
        stage, reported = Stage("loading", 0.0, float("nan")), time.monotonic()
        try:
            self._worker.start()  # starts only if it does not run
            self._worker.send(request)
            while True:
                if not ending and (self._cancel.is_set() or cancelled()):
                    self._worker.send_signal(signal.SIGTERM)
                    ending = True  # a file that is being written is completed
                if not self._worker.has_sent(_LATENCY):
                    if time.monotonic() - reported > _REPEAT:
                        on_stage(stage)
                        reported = time.monotonic()
                    continue
                note = self._worker.receive()
                if isinstance(note, Stage):
                    stage, reported = note, time.monotonic()
                    on_stage(stage)
                elif isinstance(note, Built | Previewed):
                    return note
                elif isinstance(note, BuildRefused):
                    raise BuildError(f"{note.reason}{_of_first(stage)}")
        except EndedError as error:
            if ending:
                raise CancelledError(f"cancelled{_of_first(stage) or _NOTHING}") from error
            raise BuildError(
                f"the building process ended ({error}), perhaps because memory ran out"
                f"{_of_first(stage) or _NOTHING}: ask again, or for fewer vertices"
            ) from error
        finally:
            if ending or not self._worker.is_running:
                self._restart()

    def _wait_until_ready(self) -> int:
        try:
            self._worker.start()
            note = self._worker.receive()
        except EndedError as error:
            raise BuildError(f"the building process did not start ({error})") from error
        if isinstance(note, Ready):
            return note.n_anatomies
        self._worker.finish(_STOP_TIMEOUT)
        raise BuildError(note.reason)

    def _restart(self) -> None:
        """End the worker, and start another, which loads the atlas for the next request."""
        self._worker.finish(_STOP_TIMEOUT)
        if not self._stop.is_set():
            with contextlib.suppress(EndedError):  # the next request reports it
                self._worker.start()


def _of_first(stage: Stage) -> str:
    """Name the interpolated vademecum that was written first, if there is one."""
    return f"; {stage.file} holds the interpolated one" if stage.file else ""
