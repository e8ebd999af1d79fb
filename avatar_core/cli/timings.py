"""``--timings FILE``: time of each stage of a command, one line a stage and as JSON."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from avatar_core.cli.output import require_output
from avatar_core.common.processes import cpu_seconds
from avatar_core.errors import StorageError, one_line

if TYPE_CHECKING:
    from avatar_core.offline.rule import Progress

Timings = Annotated[
    Path | None,
    typer.Option(
        "--timings", help="print the time of each stage, and write it to this file (.json)"
    ),
]


@dataclass(frozen=True)
class StageTime:
    """Processor time of a stage, its child processes included, and elapsed time [s]."""

    stage: str
    cpu_seconds: float
    seconds: float


class StageClock:
    """Times of the stages of a command, in their order; a stage goes on until the next begins.

    The first stage, ``start``, began with the process. The times of a stage that comes again are
    added.
    """

    def __init__(self) -> None:
        self._stage, self._cpu, self._clock = "start", 0.0, time.monotonic()
        self._spent: dict[str, tuple[float, float]] = {}

    def begin(self, stage: str) -> None:
        """End the stage that is running, if it is another, and begin this one."""
        if stage == self._stage:
            return
        cpu, clock = cpu_seconds(), time.monotonic()
        before = self._spent.get(self._stage, (0.0, 0.0))
        self._spent[self._stage] = (before[0] + cpu - self._cpu, before[1] + clock - self._clock)
        self._stage, self._cpu, self._clock = stage, cpu, clock

    def following(self, progress: Progress) -> Progress:
        """Return a progress function for a build, whose stages are timed."""

        def report(stage: str, fraction: float, error: float) -> None:
            self.begin(stage)
            progress(stage, fraction, error)

        return report

    @property
    def stages(self) -> tuple[StageTime, ...]:
        """Stages that have ended."""
        return tuple(StageTime(stage, *spent) for stage, spent in self._spent.items())


def require_timings(file: Path | None, inputs: Iterable[str | Path | None]) -> None:
    """Raise StorageError unless times can be written to the file, if there is one."""
    if file is not None:
        require_output(file, [".json"], inputs, overwrite=True)


def show_timings(clock: StageClock, file: Path | None) -> None:
    """Print one line a stage and write the file, if there is one.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    if file is None:
        return
    clock.begin("end")
    print(f"  {'time of each stage':30s} {'processor':>10s} {'clock':>10s}")
    for one in clock.stages:
        print(f"    {one.stage:28s} {one.cpu_seconds:8.2f} s {one.seconds:8.2f} s")
    cpu = sum(one.cpu_seconds for one in clock.stages)
    passed = sum(one.seconds for one in clock.stages)
    print(f"    {'all':28s} {cpu:8.2f} s {passed:8.2f} s")
    try:
        file.write_text(json.dumps([asdict(one) for one in clock.stages], indent=2) + "\n")
    except OSError as error:
        raise StorageError(f"cannot write {file} ({one_line(error, 120)})") from error
