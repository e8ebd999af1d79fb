"""The ROS packages: each complete in its folder, all of one version."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.helpers.paths import PARAMS, ROOT

ROS = ROOT / "avatar_ros"
PACKAGES = {
    "avatar_core": ROOT / "avatar_core",
    "avatar_interfaces": ROS / "avatar_interfaces",
    "avatar_params": PARAMS,
    "avatar_ros": ROS / "avatar_ros",
}
UPSTREAM = {"crtk_msgs": "1.3.0", "tf2_msgs": "0.36.4"}


def manifest(folder: Path) -> ElementTree.Element:
    return ElementTree.parse(folder / "package.xml").getroot()


def depends(folder: Path, *kinds: str) -> set[str]:
    return {str(one.text) for kind in kinds for one in manifest(folder).iter(kind)}


@pytest.fixture(params=list(PACKAGES))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_a_package_has_what_a_release_needs(name: str) -> None:
    folder, xml = PACKAGES[name], manifest(PACKAGES[name])
    version = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert version and xml.findtext("version") == version[1]
    assert xml.findtext("name") == name
    assert xml.findtext("url") and xml.findtext("author")
    assert (folder / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()
    assert (folder / "README.md").is_file()
    assert f"\n{version[1]} (" in (folder / "CHANGELOG.rst").read_text()


def test_no_package_reaches_outside_its_folder(name: str) -> None:
    text = (PACKAGES[name] / "CMakeLists.txt").read_text()
    assert ".." not in text and "CMAKE_SOURCE_DIR" not in text


def test_what_cmake_finds_is_declared(name: str) -> None:
    folder = PACKAGES[name]
    found = set(re.findall(r"find_package\((\w+)", (folder / "CMakeLists.txt").read_text()))
    assert found <= depends(folder, "buildtool_depend", "depend", "test_depend")


def test_every_interface_is_generated() -> None:
    folder = PACKAGES["avatar_interfaces"]
    listed = re.findall(
        r"^  (\w+/\w+\.\w+)$", (folder / "CMakeLists.txt").read_text(), re.MULTILINE
    )
    there = {
        f"{p.parent.name}/{p.name}"
        for kind in ("msg", "srv", "action")
        for p in folder.glob(f"{kind}/*")
    }
    assert sorted(listed) == sorted(there)


def test_what_the_nodes_import_is_declared() -> None:
    folder = PACKAGES["avatar_ros"]
    known = depends(folder, "exec_depend")
    sources = [*folder.glob("avatar_ros/**/*.py"), *folder.glob("launch/*.py")]
    names = r"\w+_msgs|\w+_interfaces|std_srvs|rclpy|launch\w*|ament_index_python|avatar_core"
    pattern = rf"^ *(?:from|import) ({names})\b"
    used = {
        root for file in sources for root in re.findall(pattern, file.read_text(), re.MULTILINE)
    }
    assert used <= known


@pytest.mark.parametrize("package", list(UPSTREAM))
def test_pip_builds_a_whole_package_of_upstream(package: str) -> None:
    """As it is, with its license: nobody finds half of it under its name."""
    folder = ROS / "wheel" / package
    assert manifest(folder).findtext("version") == UPSTREAM[package]
    assert (folder / "LICENSE").is_file()
    listed = re.findall(
        r"\b((?:msg|srv|action)/\w+\.\w+)\b", (folder / "CMakeLists.txt").read_text()
    )
    listed = [file for file in listed if (folder / file.split("/")[0]).is_dir()]
    there = {
        f"{p.parent.name}/{p.name}"
        for kind in ("msg", "srv", "action")
        for p in folder.glob(f"{kind}/*")
    }
    assert sorted(set(listed)) == sorted(there)


def test_colcon_ignores_what_is_for_pip() -> None:
    assert (ROS / "wheel" / "COLCON_IGNORE").is_file()
