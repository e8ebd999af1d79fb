"""A process ends although its middleware does not let it, or its node has not started yet."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("avatar_ros.framework.ending", reason="avatar_ros is not installed")

from avatar_ros.bench.cell import Module

from avatar_core.vademecum.storage import save_vademecum
from tests.helpers.slowness import Deadline, end_of

pytestmark = pytest.mark.ros

# PyDLL keeps the interpreter's lock, as rclpy does while it removes a participant.
HANGS = """
import ctypes
from avatar_ros.framework.ending import end_within
print("said", end=" ")
end_within({seconds}, {code})
ctypes.PyDLL(None).sleep({hangs})
"""


@pytest.mark.parametrize("code", [0, 1])
def test_a_process_that_hangs_ends_with_its_code(code: int) -> None:
    script = HANGS.format(seconds=0.2, code=code, hangs=3600)
    command = [sys.executable, "-c", script]
    process = subprocess.Popen(command, cwd="/", stdout=subprocess.PIPE, text=True)
    try:
        assert end_of(process, 10.0) == code
    finally:
        process.kill()
    assert process.communicate()[0] == "said "


def test_a_process_that_ends_by_itself_does_so_before() -> None:
    script = HANGS.format(seconds=3600, code=7, hangs=0)
    process = subprocess.run([sys.executable, "-c", script], cwd="/", timeout=60.0)
    assert process.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_node_that_still_reads_its_organ_ends(
    own_domain: dict[str, str], organ: Any, tmp_path: Path, number: signal.Signals
) -> None:
    """However long that would take: the process that reads is held."""
    save_vademecum(organ, tmp_path / "liver.h5")
    arguments = ["-p", f"library_dir:={tmp_path}", "-p", "vademecum:=liver.h5"]
    node = Module("vademecum_loader", ["--ros-args", *arguments], own_domain)
    try:
        reading = reader_of(node)
        os.kill(reading, signal.SIGSTOP)
        node.send_signal(number)
        assert end_of(node, 5.0) == 0
        late = Deadline(3.0)
        while Path(f"/proc/{reading}").exists():  # killed, it takes a moment to vanish
            assert not late, "the process that reads is left behind"
            time.sleep(0.01)
    finally:
        node.kill()


def reader_of(node: Module) -> int:
    """The process that reads files for a node, once there is one."""
    late = Deadline(60.0)
    while not late:
        for child in children(node.pid):
            if b"confined" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child
        time.sleep(0.01)
    raise AssertionError("nothing is read")


def children(pid: int) -> Iterator[int]:
    for thread in Path(f"/proc/{pid}/task").iterdir():
        yield from map(int, (thread / "children").read_text().split())
