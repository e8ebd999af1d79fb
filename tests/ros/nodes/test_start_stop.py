"""The executables of the installation, as `ros2 run` finds them: start, signal, end.

The prefix is that of the Python that runs the tests; CI makes it afresh, as the README says.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.srv import GetState

from tests.helpers.slowness import end_of

pytestmark = pytest.mark.long

END = 2.0  # from a signal to the end [s]
PREFIX = Path(sys.prefix)
# Without an atlas, which takes minutes to make, that node waits to be configured.
ARGUMENTS = {"patient_interpolation": ["--ros-args", "-p", "autostart:=false"]}
STATES = {"patient_interpolation": "unconfigured"}
EXECUTABLES = {
    "contact",
    "organ_markers",
    "patient_interpolation",
    "planning_ui",
    "slicer_bridge",
    "vademecum_loader",
}


@pytest.fixture
def shell(own_domain: dict[str, str]) -> dict[str, str]:
    """What a user's shell has after the README's export, and the tests' domain."""
    kept = ("HOME", "LANG", "NUMBA_CACHE_DIR", "TMPDIR")
    environment = {name: os.environ[name] for name in kept if name in os.environ}
    environment |= {name: value for name, value in own_domain.items() if name.startswith("ROS_")}
    return environment | {
        "AMENT_PREFIX_PATH": str(PREFIX),
        "PATH": f"{PREFIX / 'bin'}:/usr/bin:/bin",
    }


def _run(shell: dict[str, str], code: str) -> str:
    command = [str(PREFIX / "bin" / "python"), "-c", code]
    return subprocess.run(
        command, env=shell, cwd="/", check=True, capture_output=True, text=True
    ).stdout.strip()


def test_the_prefix_is_found_by_ament(shell: dict[str, str]) -> None:
    code = "from ament_index_python.packages import get_package_prefix as p; print(p('avatar_ros'))"
    assert Path(_run(shell, code)).resolve() == PREFIX.resolve()
    share = PREFIX / "share" / "avatar_ros"
    for wanted in ("package.xml", "launch/planning_cell.launch.py", "params/planning_cell.yaml"):
        assert (share / wanted).is_file()


def test_the_executables_are_those_that_are_documented() -> None:
    assert {path.name for path in (PREFIX / "lib" / "avatar_ros").iterdir()} == EXECUTABLES


def executable(name: str) -> list[str]:
    """What `ros2 run` starts."""
    return [str(PREFIX / "lib" / "avatar_ros" / name)]


def module(name: str) -> list[str]:
    """What the README has in its place where there is no `ros2`."""
    return [str(PREFIX / "bin" / "python"), "-m", f"avatar_ros.nodes.{name}"]


@pytest.mark.parametrize(
    ("command", "number"),
    [(executable, signal.SIGINT), (executable, signal.SIGTERM), (module, signal.SIGINT)],
    ids=["executable-SIGINT", "executable-SIGTERM", "module-SIGINT"],
)
@pytest.mark.parametrize("name", sorted(EXECUTABLES))
def test_a_node_starts_without_ros2_and_ends_cleanly(
    shell: dict[str, str],
    lasting_probe: Any,
    name: str,
    command: Callable[[str], list[str]],
    number: signal.Signals,
) -> None:
    if name == "planning_ui":
        pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
    begin = time.monotonic()
    process = subprocess.Popen(
        [*command(name), *ARGUMENTS.get(name, [])],
        env=shell,
        cwd="/",
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        state = lasting_probe.ask(GetState, f"{name}/get_state", GetState.Request())
        started = time.monotonic() - begin
        assert state.current_state.label == STATES.get(name, "active")
        begin = time.monotonic()
        process.send_signal(number)
        assert end_of(process, END) == 0
        ended = time.monotonic() - begin
    finally:
        process.kill()
        _, said = process.communicate()
    print(f"{name}, {number.name}: answers after {started:.2f} s, ended after {ended:.2f} s")
    assert "Traceback" not in said
    assert "rror" not in said
