"""Arrays passed from one process to another through sealed shared memory."""

from __future__ import annotations

import fcntl
import mmap
import os
from typing import Any

import numpy as np

from avatar_ros.framework import realtime

_ALIGNMENT = 64  # alignment of every array [bytes]
_SEALS = fcntl.F_SEAL_SEAL | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE


def write_shared(arrays: dict[str, np.ndarray]) -> tuple[int, list[dict[str, Any]]]:
    """Copy arrays into sealed anonymous shared memory; return its descriptor and its contents.

    After sealing, neither process can change or shorten the memory, so a fault in one cannot reach
    the other through it.
    """
    contents = []
    end = 0
    for name, values in arrays.items():
        start = -(-end // _ALIGNMENT) * _ALIGNMENT
        end = start + values.nbytes
        contents.append(
            {"name": name, "start": start, "shape": values.shape, "dtype": values.dtype.str}
        )
    handle = os.memfd_create("avatar-model", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(handle, max(end, 1))
    with mmap.mmap(handle, max(end, 1)) as memory:
        for entry, values in zip(contents, arrays.values(), strict=True):
            _view(memory, entry)[...] = values
    fcntl.fcntl(handle, fcntl.F_ADD_SEALS, _SEALS)
    return handle, contents


def map_shared(handle: int, contents: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Map shared arrays, private to this process, with all pages present; close the descriptor."""
    try:
        # writable, but a private copy: jitted code compiled for ordinary arrays accepts it
        memory = mmap.mmap(handle, 0, mmap.MAP_PRIVATE, mmap.PROT_READ | mmap.PROT_WRITE)
    finally:
        os.close(handle)
    realtime.prefault(np.frombuffer(memory, dtype=np.uint8))
    return {entry["name"]: _view(memory, entry) for entry in contents}


def _view(memory: mmap.mmap, entry: dict[str, Any]) -> np.ndarray:
    return np.ndarray(tuple(entry["shape"]), entry["dtype"], memory, entry["start"])
