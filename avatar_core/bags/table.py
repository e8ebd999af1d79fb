"""Messages of one topic as they are read: columns that grow, without an object for each.

A recorder's clock may be set back while it writes. A topic shows that by a few steps back in the
order of its file; times of receipt then go on from where they were.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avatar_core.errors import StorageError

_BACK = 50_000_000  # from a message to the next: more than recorders mix up [ns]
_FEW = 3  # times that a clock is set back; more often, messages were written in any order
MAX_MESSAGES = 10_000_000  # messages of a topic: nearly three hours at 1 kHz, 700 MB


@dataclass(frozen=True, eq=False)
class Table:
    """Messages in the order of their receipt.

    received : ndarray of int, shape (n,), time of receipt [ns]
    stamp : ndarray of int, shape (n,), stamp of the header [ns]
    label : ndarray of int, shape (n,), index into ``labels``
    labels : texts, e.g. frames.
    values : ndarray, shape (n, m), numbers of each message
    """

    received: np.ndarray
    stamp: np.ndarray
    label: np.ndarray
    labels: tuple[str, ...]
    values: np.ndarray

    def __len__(self) -> int:
        return len(self.stamp)

    def where(self, keep: np.ndarray) -> Table:
        """Return the rows that a mask or an index selects."""
        return Table(
            self.received[keep], self.stamp[keep], self.label[keep], self.labels, self.values[keep]
        )


class TableWriter:
    """Collector of rows of ``width`` numbers.

    refused : number of messages that could not be decoded
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._received, self._stamps = array("q"), array("q")
        self._label, self._values = array("H"), array("d")
        self._labels: dict[str, int] = {}
        self.refused = 0

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, received: int, stamp: int, label: str, values: tuple[float, ...]) -> None:
        """Add a row.

        Raises
        ------
        StorageError
            If there are more than ``MAX_MESSAGES`` or 65,536 labels.
        """
        if len(self._stamps) >= MAX_MESSAGES:
            raise StorageError(
                f"more than {MAX_MESSAGES:,} messages in a topic; cut the bag in parts, by "
                "'ros2 bag convert' or rosbags-convert"
            )
        index = self._labels.setdefault(label, len(self._labels))
        if index > 0xFFFF:
            raise StorageError("more than 65,536 frames or names in a topic; this is no tool's bag")
        self._received.append(received)
        self._stamps.append(stamp)
        self._label.append(index)
        self._values.extend(values)

    def set_back(self) -> list[int]:
        """Return the amounts by which the clock was set back, time after time [ns]."""
        steps = np.diff(np.array(self._received, np.int64))
        back = steps < -_BACK
        if not 0 < back.sum() <= _FEW:
            return []
        period = int(np.median(steps[~back])) if not back.all() else 0
        return [period - step for step in steps[back].tolist()]

    def table(self, set_back: Sequence[int] = ()) -> Table:
        """Return the collected messages, sorted by the time of receipt; repeated messages once.

        set_back : results of :meth:`set_back` for all topics
        """
        received = np.array(self._received, np.int64)
        if set_back:
            after = np.flatnonzero(np.diff(received) < -_BACK) + 1
            for first, step in zip(after, set_back, strict=True):
                received[first:] += step
        whole = Table(
            received,
            np.array(self._stamps, np.int64),
            np.array(self._label, np.int64),
            tuple(self._labels),
            np.array(self._values, np.float64).reshape(-1, self._width),
        )
        table = whole.where(np.argsort(whole.received, kind="stable"))
        same = np.zeros(len(table), bool)
        same[1:] = (
            (np.diff(table.received) == 0)
            & (np.diff(table.stamp) == 0)
            & (np.diff(table.label) == 0)
            & (table.values[1:] == table.values[:-1]).all(axis=1)
        )
        return table.where(~same)
