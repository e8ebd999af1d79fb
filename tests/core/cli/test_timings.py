"""What a command says about its time: every stage, children included, as lines and as JSON."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from avatar_core.atlas.patient import _timed
from avatar_core.cli.timings import StageClock, require_timings, show_timings
from avatar_core.errors import StorageError

BUSY = "import time\nwhile time.process_time() < 0.4: pass"


def test_each_second_goes_to_the_stage_it_was_spent_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = StageClock()
    clock.begin("asleep")
    time.sleep(0.3)
    clock.begin("child")
    subprocess.run([sys.executable, "-S", "-c", BUSY], check=True)
    clock.begin("asleep")
    file = tmp_path / "times.json"
    show_timings(clock, file)
    stages = {one.stage: one for one in clock.stages}
    assert list(stages) == ["start", "asleep", "child"]
    assert stages["asleep"].seconds > 0.29 > 0.2 > stages["asleep"].cpu_seconds
    assert stages["child"].cpu_seconds > 0.35
    assert json.loads(file.read_text()) == [vars(one) for one in clock.stages]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    assert lines[-1].split()[:2] == ["all", f"{sum(s.cpu_seconds for s in clock.stages):.2f}"]


def test_stages_of_a_patient_count_their_processes() -> None:
    clock: dict[str, float] = {}
    with _timed(clock, "mesh"):
        subprocess.run([sys.executable, "-S", "-c", BUSY], check=True)
    assert clock["mesh"] > 0.35


def test_reports_pass_through_and_set_the_stage() -> None:
    heard: list[tuple[str, float, float]] = []
    clock = StageClock()
    report = clock.following(lambda *news: heard.append(news))
    report("mesh", 0.0, 0.5)
    report("mesh", 1.0, 0.5)
    report("solve", 0.0, 0.5)
    assert heard == [("mesh", 0.0, 0.5), ("mesh", 1.0, 0.5), ("solve", 0.0, 0.5)]
    assert [one.stage for one in clock.stages] == ["start", "mesh"]


def test_a_file_that_cannot_be_written_is_refused_first(tmp_path: Path) -> None:
    require_timings(None)
    for file in (tmp_path / "times.txt", tmp_path / "missing" / "times.json"):
        with pytest.raises(StorageError, match=r"choose|create"):
            require_timings(file)
