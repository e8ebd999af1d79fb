"""Exclusive turns for test files that measure time: they run last, and alone.

With several workers of pytest-xdist, a file with a test marked ``timing`` waits until the other
workers are between two files. They wait for its end, the teardown of its fixtures included.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path
from typing import IO, Any

import pytest


def is_timing(item: pytest.Item) -> bool:
    return item.get_closest_marker("timing") is not None


class Turns:
    """Lock held over each test file: shared, or exclusive if a test of it measures time."""

    def __init__(self) -> None:
        self._timing: set[Path] = set()
        self._held: IO[Any] | None = None

    @pytest.hookimpl(trylast=True)  # after deselection
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        self._timing = {item.path for item in items if is_timing(item)}
        items.sort(key=lambda item: item.path in self._timing)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> Any:
        if self._held is None:
            self._held = _lock(item.config, exclusive=item.path in self._timing)
        try:
            return (yield)
        finally:
            if nextitem is None or nextitem.path != item.path:
                self._held.close()
                self._held = None


def _lock(config: pytest.Config, exclusive: bool) -> IO[Any]:
    """Hold the door while waiting, so that later processes cannot keep the waiting one out."""
    run = getattr(config, "workerinput", {}).get("testrunuid", os.getpid())
    path = Path(tempfile.gettempdir(), f"avatar-tests-{run}")
    held = path.with_suffix(".lock").open("w")
    with path.with_suffix(".door").open("w") as door:
        fcntl.flock(door, fcntl.LOCK_EX)
        fcntl.flock(held, fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH)
    return held
