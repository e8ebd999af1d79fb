"""Streams of poses, slow and fast, sound and spoilt, from another process: what is said of each.

`pytest -m long tests/ros/test_streams.py -s` prints the table. On a busy machine it says nothing
of sound streams near pose_timeout: their rows show how long poses or periods were held up.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.loop.statuses import EXPLANATIONS

from avatar_ros.msg import ContactState
from tests.helpers.paths import ROOT
from tests.ros.conftest import START_TIMEOUT
from tests.ros.helpers.fault_cell import Ear
from tests.ros.helpers.stream_tool import SPOIL

pytestmark = pytest.mark.long

RATES = (5, 20, 33, 100, 1000)  # [Hz]
SECONDS = 2.5  # of each stream: two windows of the reports
TIMEOUTS = {"0.02": [*SPOIL], "0.5": ["valid"]}  # pose_timeout [s], and what is sent
NAMES = {
    int(getattr(ContactState, name)): name.removeprefix("STATUS_")
    for name in dir(type(ContactState))
    if name.startswith("STATUS_")
}
OK, ENGAGING = int(ContactState.STATUS_OK), int(ContactState.STATUS_ENGAGING)
STALE, SLOW = int(ContactState.STATUS_STALE_POSE), int(ContactState.STATUS_SLOW_POSES)
INVALID, FRAME = int(ContactState.STATUS_INVALID_POSE), int(ContactState.STATUS_UNKNOWN_FRAME)
NOBODY = {int(ContactState.STATUS_NO_POSE), int(ContactState.STATUS_LOST_TOOL), STALE}
CAUSES = {cause: status for status, (cause, _) in EXPLANATIONS.items()}
LINE = re.compile(r"\[(\d+\.\d+)\] \[contact\]: tool: (?:no force: ([^;]*);|the fault is over)")


@dataclass(frozen=True)
class Stream:
    """What was sent, and what came of it.

    statuses : (when, which) of each period from its first effect to its last pose [s]
    said : the status of each line of the log in that time
    held_up : the longest time between two poses, or two periods of the loop [s]
    force : the largest in the second half [N]
    """

    kind: str
    rate: int
    timeout: float
    statuses: list[tuple[float, int]]
    said: list[int]
    held_up: float
    force: float

    @property
    def expected(self) -> int:
        """The status that it has in the end."""
        if self.kind != "valid":
            return FRAME if self.kind == "frame" else INVALID
        return OK if 1.0 / self.rate <= 0.75 * self.timeout else SLOW

    @property
    def was_late(self) -> bool:
        """Whether the machine was too busy for it: then sound poses may well be slow or stale."""
        return self.held_up > max(0.5 * self.timeout, 1.5 / self.rate)

    @property
    def allowed(self) -> set[int]:
        """All that may be said of it; more if the machine kept poses or periods for too long."""
        if self.kind != "valid":
            return {self.expected}
        return {OK, ENGAGING, self.expected} | ({STALE, SLOW} if self.was_late else set())

    def row(self) -> str:
        counts = Counter(status for _, status in self.statuses)
        shown = ", ".join(f"{n} {NAMES.get(s, s)}" for s, n in counts.most_common())
        log = ", ".join(NAMES.get(s, str(s)) for s in self.said) or "-"
        return (
            f"{self.timeout:4g} s {self.rate:5d} Hz {self.kind:10} {shown}; log: {log}; "
            f"{self.force:.2f} N; held up {1e3 * self.held_up:.0f} ms"
        )


@pytest.fixture(params=TIMEOUTS)
def streams(
    request: Any, own_domain: dict[str, str], library: Path, probe: Any, touch: Any
) -> Iterator[list[Stream]]:
    files = ["-p", f"library_dir:={library}", "-p", "vademecum:=liver.h5"]
    timeout = ["--ros-args", "-p", f"pose_timeout:={request.param}"]
    nodes = [
        Module("vademecum_loader", ["--ros-args", *files], own_domain),
        Module("contact", timeout, own_domain),
    ]
    sent = [(kind, rate) for kind in TIMEOUTS[request.param] for rate in RATES]
    try:
        probe.next(
            ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id, START_TIMEOUT
        )
        ear = Ear()
        times = played(touch[0], sent, own_domain)
        said = nodes[1].said()
        ear.close()
        yield [
            heard(kind, rate, float(request.param), *when, ear, said)
            for (kind, rate), when in zip(sent, times, strict=True)
        ]
    finally:
        codes = [node.finish() for node in nodes]
    assert codes == [0, 0]


def played(
    tip: np.ndarray, sent: list[tuple[str, int]], domain: dict[str, str]
) -> list[tuple[float, float, float]]:
    """When each stream began and ended, and its longest gap [s]."""
    words = [*map(str, tip), str(SECONDS), *(f"{kind}:{rate}" for kind, rate in sent)]
    command = [sys.executable, "-m", "tests.ros.helpers.stream_tool", *words]
    printed = subprocess.check_output(command, cwd=ROOT, env=domain, text=True, timeout=1800.0)
    return [
        (float(begin), float(end), float(gap))
        for begin, end, gap in (line.split() for line in printed.splitlines())
    ]


def heard(
    kind: str, rate: int, timeout: float, begin: float, end: float, gap: float, ear: Ear, said: str
) -> Stream:
    during = [(at, status) for at, status, _ in ear.statuses if begin <= at <= end]
    statuses = list(dropwhile(lambda found: found[1] in NOBODY, during))
    now = time.time() - time.monotonic()
    lines = [
        CAUSES.get(cause, OK) if cause else OK
        for at, cause in LINE.findall(said)
        if begin + 1.1 <= float(at) - now <= end  # of a window that had nothing else
    ]
    loop = max(np.diff([at for at, _ in during]), default=0.0)
    forces = ear.forces((begin + end) / 2, end)[1]
    force = float(np.abs(forces).max(initial=0.0))
    return Stream(kind, rate, timeout, statuses, lines, max(gap, float(loop)), force)


def test_every_stream_is_told_what_is_wrong_with_it_and_nothing_else(streams: list[Stream]) -> None:
    print("", *(stream.row() for stream in streams), sep="\n")
    for stream in streams:
        found = {status for _, status in stream.statuses}
        assert found, stream.row()
        assert stream.expected in found or (stream.kind == "valid" and stream.was_late)
        assert found <= stream.allowed, stream.row()
        assert set(stream.said) <= stream.allowed, stream.row()
        if stream.expected != OK:
            assert stream.statuses[-1][1] == stream.expected, stream.row()
            assert stream.force == 0.0, stream.row()
        elif not stream.was_late:
            assert stream.force > 0.1, stream.row()
