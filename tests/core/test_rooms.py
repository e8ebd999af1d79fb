"""The order of the packages: data flows from the first to the last, and no import runs back."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

PAGE = ROOT / "msg_docs" / "background" / "architecture.md"
CORE, NODES = ROOT / "avatar_core", ROOT / "avatar_ros" / "avatar_ros" / "avatar_ros"

ORDER = {
    "avatar_core": (
        "errors",
        "common",
        "geometry",
        "fem",
        "reduction",
        "shapes",
        "vademecum",
        "tips",
        "registration",
        "offline",  # knows no step
        "contact",
        "haptics",
        "certify",
        "pipeline",
        "uncertainty",
        "scene",
        "bags",
        "atlas",
        "__init__",  # the public API
        "studies",
        "cli",
    ),
    "avatar_ros": (
        "framework",
        "loop",
        "prepare",
        "patients",
        "ui",
        "slicer",
        "nodes",
        "bench",
        "__init__",
    ),
    "avatar_ros.ui": (
        "__init__",
        "server",
        "view",
        "measure",
        "scan",
        "tools",
        "session",
        "plan",
        "patient",
        "tabs",
        "panels",
        "settings",
    ),
}
FREE_OF_ROS = (
    "avatar_interfaces",
    "avatar_ros",
    "rclpy",
    "rcl_interfaces",
    "ament_index_python",
    "launch",
)
FOLDERS = {"avatar_core": CORE, "avatar_ros": NODES, "avatar_ros.ui": NODES / "ui"}


def module_name(file: Path, package: str) -> str:
    parts = file.relative_to(FOLDERS[package]).with_suffix("").parts
    return ".".join((package, *(parts[:-1] if parts[-1] == "__init__" else parts)))


def imported(file: Path) -> Iterator[str]:
    """Return everything a file imports, inside functions and for type checkers too."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imports_of(package: str) -> dict[str, set[str]]:
    """Return for each module of a package the modules of the same package that it imports."""
    files = {module_name(f, package): f for f in sorted(FOLDERS[package].rglob("*.py"))}
    found = {}
    for module, file in files.items():
        names = {name for name in imported(file) if name.startswith(f"{package}.")}
        # ``a.b.name``: the module a.b.name if there is one, or else a.b.
        targets = {name if name in files else name.rpartition(".")[0] for name in names}
        found[module] = {target for target in targets if target in files} - {module}
    return found


def room(module: str, package: str) -> str:
    return module.removeprefix(package).split(".")[1] if module != package else "__init__"


@pytest.fixture(params=list(ORDER))
def package(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_every_folder_is_a_package_of_the_order(package: str) -> None:
    found = {p.stem for p in FOLDERS[package].iterdir() if p.suffix == ".py" or p.is_dir()}
    assert found - {"__pycache__", "py"} == set(ORDER[package])


def test_no_import_runs_back(package: str) -> None:
    order = ORDER[package]
    back = [
        f"{module} -> {target}"
        for module, targets in imports_of(package).items()
        for target in targets
        if order.index(room(target, package)) > order.index(room(module, package))
    ]
    assert not back


def test_no_circle(package: str) -> None:
    try:
        TopologicalSorter(imports_of(package)).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' -> '.join(error.args[1])}")


def test_every_package_says_what_it_is_for(package: str) -> None:
    for init in FOLDERS[package].rglob("__init__.py"):
        text = ast.get_docstring(ast.parse(init.read_text())) or ""
        assert len(text.split()) >= 12, f"{init}: no paragraph"


def test_the_core_stands_without_ros() -> None:
    for file in CORE.rglob("*.py"):
        roots = {name.split(".")[0] for name in imported(file)}
        assert not roots & {*FREE_OF_ROS, "std_msgs", "sensor_msgs", "geometry_msgs"}, file


def test_one_module_opens_hdf5_files() -> None:
    users = {
        file.relative_to(folder).as_posix()
        for folder in FOLDERS.values()
        for file in folder.rglob("*.py")
        if any(name.split(".")[0] == "h5py" for name in imported(file))
    }
    assert users == {"common/hdf5.py"}


def test_studies_serve_the_command_alone() -> None:
    users = {
        room(module, "avatar_core")
        for module, targets in imports_of("avatar_core").items()
        if any(room(target, "avatar_core") == "studies" for target in targets)
    }
    assert users <= {"studies", "cli"}
    for file in NODES.rglob("*.py"):
        assert not any(name.startswith("avatar_core.studies") for name in imported(file)), file


def test_the_page_of_the_architecture_has_the_order(package: str) -> None:
    (line,) = re.findall(rf"^- `{package}`: (.*)$", PAGE.read_text(), re.MULTILINE)
    named = [name.removesuffix(".py") for name in re.findall(r"`([\w.]+)`", line)]
    assert named == [name for name in ORDER[package] if name in named]
    assert set(ORDER[package]) - set(named) <= {"__init__"}


def test_the_page_of_the_architecture_names_files_that_are_there() -> None:
    named = re.findall(r"`(\w+/(?:\w+/)*(?:\w+\.py)?)`", PAGE.read_text())
    assert len(named) > 10
    assert not [
        name for name in named if not any((at / name).exists() for at in (ROOT, CORE, NODES))
    ]
