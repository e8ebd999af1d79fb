"""A process for a part of the work: started when it is needed, and again after it ended.

The process may crash, be killed or be ended half-way without harm to its starter. Both exchange
pickled notes, so the starter has to trust the process like itself.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from avatar_core.common.processes import ModuleProcess
from avatar_core.errors import AvatarError

_GONE = 5.0  # for a process that closed its line to end [s]


class EndedError(AvatarError):
    """The process ended; the message says how."""


class Child:
    """Process ``python -m MODULE ARGUMENTS``, one at a time.

    Its standard input is a connection for notes, unless it is started with another file. Notes are
    sent and received by one thread at a time; any thread may end the process.

    Parameters
    ----------
    module : str
        Module to run.
    arguments : str
        Arguments of the module at every start.
    options : Any
        Options of :class:`ModuleProcess`.
    """

    def __init__(self, module: str, *arguments: str, **options: Any) -> None:
        self._module, self._arguments, self._options = module, arguments, options
        self._process: ModuleProcess | None = None
        self._line: Connection | None = None

    @property
    def pid(self) -> int | None:
        """Id of the process, if it runs."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    @property
    def is_running(self) -> bool:
        """Whether the process was started and did not end."""
        return self.pid is not None

    @property
    def computed(self) -> float:
        """Processor time of the process since its start; 0 once it ended [s]."""
        pid = self.pid
        with suppress(OSError):  # it ended meanwhile
            return computed_by(pid) if pid is not None else 0.0
        return 0.0

    def start(self, *arguments: str, stdin: int | None = None) -> None:
        """Start the process, unless it runs.

        Parameters
        ----------
        arguments : str
            Arguments of this start, after the arguments of every start.
        stdin : int, optional
            File that takes the place of the connection for notes.

        Raises
        ------
        EndedError
            If the system does not start the process.
        """
        if self.is_running:
            return
        self._close()
        theirs = None
        try:
            if stdin is None:
                ours, theirs = socket.socketpair()
                self._line, stdin = Connection(ours.detach()), theirs.fileno()
            words = (*self._arguments, *arguments)
            with deferred_signals():  # raised before it is known, one would leave it behind
                self._process = ModuleProcess(self._module, *words, stdin=stdin, **self._options)
        except OSError as error:
            raise EndedError(f"it does not start, {error.strerror}") from error
        finally:
            if theirs is not None:
                theirs.close()

    def send(self, note: Any) -> None:
        """Send a note; EndedError if the process ended."""
        try:
            self._open_line().send(note)
        except OSError as error:
            raise EndedError(self.finish(_GONE)) from error

    def has_sent(self, seconds: float) -> bool:
        """Return whether a note arrives, or the process ends, within a time [s]."""
        try:
            return self._open_line().poll(seconds)
        except OSError:
            return True

    def receive(self) -> Any:
        """Wait for the next note and return it; EndedError if the process ended."""
        try:
            return self._open_line().recv()
        except (EOFError, OSError) as error:
            raise EndedError(self.finish(_GONE)) from error

    def send_signal(self, number: int) -> None:
        """Send the process a signal, if it runs."""
        if (process := self._process) is not None:
            process.send_signal(number)

    def finish(self, seconds: float, number: int = signal.SIGTERM) -> str:
        """End the process, if there is one: by a signal, and by SIGKILL if it does not end in time.

        Returns
        -------
        str
            How the process ended, e.g. "Killed" or "exit code 1".
        """
        process = self._process
        if process is None:
            return "it was not started"
        code = process.finish(seconds, number)
        self._close()
        return how_it_ended(code)

    def _open_line(self) -> Connection:
        if self._line is None:
            raise BrokenPipeError("no process")
        return self._line

    def _close(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            with suppress(OSError):
                line.close()


def how_it_ended(code: int) -> str:
    """Return the exit code of a process in words."""
    return signal.strsignal(-code) or f"signal {-code}" if code < 0 else f"exit code {code}"


def computed_by(pid: int) -> float:
    """Return the processor time of a process since its start, without its children's [s]."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


@contextmanager
def deferred_signals() -> Iterator[None]:
    """Defer Python's handling of SIGINT and SIGTERM in the main thread until after the body."""
    came: list[int] = []
    before: dict[int, Any] = {}
    try:
        if threading.current_thread() is threading.main_thread():
            for each in (signal.SIGINT, signal.SIGTERM):
                if callable(signal.getsignal(each)):
                    before[each] = signal.signal(each, lambda number, _: came.append(number))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)


@contextmanager
def line_to_starter() -> Iterator[Connection]:
    """Connect the process to its starter; when the starter closes the connection, the body ends."""
    line = Connection(os.dup(sys.stdin.fileno()))
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        yield line
