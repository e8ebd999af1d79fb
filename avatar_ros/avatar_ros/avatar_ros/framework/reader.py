"""Reader of untrusted files in a separate process, so that a damaged file cannot end the node."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, ParamSpec, TypeVar

from avatar_core.common.confined import Confined, ConfinedError
from avatar_ros.framework.library import RefusedError

P = ParamSpec("P")
R = TypeVar("R")

_OWN = 1 << 30  # address space for the process and its libraries [bytes]
_SECONDS = 4.0  # time for a file of any size, plus its size divided by _MIN_SPEED
_MIN_SPEED = 20e6  # [byte/s]
# idle time after which the process, which holds four times the last file, is ended [s]
_IDLE = 10.0


class Reader:
    """Reads files of at most ``max_bytes``; reading may take four times their size in memory.

    Parameters
    ----------
    max_bytes : int
        Largest size of a file.
    idle : float
        Idle time after which the process is ended [s]; the next file starts another in about 1 s.
    """

    def __init__(self, max_bytes: int, idle: float = _IDLE) -> None:
        self._confined = Confined(_OWN + 4 * max_bytes)
        self._idle = idle
        self._end = threading.Timer(0.0, self._confined.close)  # never started

    @property
    def pid(self) -> int | None:
        """Return the id of the reading process, if there is one."""
        return self._confined.pid

    def read(
        self, name: str, n_bytes: int, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Call ``function(*args, **kwargs)``, which reads ``n_bytes`` of the file ``name``.

        Raises
        ------
        AvatarError
            If the function raises it.
        RefusedError
            If the function ends its process, or takes far more time or memory than such a file
            needs.
        """
        seconds = _SECONDS + n_bytes / _MIN_SPEED
        with self._kept():
            try:
                return self._confined.call(seconds, function, *args, **kwargs)
            except ConfinedError as error:
                raise RefusedError(f"{name}: damaged, {error}; make it again") from error

    def load(self, function: Callable[..., Any]) -> None:
        """Start the process and import what ``function`` needs, so that the next read waits less.

        It ends like any other when it has nothing to do.
        """
        with self._kept(), suppress(ConfinedError):  # reading the first file reports it as well
            self._confined.load(function)

    @contextmanager
    def _kept(self) -> Iterator[None]:
        """Keep the process during the body, and end it a while after the last use."""
        self._end.cancel()
        try:
            yield
        finally:
            self._end.cancel()  # the timer of another thread, which used the process meanwhile
            self._end = threading.Timer(self._idle, self._confined.close)
            self._end.daemon = True
            self._end.start()

    def close(self) -> None:
        """End the process."""
        self._end.cancel()
        self._confined.close()
