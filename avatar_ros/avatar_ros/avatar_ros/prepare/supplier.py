"""Supplies the contact node with prepared models, without delaying its loop.

Deserialising 40 MB, verifying them and preparing the contact model would each hold Python's global
lock for tens of milliseconds. Compiling the step takes tens of seconds, once on a machine. A worker
process (:mod:`avatar_ros.prepare.worker`) does all that: it subscribes to `vademecum` and puts the
prepared arrays into sealed shared memory. This process only maps that memory, and reads the
compiled step from numba's cache.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from dataclasses import replace

from avatar_core.common.child import Child
from avatar_core.errors import one_line
from avatar_ros.prepare.protocol import Accepted, ChangeRequest, Channel, ModelReady, Refused
from avatar_ros.prepare.requests import Change, PreparationRequest, PreparedModel

_RESTART_DELAY = 1.0  # [s]
_STOP_TIMEOUT = 1.0  # [s]
_KINDS = ("material", "uncertainty")  # kinds of changes, besides scenes

# called with the model now in use and "", or with None and the reason of a refusal; None and "":
# there is no vademecum yet, and the change applies to the next one
Answer = Callable[[PreparedModel | None, str], None]

SUPERSEDED = "superseded by a later change, which is tried instead"


class ModelSupplier:
    """Keeps the worker running and calls back with prepared models.

    Callbacks run in a thread of this object, one at a time. Changes are sent one by one, each
    after the last one was answered. Only the newest waiting change of each kind (scene, material,
    uncertainty) is kept, so dragging a slider fills neither time nor memory.

    Parameters
    ----------
    on_model : callable
        Called with each verified and prepared model; puts it into use.
    on_refusal : callable
        Called with one line when a vademecum is refused or the worker ends.
    """

    def __init__(
        self,
        request: PreparationRequest,
        on_model: Callable[[PreparedModel], None],
        on_refusal: Callable[[str], None],
    ) -> None:
        self._request = request  # request in force; a restarted worker begins with it
        self._on_model = on_model
        self._on_refusal = on_refusal
        self._stop = threading.Event()
        self._lock = threading.Lock()  # guards the next four
        self._channel: Channel | None = None
        self._waiting: dict[str, tuple[Change, Answer]] = {}  # waiting changes by kind
        self._pending: Answer | None = None  # answer to the change that was sent last
        self._number = 0
        self._worker = Child("avatar_ros.prepare.worker")
        self._thread = threading.Thread(target=self._supervise, name="model supplier", daemon=True)
        self._thread.start()

    @property
    def scene(self) -> str:
        """Return the YAML of the scene in force; empty for the natural effects of the vademecum."""
        return self._request.scene

    def ask(self, change: Change, answer: Answer) -> None:
        """Prepare the vademecum again with a changed request; return at once.

        A waiting change of the same kind is refused as ``SUPERSEDED``, in the caller's thread.
        """
        kind = next((kind for kind in _KINDS if kind in change), "scene")
        with self._lock:
            _, superseded = self._waiting.pop(kind, (None, None))
            self._waiting[kind] = (change, answer)
        if superseded is not None:
            superseded(None, SUPERSEDED)
        self._send_next()

    def stop(self) -> None:
        """End the worker; return when it has ended."""
        self._stop.set()
        self._worker.finish(_STOP_TIMEOUT)
        self._thread.join(_STOP_TIMEOUT)

    def _send_next(self) -> None:
        """Send the change that waits longest, if the worker runs and has answered the last."""
        with self._lock:
            if self._channel is None or self._pending is not None or not self._waiting:
                return
            change, answer = self._waiting.pop(next(iter(self._waiting)))
            self._number += 1
            try:
                self._channel.send(ChangeRequest(self._number, change), wait=False)
            except OSError as error:
                reason = f"not passed on ({error.strerror}); ask with less"
            else:
                self._pending, reason = answer, ""
        if reason:
            answer(None, reason)
            self._send_next()

    def _supervise(self) -> None:
        """Start the worker, and restart it whenever it ends, until :meth:`stop`."""
        while not self._stop.is_set():
            ours, theirs = Channel.pair()
            with ours:
                self._run_worker(Channel(ours), theirs)
                with self._lock:
                    self._channel = None
                    answer, self._pending = self._pending, None
            if answer is not None:  # not sent again: it may have ended the worker
                answer(None, "the process that prepares models ended; ask again")
            if not self._stop.is_set():
                self._on_refusal("the process that receives vademecums ended; starting another")
                self._stop.wait(_RESTART_DELAY)
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for _, answer in waiting.values():
            answer(None, "the node was cleaned up meanwhile; configure and ask again")

    def _run_worker(self, channel: Channel, theirs: socket.socket) -> None:
        """Start a worker and take its packets until it ends."""
        with theirs:
            channel.send(self._request)
            self._worker.start(stdin=theirs.fileno())
            with self._lock:
                self._channel = channel
        self._send_next()
        with contextlib.suppress(ConnectionResetError):  # it ended with packets unread
            self._receive(channel)
        self._worker.finish(_STOP_TIMEOUT)

    def _receive(self, channel: Channel) -> None:
        while received := channel.receive():
            match received:
                case ModelReady() as ready, [handle]:
                    self._use(ready, handle)
                case Accepted(number, change), _:
                    self._conclude(number, change, None)
                case Refused(number, reason), _:
                    self._conclude(number, {}, None, reason)

    def _use(self, ready: ModelReady, handle: int) -> None:
        """Put a model into use; if that fails, the last one stays."""
        try:
            model = ready.map(handle)
            self._on_model(model)
        except Exception as error:
            self._conclude(ready.number, {}, None, one_line(error))
        else:
            self._conclude(ready.number, ready.change, model)

    def _conclude(
        self, number: int, change: Change, model: PreparedModel | None, reason: str = ""
    ) -> None:
        """Note and report the outcome of a change, or of a vademecum (number 0)."""
        self._request = replace(self._request, **change)
        if number == 0:
            if reason:
                self._on_refusal(reason)
            return
        with self._lock:
            answer, self._pending = self._pending, None
        if answer is not None:
            answer(model, reason)
        self._send_next()
