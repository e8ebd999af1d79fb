"""SIGINT and SIGTERM as a flag, with wake-up of a waiting executor."""

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
    """Signal during an interruptible body; only the end of the process handles it."""


class StopSignal:
    """Flag that is true once SIGINT or SIGTERM was received."""

    def __init__(self) -> None:
        self._came = self._interrupts = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, *_: object) -> None:
        self._came = True
        if self._interrupts:
            self._interrupts = False  # further signals do not interrupt the release
            raise Stopped

    def __bool__(self) -> bool:
        return self._came

    @contextmanager
    def interrupts(self) -> Iterator[None]:
        """Let a signal end the body by :class:`Stopped`, whatever it waits for or computes.

        For the main thread, where Python calls its handlers.
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
        """Let a signal end the executor's wait, however long that is; for the main thread.

        Python calls its handlers between two instructions of the main thread, and there are none
        while
        the thread waits for the middleware. Looking ten times a second would cost 1 % of a core.
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
    """Do nothing: the task only wakes the executor."""
