"""The packages as colcon builds and tests them in a workspace, without pip's installation."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT
from tests.ros.helpers.running import EXECUTABLES

pytestmark = pytest.mark.long

SCRIPT = ROOT / "tests/ros/helpers/colcon_build.sh"
NO_PYPI = 77
TIMEOUT = 2700.0  # generators of three packages, one compilation of the step [s]


@pytest.mark.parametrize("without_crtk", ["", "1"], ids=["crtk_msgs", "no crtk_msgs"])
def test_colcon_builds_and_tests_the_packages(tmp_path: Path, without_crtk: str) -> None:
    done = subprocess.run(
        [str(SCRIPT), str(tmp_path), sys.prefix],
        env={**os.environ, "WITHOUT_CRTK": without_crtk},
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )
    if done.returncode == NO_PYPI:
        pytest.skip(f"no PyPI: {done.stderr.strip()[-300:]}")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    assert ", 0 errors, 0 failures" in done.stdout
    installed = tmp_path / "workspace" / "install"
    nodes = installed / "avatar_ros" / "lib" / "avatar_ros"
    assert {path.name for path in nodes.iterdir()} == EXECUTABLES
    assert (installed / "crtk_msgs").is_dir() == (not without_crtk)
