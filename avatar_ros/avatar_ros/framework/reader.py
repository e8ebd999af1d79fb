"""Reads untrusted files in a process of its own, so that a damaged file cannot end the node."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, ParamSpec, TypeVar

from avatar_core.common.confined import Confined, ConfinedError
from avatar_ros.framework.library import RefusedError

P = ParamSpec("P")
R = TypeVar("R")

_OWN = 1 << 30  # address space of the process and its libraries [bytes]
_SECONDS = 4.0  # for a file of any size, plus its size divided by
_MIN_SPEED = 20e6  # [byte/s]
_IDLE = 10.0  # after which the process, which holds four times the last file, is ended [s]


class Reader:
    """Reads files of at most ``max_bytes``, which may be in memory four times during that.

    idle : after which the process is ended; the next file starts another, which takes a second [s]
    """

    def __init__(self, max_bytes: int, idle: float = _IDLE) -> None:
        self._confined = Confined(_OWN + 4 * max_bytes)
        self._idle = idle
        self._end = threading.Timer(0.0, self._confined.close)  # never started

    @property
    def pid(self) -> int | None:
        """Id of the reading process, if there is one."""
        return self._confined.pid

    def read(
        self, name: str, n_bytes: int, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """``function(*args, **kwargs)``, which reads ``n_bytes`` of the file ``name``.

        Raises
        ------
        AvatarError
            That the function raises.
        RefusedError
            If it ends its process, or takes much longer or more memory than such a file needs.
        """
        seconds = _SECONDS + n_bytes / _MIN_SPEED
        with self._kept():
            try:
                return self._confined.call(seconds, function, *args, **kwargs)
            except ConfinedError as error:
                raise RefusedError(f"{name}: damaged, {error}; make it again") from error

    def load(self, function: Callable[..., Any]) -> None:
        """Start the process, which imports what ``function`` needs; whoever reads soon waits less.

        It ends like any other when it has nothing to do.
        """
        with self._kept(), suppress(ConfinedError):  # which the first file says as well
            self._confined.load(function)

    @contextmanager
    def _kept(self) -> Iterator[None]:
        """End the process only after a while without another use."""
        self._end.cancel()
        try:
            yield
        finally:
            self._end.cancel()  # of another thread, which used it meanwhile
            self._end = threading.Timer(self._idle, self._confined.close)
            self._end.daemon = True
            self._end.start()

    def close(self) -> None:
        """End the process."""
        self._end.cancel()
        self._confined.close()
