"""A process ends although its middleware does not let it, or its node has not started yet."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from avatar_core.vademecum.storage import save_vademecum
from avatar_ros.bench.cell import Module
from avatar_ros.bench.footprint import children
from tests.helpers.processes import has_ended
from tests.helpers.slowness import end_of, wait_until

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
    with subprocess.Popen([sys.executable, "-c", script], cwd="/") as process:
        assert end_of(process, 60.0) == 0


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_node_that_still_reads_its_organ_ends(
    own_domain: dict[str, str], organ: Any, tmp_path: Path, number: signal.Signals
) -> None:
    """The reading process is stopped, so that reading would never end."""
    save_vademecum(organ, tmp_path / "liver.h5")
    arguments = ["-p", f"library_dir:={tmp_path}", "-p", "vademecum:=liver.h5"]
    node = Module("vademecum_loader", ["--ros-args", *arguments], own_domain)
    try:
        reading = reader_of(node)
        os.kill(reading, signal.SIGSTOP)
        node.send_signal(number)
        assert end_of(node, 5.0) == 0
        wait_until(lambda: has_ended(reading), 3.0, "the process that reads did not end")
    finally:
        node.kill()


def reader_of(node: Module) -> int:
    """Wait for the process that reads files for a node."""

    def reading() -> list[int]:
        words = {child: Path(f"/proc/{child}/cmdline").read_bytes() for child in children(node.pid)}
        return [child for child, command in words.items() if b"confined" in command]

    wait_until(lambda: bool(reading()), 60.0, "nothing was read")
    return reading()[0]
