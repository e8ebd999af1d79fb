"""The installed launch files, run by `ros2 launch`."""

from __future__ import annotations

import shutil
import signal
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(shutil.which("ros2") is None, reason="no command ros2")
END_TIMEOUT = 60.0  # [s]
FILES = pytest.mark.parametrize("name", ["planning_cell.launch.py", "planning_cell.launch.yaml"])


def launched(name: str, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        ["ros2", "launch", "--noninteractive", "avatar_ros", name, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@FILES
def test_launch_runs_a_cell_that_a_signal_ends(tmp_path: Path, name: str) -> None:
    with launched(name, f"library_dir:={tmp_path}") as process:
        try:
            said = ""
            while "no pose of the tool" not in said and process.stdout:  # contact runs
                line = process.stdout.readline()
                assert line, f"launch ended: {said}"
                said += line
            process.send_signal(signal.SIGINT)
            said += process.communicate(timeout=END_TIMEOUT)[0]
        finally:
            process.kill()
    assert process.returncode == 0
    assert said.count("process has finished cleanly") == 2
    assert "patient_interpolation" not in said


@FILES
def test_launch_refuses_a_mistyped_argument(name: str) -> None:
    with launched(name, "vademecums:=liver.h5") as process:
        said = process.communicate(timeout=END_TIMEOUT)[0]
    assert process.returncode == 1
    assert "there is no argument vademecums" in said
    assert "process started" not in said
