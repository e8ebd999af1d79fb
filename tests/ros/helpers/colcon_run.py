"""Starts loader and contact from a colcon installation and waits for a state from both.

python tests/ros/helpers/colcon_run.py INSTALL/avatar_ros        with INSTALL/setup.bash sourced
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

START_TIMEOUT = 240.0  # the step is compiled for the first time [s]


def main(prefix: Path) -> int:
    from ament_index_python.packages import get_package_prefix

    import avatar_core
    import avatar_ros

    for package in (avatar_core, avatar_ros):
        place = Path(str(package.__file__)).resolve()
        assert place.is_relative_to(prefix.resolve()), f"{place} is not what colcon installed"
    assert Path(get_package_prefix("avatar_ros")).resolve() == prefix.resolve()
    from avatar_ros.bench.cell import isolated_environment

    os.environ.update(isolated_environment())
    with tempfile.TemporaryDirectory() as library:
        _build(Path(library))
        nodes = prefix / "lib" / "avatar_ros"
        files = ["-p", f"library_dir:={library}", "-p", "vademecum:=liver.h5"]
        processes = [
            subprocess.Popen([nodes / "vademecum_loader", "--ros-args", *files]),
            subprocess.Popen([nodes / "contact"]),
        ]
        try:
            print(_state())
        finally:
            for process in processes:
                process.send_signal(signal.SIGINT)
            codes = [process.wait(10.0) for process in processes]
    assert codes == [0, 0], codes
    return 0


def _build(library: Path) -> None:
    from avatar_core.geometry.phantom import phantom_liver
    from avatar_core.offline.rule import BuildRule
    from avatar_core.pipeline import OrganOptions, build
    from avatar_core.vademecum.storage import save_vademecum

    options = OrganOptions(
        n_displayed=0, n_vertices=600, rule=BuildRule(max_modes=10), n_certified=4
    )
    save_vademecum(build(phantom_liver(12e-3), options), library / "liver.h5")


def _state() -> str:
    """Return the first state of the contact node in which it has the vademecum."""
    import rclpy

    from avatar_interfaces.msg import ContactState
    from avatar_ros.framework import qos

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
    while not found:
        assert time.monotonic() - begin < START_TIMEOUT, "no state with a vademecum"
        rclpy.spin_once(node, timeout_sec=0.1)
    rclpy.shutdown()
    return (
        f"contact has vademecum {found[0].vademecum_id[:12]} after {time.monotonic() - begin:.1f} s"
    )


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1])))
