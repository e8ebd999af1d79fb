"""Launch files: evaluated by a stand-in for launch, and run by launch where it is installed."""

from __future__ import annotations

import inspect
import os
import runpy
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml

from avatar_core.cli.cell import cell as avatar_cell
from avatar_interfaces.msg import ContactState
from avatar_ros.framework import qos
from avatar_ros.nodes import cell
from tests.helpers.slowness import end_of
from tests.ros.conftest import START_TIMEOUT
from tests.ros.helpers import fake_launch
from tests.ros.helpers.doc_pages import ROOT

FOLDER = ROOT / "avatar_ros" / "avatar_ros" / "launch"
PARAMS = ROOT / "params" / "planning_cell.yaml"
# as `ros2 launch FILE name:=value` does it (ros2launch.api.launch_a_launch_file)
ROS2_LAUNCH = """
import sys, launch
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource
path, *arguments = sys.argv[1:]
pairs = [word.split(":=", 1) for word in arguments]
service = launch.LaunchService(argv=arguments, noninteractive=True)
file = IncludeLaunchDescription(AnyLaunchDescriptionSource(path), launch_arguments=pairs)
service.include_launch_description(launch.LaunchDescription([file]))
raise SystemExit(service.run())
"""


@pytest.fixture
def file(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Import the Python launch file with the stand-in for launch."""
    for name, module in fake_launch.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setenv("AMENT_PREFIX_PATH", sys.prefix)
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "avatar_ros", "planning_cell.launch.py"])
    return runpy.run_path(str(FOLDER / "planning_cell.launch.py"))


def started(file: dict[str, Any], *argv: str) -> dict[str, list[Any]]:
    return fake_launch.evaluate(file["generate_launch_description"](), list(argv))


def test_the_arguments_are_the_options_of_avatar_cell(file: dict[str, Any]) -> None:
    declared = file["generate_launch_description"]().entities[:-1]
    assert {argument.name for argument in declared} == {*inspect.signature(avatar_cell).parameters}
    assert file["OVERRIDES"] == cell.OVERRIDES
    assert file["REQUIRED"] == cell.REQUIRED


@pytest.mark.parametrize(
    "more", [{}, {"atlas": "a.h5"}, {"ui": "true", "port": "8081"}, {"tools": "left,right"}]
)
def test_it_starts_the_nodes_of_avatar_cell_with_the_same_parameters(
    file: dict[str, Any], more: dict[str, str]
) -> None:
    given = {"library_dir": "2024", "vademecum": "on", "scene": "1e3", "state_dir": "/s", **more}
    found = started(file, f"params:={PARAMS}", *(f"{n}:={value}" for n, value in given.items()))
    words = {
        node: ["--ros-args", "--params-file", params]
        + [word for name, value in values.items() for word in ("-p", f"{name}:={as_yaml(value)}")]
        for node, (params, values) in found.items()
    }
    assert words == cell.node_arguments(PARAMS, given)
    others = {"port", *cell.LISTS}
    texts = [v for _, values in found.values() for n, v in values.items() if n not in others]
    assert all(isinstance(text, str) for text in texts)  # the node refuses a number


def as_yaml(value: Any) -> str:
    return f"[{','.join(value)}]" if isinstance(value, list) else str(value)


def test_without_arguments_it_starts_what_needs_none_from_the_installed_file(
    file: dict[str, Any],
) -> None:
    installed = Path(sys.prefix, "share/avatar_params/planning_cell.yaml")
    found = started(file, "ui:=false", "atlas:=")
    assert set(found) == {"vademecum_loader", "contact"}
    for params, values in found.values():
        assert Path(params).samefile(installed)
        assert values == {}


def test_a_mistyped_argument_is_refused_unless_it_may_be_that_of_another_file(
    file: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError, match="no argument library_dr; there are atlas, host"):
        started(file, "library_dr:=/l")
    assert started(file, "launch-prefix:=nice")
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "theirs", "theatre.launch.py"])
    assert started(file, "library_dr:=/l")


@pytest.mark.parametrize("argument", ["params:=/missing.yaml", "ui:=maybe"])
def test_an_argument_of_no_use_is_refused(file: dict[str, Any], argument: str) -> None:
    with pytest.raises((OSError, ValueError), match=argument.split(":=")[1]):
        started(file, argument)


def test_the_file_in_yaml_includes_that_in_python_and_nothing_else() -> None:
    content = yaml.safe_load((FOLDER / "planning_cell.launch.yaml").read_text())
    path = "$(find-pkg-share avatar_ros)/launch/planning_cell.launch.py"
    assert content == {"launch": [{"include": {"file": path}}]}


def launched(name: str, arguments: list[str], domain: dict[str, str]) -> subprocess.Popen[str]:
    """Run an installed launch file by launch."""
    needed = ("launch", "launch_ros", *(["launch_yaml"] if name.endswith("yaml") else []))
    missing = [package for package in needed if find_spec(package) is None]
    if missing:
        pytest.skip(f"not installed, and no wheel brings it: {', '.join(missing)}")
    path = Path(sys.prefix, "share/avatar_ros/launch", name)
    # as the README exports them
    ours = {"AMENT_PREFIX_PATH": sys.prefix, "PATH": str(Path(sys.prefix, "bin"))}
    paths = {n: f"{own}:{os.environ.get(n, '')}".rstrip(":") for n, own in ours.items()}
    return subprocess.Popen(
        [sys.executable, "-c", ROS2_LAUNCH, str(path), *arguments],
        cwd="/",
        env={**domain, **paths},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


FILES = pytest.mark.parametrize("name", ["planning_cell.launch.py", "planning_cell.launch.yaml"])


@FILES
def test_launch_runs_a_cell_that_a_signal_ends(
    own_domain: dict[str, str], library: Path, probe: Any, name: str
) -> None:
    arguments = [f"library_dir:={library}", "vademecum:=liver.h5", f"params:={PARAMS}"]
    with launched(name, arguments, own_domain) as process:
        try:
            probe.next(
                ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id, START_TIMEOUT
            )
            process.send_signal(signal.SIGINT)
            assert end_of(process, 20.0) == 0
        finally:
            process.kill()
        said = process.communicate()[0]
    assert said.count("process has finished cleanly") == 2
    assert "patient_interpolation" not in said


@FILES
def test_launch_refuses_a_mistyped_argument(own_domain: dict[str, str], name: str) -> None:
    with launched(name, ["vademecums:=liver.h5"], own_domain) as process:
        assert end_of(process, START_TIMEOUT) == 1
        said = process.communicate()[0]
    assert "there is no argument vademecums" in said
    assert "process started" not in said
