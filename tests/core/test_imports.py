"""The core stands without ROS: data flows from it to the nodes, never back."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import avatar_core

ROS = ("avatar_ros", "rclpy", "rcl_interfaces", "ament_index_python", "launch")
FILES = sorted(Path(avatar_core.__file__).parent.rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_no_file_of_the_core_imports_ros(path: Path) -> None:
    """Inside functions neither."""
    imported = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            imported |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            imported |= {node.module.split(".")[0]}
    assert not imported & {*ROS, *(f"{name}_msgs" for name in ("std", "sensor", "geometry"))}
