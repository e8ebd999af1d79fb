"""Memory of loader, contact node and the processes that read for them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from avatar_core.common.confined import Imported
from avatar_interfaces.msg import ContactState
from avatar_interfaces.srv import LoadVademecum
from avatar_ros.bench.footprint import Footprint, children
from avatar_ros.framework import qos
from avatar_ros.framework.reader import Reader
from tests.helpers.processes import has_ended
from tests.helpers.slowness import Deadline, wait_until
from tests.ros.conftest import START_TIMEOUT

MOST = 60.0  # memory of a loader without its announcement [MB]
# modules that only reading and preparing a vademecum needs
LIBRARIES = {"scipy.sparse", "scipy.spatial", "scipy.linalg", "skfem", "igl", "rslab", "h5py"}


@pytest.mark.parametrize("node", ["vademecum_loader", "contact"])
def test_a_node_imports_no_library_that_only_reading_and_preparing_need(node: str) -> None:
    code = f"import sys, avatar_ros.nodes.{node}; print(*sys.modules)"
    command = [sys.executable, "-c", code]
    imported = subprocess.check_output(command, cwd="/", text=True).split()
    assert LIBRARIES.isdisjoint(imported)
    assert node == "contact" or "numba" not in imported


def test_a_process_that_reads_ends_when_it_has_nothing_to_do() -> None:
    reader = Reader(1 << 20, idle=0.2)
    try:
        first = reader.read("a", 0, os.getpid)
        wait_until(lambda: has_ended(first), 30.0)
        assert reader.read("b", 0, os.getpid) not in (first, os.getpid())
    finally:
        reader.close()


def test_a_process_that_was_loaded_for_nothing_ends_too() -> None:
    reader = Reader(1 << 20, idle=0.2)
    try:
        reader.load(os.getpid)
        wait_until(lambda: reader.pid is None, 30.0)
        reader.load(Imported("no_such_module", "f"))  # the first file reports it as well
        assert reader.read("a", 0, os.getpid) != os.getpid()
    finally:
        reader.close()


@pytest.mark.long
def test_a_loader_keeps_little_beside_the_file_that_it_announces(
    cell: dict[str, Any], probe: Any, library: Path
) -> None:
    probe.next(ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id, START_TIMEOUT)
    request = LoadVademecum.Request(name="twin.h5")
    assert probe.call(LoadVademecum, "load_vademecum", request).success
    pid = cell["vademecum_loader"].pid
    passed = Deadline(60.0)
    while [*children(pid)]:  # until the reading process has ended
        assert not passed
        probe.spin(0.2)
    held, file = Footprint.of(pid), (library / "twin.h5").stat().st_size / 1e6
    print(f"\nloader: {held.memory_mb:.0f} MB with a file of {file:.0f} MB")
    assert held.memory_mb < MOST + 2.0 * file  # the present and the previous message
