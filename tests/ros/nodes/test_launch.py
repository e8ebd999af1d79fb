"""Launch files, evaluated by a stand-in for launch; `colcon test` runs them by launch."""

from __future__ import annotations

import inspect
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from avatar_core.cli.cell import cell as avatar_cell
from avatar_ros.nodes import cell
from tests.ros.helpers import fake_launch
from tests.ros.helpers.doc_pages import ROOT

FOLDER = ROOT / "avatar_ros" / "avatar_ros" / "launch"
PARAMS = ROOT / "params" / "planning_cell.yaml"


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
