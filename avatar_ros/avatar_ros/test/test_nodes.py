"""The nodes as colcon installed them: loader and contact start, and one hears of the other.

Run by `colcon test`, with the workspace's setup file sourced; the tests of the repository run the
nodes that pip installed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
import rclpy
from ament_index_python.packages import get_package_prefix, get_package_share_directory

import avatar_core as av
from avatar_interfaces.msg import ContactState
from avatar_ros.framework import qos

START_TIMEOUT = 400.0  # the step is compiled for the first time [s]
END_TIMEOUT = 20.0  # [s]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the vademecum of a coarse phantom, liver.h5."""
    folder = tmp_path_factory.mktemp("library")
    liver = av.build(av.phantom_liver(), av.OrganOptions(n_vertices=600, n_certified=4))
    av.save(liver, folder / "liver.h5")
    return folder


def test_the_packages_are_those_of_the_workspace() -> None:
    for package in ("avatar_core", "avatar_interfaces", "avatar_params", "avatar_ros"):
        prefix = Path(get_package_prefix(package)).resolve()
        assert (prefix / "share" / package / "package.xml").is_file()
    core = Path(str(av.__file__)).resolve()
    assert core.is_relative_to(Path(get_package_prefix("avatar_core")).resolve())
    assert (Path(get_package_prefix("avatar_core")) / "bin" / "avatar").is_file()
    params = Path(get_package_share_directory("avatar_params"))
    assert (params / "scenes" / "palpation.yaml").is_file()


def test_the_contact_node_has_the_vademecum_of_the_loader(library: Path) -> None:
    nodes = Path(get_package_prefix("avatar_ros"), "lib", "avatar_ros")
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    files = ["-p", f"library_dir:={library}", "-p", "vademecum:=liver.h5"]
    processes = [
        subprocess.Popen([nodes / "vademecum_loader", "--ros-args", *files], env=environment),
        subprocess.Popen([nodes / "contact"], env=environment),
    ]
    try:
        assert len(heard().vademecum_id) == 64
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        codes = [process.wait(END_TIMEOUT) for process in processes]
    assert codes == [0, 0]


def heard() -> ContactState:
    """Return the first state of the contact node in which it has a vademecum."""
    rclpy.init()
    node = rclpy.create_node("witness")
    found: list[ContactState] = []
    node.create_subscription(
        ContactState,
        "contact_state",
        lambda state: found.append(state) if state.vademecum_id else None,
        qos.state(1),
    )
    begin = time.monotonic()
    try:
        while not found:
            assert time.monotonic() - begin < START_TIMEOUT, "no state with a vademecum"
            rclpy.spin_once(node, timeout_sec=0.1)
    finally:
        rclpy.shutdown()
    return found[0]
