"""The package as colcon builds it, from a workspace, without pip's installation."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT
from tests.ros.helpers.running import EXECUTABLES

pytestmark = pytest.mark.long

SCRIPT = ROOT / "tests/ros/helpers/colcon_build.sh"
NO_PYPI = 77
TIMEOUT = 1800.0  # five generators, one compilation of the step [s]


def test_colcon_builds_it_and_what_it_built_runs(tmp_path: Path) -> None:
    done = subprocess.run(
        [str(SCRIPT), str(tmp_path), sys.prefix], capture_output=True, text=True, timeout=TIMEOUT
    )
    if done.returncode == NO_PYPI:
        pytest.skip(f"no PyPI: {done.stderr.strip()[-300:]}")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "contact has vademecum" in done.stdout
    installed = tmp_path / "workspace" / "install" / "avatar_ros"
    assert {path.name for path in (installed / "lib" / "avatar_ros").iterdir()} == EXECUTABLES
    assert (installed / "bin" / "avatar").is_file()
    assert (installed / "share" / "avatar_ros" / "params" / "this_machine_only.xml").is_file()
