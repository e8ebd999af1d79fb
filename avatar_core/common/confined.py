"""Calls in a separate process with limits of time and memory, for reading files of others.

Some damaged files crash the libraries behind HDF5 and NIfTI (a segmentation fault of HDF5 2.0).
Others hang them or make them allocate all memory, before any check of this project. In a process of
their own they do no harm: if it dies, another is started.

This protects against accidents, not against attacks: results are pickled, and the process has the
rights of its user.

``Confined`` runs this module as ``python -m avatar_core.common.confined MAX_BYTES``.
"""

from __future__ import annotations

import contextlib
import importlib
import pickle
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from avatar_core.common.child import Child, EndedError, line_to_starter
from avatar_core.errors import AvatarError, one_line

P = ParamSpec("P")
R = TypeVar("R")

MAX_BYTES = 2 << 30
RETURNED, RAISED, FAILED = "returned", "raised", "failed"  # with a value, our error, a line
_START_SECONDS = 60.0  # limit of the import of a function
_WAITING = 10.0  # multiple of a call's processor time after which it counts as stuck
_LOOK = 0.2  # at the time it has computed [s]
_STOP_SECONDS = 0.1  # to end before it is killed


class ConfinedError(AvatarError):
    """A call ended its process, exceeded its time or memory, or failed unexpectedly."""


class Imported:
    """A function by its name, which is imported where it is called and not where it is named."""

    def __init__(self, module: str, name: str) -> None:
        self._module, self._name = module, name

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function, importing its module first."""
        return _imported(self._module, self._name)(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        return _imported, (self._module, self._name)


def _imported(module: str, name: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function


class Confined:
    """A process that calls functions for this one.

    It is started when it is first needed, and again after a call that ended it. Calls come from any
    thread, one at a time.

    Parameters
    ----------
    max_bytes : int
        Address space beyond the process's use before its first call [bytes].
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._lock = threading.Lock()
        self._child = Child(
            "avatar_core.common.confined",
            str(max_bytes),  # each thread would take some of it
            stdout=subprocess.DEVNULL,  # libraries print there; the error that is raised counts
            stderr=subprocess.DEVNULL,
        )

    @property
    def pid(self) -> int | None:
        """Id of the process; None if there is none."""
        return self._child.pid

    def call(
        self, seconds: float, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Return ``function(*args, **kwargs)``; all of them can be pickled.

        ``Imported`` in place of a function keeps this process free of the function's imports.

        Parameters
        ----------
        seconds : float
            Limit of processor time, independent of the machine's load [s]. Imports while the
            function is loaded do not count.

        Raises
        ------
        AvatarError
            If the function raises it.
        ConfinedError
            If the function raises anything else, ends the process or takes longer.
        """
        with self._lock:
            try:
                self._child.start()
                self._exchange(_START_SECONDS, function)
                outcome, value = self._exchange(seconds, (args, kwargs))
            except TimeoutError:
                self._child.finish(_STOP_SECONDS)
                raise ConfinedError(f"it takes longer than {seconds:.0f} s to read") from None
            except EndedError as error:
                raise ConfinedError(f"reading it ends the process ({error})") from error
        if outcome == FAILED:
            raise ConfinedError(value)
        if outcome == RAISED:
            raise value
        return value

    def load(self, function: Callable[..., Any]) -> None:
        """Start the process and import the modules of a function: the next call is faster.

        Raises
        ------
        ConfinedError
            If the function cannot be imported.
        """
        self.call(_START_SECONDS, _nothing, function)

    def kill(self) -> None:
        """End the process at once; a waiting call raises ConfinedError."""
        self._child.send_signal(signal.SIGKILL)

    def close(self) -> None:
        """End the process, if there is one, after its present call."""
        with self._lock:
            self._child.finish(_STOP_SECONDS)

    def _exchange(self, seconds: float, order: Any) -> Any:
        self._child.send(order)
        end, most = time.monotonic() + _WAITING * seconds, self._child.computed + seconds
        while not self._child.has_sent(_LOOK):
            if time.monotonic() > end or self._child.computed > most:
                raise TimeoutError
        return self._child.receive()


# --- the process ------------------------------------------------------------------------------


def _serve(line: Connection) -> None:
    while True:
        function = line.recv()
        line.send(None)
        args, kwargs = line.recv()
        line.send(_called(function, args, kwargs))


def _called(function: Callable[..., Any], args: Any, kwargs: Any) -> tuple[str, Any]:
    try:
        return RETURNED, function(*args, **kwargs)
    except AvatarError as error:
        with contextlib.suppress(Exception):
            pickle.loads(pickle.dumps(error))
            return RAISED, error
        return FAILED, str(error)
    except Exception as error:
        return FAILED, one_line(error, 120)


def _nothing(function: Callable[..., Any]) -> None:
    """Return at once: the function's modules were imported when the function came in."""


def main(max_bytes: int) -> int:
    """Answer calls until the connection is closed."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + max_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with line_to_starter() as line:
        _serve(line)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(int(sys.argv[1])))
