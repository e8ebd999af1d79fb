"""Arrays passed from one process to another by shared memory."""

from __future__ import annotations

import mmap
import os
import subprocess
import sys

import numpy as np
import pytest

from avatar_ros.prepare.protocol import Channel
from avatar_ros.prepare.requests import PreparationRequest
from avatar_ros.prepare.shared_arrays import map_shared, write_shared
from tests.helpers.slowness import end_of


def _arrays() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    return {
        "space": random.random((7, 3, 5)).astype(np.float32),
        "start": np.arange(11),
        "none": np.empty((0, 3)),
        "load": random.random((4, 3)),
    }


def test_arrays_arrive_as_they_were() -> None:
    sent = _arrays()
    received = map_shared(*write_shared(sent))
    for name, values in sent.items():
        np.testing.assert_array_equal(received[name], values)
        assert received[name].dtype == values.dtype
        assert type(received[name]) is np.ndarray  # compiled code expects these
        assert received[name].flags.aligned and received[name].flags.writeable


def test_neither_side_can_alter_what_was_handed_over() -> None:
    handle, _ = write_shared(_arrays())
    with pytest.raises(PermissionError):
        os.ftruncate(handle, 1)
    with pytest.raises(PermissionError):
        os.pwrite(handle, b"x", 0)
    with pytest.raises(PermissionError):
        mmap.mmap(handle, 0)
    os.close(handle)


def test_the_receiving_process_ends_with_the_node(own_domain: dict[str, str]) -> None:
    """The node may have been killed before its child could ask to be told."""
    ours, theirs = Channel.pair()
    request = PreparationRequest("vademecum", "orphan", "/", (0.005,), None, "surface", 1e-3)
    Channel(ours).send(request)
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "avatar_ros.prepare.worker"],
            stdin=theirs.fileno(),
            env=own_domain,
            cwd="/",
        )
    ours.close()
    try:
        assert end_of(process, 60.0) == 0
    finally:
        process.kill()
