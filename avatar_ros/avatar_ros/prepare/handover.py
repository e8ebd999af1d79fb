"""A vademecum on its way into the loop's process, without the loop noticing.

Deserialising 40 MB, verifying them and preparing the contact model would each hold Python's
global lock for tens of milliseconds; compiling the step for a new selection of effects, for tens of
seconds. A process of its own does all that: it subscribes to `vademecum`, and puts the prepared
arrays into a sealed piece of shared memory, whose handle it sends through a socket. The loop's
process only maps that memory, and reads the compiled step from numba's cache.

The socket carries JSON: to the process the whole ``Order`` first, then changes of it, each with a
number; back a note for each, with what is in force from now on or why it is refused. A model is
sent as soon as it is prepared; how long its steps take is measured then, and sent after it.

The process is :mod:`avatar_ros.prepare.receiver`.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

from avatar_core.common.processes import ModuleProcess
from avatar_core.errors import one_line
from avatar_ros.prepare.orders import PACKET, Change, Order, Prepared
from avatar_ros.prepare.shared_arrays import map_shared

_PREPARER = "avatar_ros.prepare.receiver"
_RESTART_DELAY = 1.0  # [s]
_STOP_TIMEOUT = 1.0  # [s]

# Called with what is in use now and "", or with None and why it was refused; with None and "" if
# there is no vademecum yet, and the change waits for one.
Answer = Callable[[Prepared | None, str], None]


OVERTAKEN = "overtaken by a later one, which is tried instead"


class Handover:
    """Keeps the receiving process running and calls back with what it prepared.

    Callbacks run in a thread of this object, one at a time. Changes are passed on one by one, when
    the last is in use; of those that wait only the newest of a kind counts, so that a slider that
    is dragged fills neither time nor memory.

    on_model : called with each model that was verified and prepared; puts it into use
    on_times : called with the curve of the model in use when its times were measured
    on_refusal : called with one line when a vademecum was refused or the process ended
    """

    def __init__(
        self,
        order: Order,
        on_model: Callable[[Prepared], None],
        on_times: Callable[[dict[str, Any]], None],
        on_refusal: Callable[[str], None],
    ) -> None:
        self._order = order  # in force, for a process that is started anew
        self._on_model = on_model
        self._on_times = on_times
        self._on_refusal = on_refusal
        self._stop = threading.Event()
        self._lock = threading.Lock()  # of the four below
        self._line: socket.socket | None = None
        self._waiting: dict[str, tuple[Change, Answer]] = {}  # by kind
        self._asked: Answer | None = None
        self._number = 0
        self._process: ModuleProcess | None = None
        self._thread = threading.Thread(target=self._supervise, name="handover", daemon=True)
        self._thread.start()

    @property
    def scene(self) -> str:
        """YAML of the scene in force; empty for the natural effects of the vademecum."""
        return self._order.scene

    def ask(self, change: Change, answer: Answer) -> None:
        """Have the vademecum prepared anew after a change of the order; returns at once.

        A change of the same kind that waits is refused as ``OVERTAKEN``, in the caller's thread.
        """
        kind = next((kind for kind in ("material", "budget") if kind in change), "scene")
        with self._lock:
            _, overtaken = self._waiting.pop(kind, (None, None))
            self._waiting[kind] = (change, answer)
        if overtaken is not None:
            overtaken(None, OVERTAKEN)
        self._pass_on()

    def _pass_on(self) -> None:
        """Send the next change, if the process is there and has answered the last."""
        with self._lock:
            if self._line is None or self._asked is not None or not self._waiting:
                return
            change, answer = self._waiting.pop(next(iter(self._waiting)))
            self._number += 1
            packet = json.dumps({"number": self._number, "change": change}, ensure_ascii=False)
            try:
                self._line.send(packet.encode(errors="replace"), socket.MSG_DONTWAIT)
            except OSError as error:
                refusal = f"not passed on ({error.strerror}); ask with less"
            else:
                self._asked, refusal = answer, ""
        if refusal:
            answer(None, refusal)
            self._pass_on()

    def stop(self) -> None:
        """End the receiving process; returns when it has ended."""
        self._stop.set()
        process = self._process
        if process is not None:
            process.finish(_STOP_TIMEOUT)
        self._thread.join(_STOP_TIMEOUT)

    def _supervise(self) -> None:
        while not self._stop.is_set():
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with ours:
                with theirs:
                    ours.send(json.dumps(asdict(self._order)).encode())
                    self._process = ModuleProcess(_PREPARER, stdin=theirs.fileno())
                    with self._lock:
                        self._line = ours
                self._pass_on()
                with contextlib.suppress(ConnectionResetError):  # it ended with packets unread
                    self._receive(ours)
                with self._lock:
                    self._line = None
                    answer, self._asked = self._asked, None
            self._process.finish(_STOP_TIMEOUT)
            if answer is not None:  # not tried again: it may be what ended the process
                answer(None, "the process that prepares models ended; ask again")
            if not self._stop.is_set():
                self._on_refusal("the process that receives vademecums ended; starting another")
                self._stop.wait(_RESTART_DELAY)
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for _, answer in waiting.values():
            answer(None, "the node was cleaned up meanwhile; configure and ask again")

    def _receive(self, ours: socket.socket) -> None:
        taken = False  # the last model that came
        while True:
            packet, handles, _, _ = socket.recv_fds(ours, PACKET, 1)
            if not packet:
                return
            note = json.loads(packet)
            if "times" in note:
                if taken:
                    self._on_times(note["times"])
                continue
            refusal, prepared = note.get("refusal", ""), None
            if handles:
                try:
                    prepared = _prepared(note, handles[0])
                    self._on_model(prepared)
                except Exception as error:  # the node goes on with what it has
                    prepared, refusal = None, one_line(error)
                taken = prepared is not None
            if not refusal:
                self._order = replace(self._order, **note["change"])
            if note["number"] == 0:  # a vademecum came
                if refusal:
                    self._on_refusal(refusal)
                continue
            with self._lock:
                answer, self._asked = self._asked, None
            if answer is not None:
                answer(prepared, refusal)
            self._pass_on()


def _prepared(note: dict[str, Any], handle: int) -> Prepared:
    return Prepared(
        id=note["id"],
        name=note["name"],
        arrays=map_shared(handle, note["arrays"]),
        ranges=note["ranges"],
        effects=tuple(note["effects"]),
        cloud_divisor=note["cloud_divisor"],
        curve=note["curve"],
    )
