"""SIGINT and SIGTERM: a flag, and what wakes an executor that waits."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.executors import Executor


class Stopped(BaseException):
    """A signal came before something was done; nothing but the end of the process handles it."""


class StopSignal:
    """True once SIGINT or SIGTERM was received."""

    def __init__(self) -> None:
        self._came = self._interrupts = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, *_: object) -> None:
        self._came = True
        if self._interrupts:
            self._interrupts = False  # what is released then is not interrupted by another one
            raise Stopped

    def __bool__(self) -> bool:
        return self._came

    @contextmanager
    def interrupts(self) -> Iterator[None]:
        """A signal ends the body, whatever it waits for or computes, by :class:`Stopped`.

        In the main thread, where Python calls its handlers.
        """
        if self._came:
            raise Stopped
        self._interrupts = True
        try:
            yield
        finally:
            self._interrupts = False

    @contextmanager
    def wakes(self, executor: Executor) -> Iterator[None]:
        """A signal ends the executor's waiting, however long that would be; in the main thread.

        Python calls its handlers between two instructions of the main thread, of which there are
        none while that waits for the middleware. Looking ten times a second costs 1 % of a core.
        """
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        with ours, theirs:
            before = signal.set_wakeup_fd(theirs.fileno())
            waker = threading.Thread(target=_pass_on, args=(ours, executor), name="signals")
            waker.start()
            try:
                yield
            finally:
                signal.set_wakeup_fd(before)
                theirs.close()
                waker.join()


def _pass_on(signals: socket.socket, executor: Executor) -> None:
    """Give the executor a task for each signal; ``wake()`` alone does not end ``spin_once()``."""
    while signals.recv(1):
        executor.create_task(_nothing)


def _nothing() -> None:
    """Return."""
