"""A process ends although its middleware does not let it."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("avatar_ros.framework.ending", reason="avatar_ros is not installed")

from tests.slowness import end_of

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
