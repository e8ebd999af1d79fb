"""Smooth motion of a tool between poses that arrive slowly.

A program driven by a mouse sends some 30 poses a second, and none while nothing moves; a contact
node wants more than 100. Between two of them the tool moves evenly, one pose late.
"""

from __future__ import annotations

import threading

import numpy as np

LONGEST = 0.1  # longest time for the way to a new pose [s]


class Follower:
    """The tool's pose at any time; safe to use from two threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._from: np.ndarray | None = None  # position and quaternion, (7,)
        self._to = np.zeros(7)
        self._begin, self._takes = 0.0, 0.0  # begin and duration of the way [s]

    @property
    def has_target(self) -> bool:
        """Return whether a pose has come."""
        return self._from is not None

    def follow(self, position: np.ndarray, quaternion: np.ndarray, now: float) -> None:
        """Move to a pose that came now [s]."""
        with self._lock:
            target = np.concatenate([position, quaternion])
            start = target if self._from is None else self._at(now)
            if start[3:] @ target[3:] < 0.0:
                target[3:] *= -1.0  # equal rotation, the shorter way
            self._takes = min(now - self._begin, LONGEST)
            self._from, self._to, self._begin = start, target, now

    def at(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position [m] and unit quaternion at a time [s]."""
        with self._lock:
            place = self._at(now)
        return place[:3], place[3:] / np.linalg.norm(place[3:])

    def stop(self) -> None:
        """Forget all poses."""
        with self._lock:
            self._from = None

    def _at(self, now: float) -> np.ndarray:
        assert self._from is not None
        part = 1.0 if self._takes <= 0.0 else min((now - self._begin) / self._takes, 1.0)
        return np.asarray((1.0 - part) * self._from + part * self._to)
