"""The last changes that a user made on the planning page, for undo."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from threading import Lock
from typing import NamedTuple

_MOST = 100
_TOGETHER = 1.0  # changes of one kind within this time count as one [s]


class _Change(NamedTuple):
    kind: str
    what: str
    back: Callable[[], None]


class History:
    """Changes, each with a function that undoes it."""

    def __init__(self) -> None:
        self._changes: deque[_Change] = deque(maxlen=_MOST)
        self._last = 0.0
        self._lock = Lock()

    def note(self, kind: str, what: str, back: Callable[[], None]) -> None:
        """Note a change; for a drag, only its begin."""
        now = time.monotonic()
        with self._lock:
            same = bool(self._changes) and self._changes[-1].kind == kind
            if not (same and now - self._last < _TOGETHER):
                self._changes.append(_Change(kind, what, back))
            self._last = now

    def undo(self) -> str:
        """Undo the last change; return its name, empty if there is none."""
        with self._lock:
            change = self._changes.pop() if self._changes else None
            self._last = 0.0
        if change is None:
            return ""
        change.back()
        return change.what

    def forget(self) -> None:
        """Forget all changes: they belong to another organ."""
        with self._lock:
            self._changes.clear()
