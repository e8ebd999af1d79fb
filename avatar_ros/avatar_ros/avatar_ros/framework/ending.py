"""Forced end of a process whose middleware does not let it end.

Fast DDS 2 waits for its callbacks before it removes a participant. Built with GCC 9 or before, as
in the wheels, it can wait forever. That happens if a callback is running just then, e.g. because
another process joins (Fast DDS, issue 6513). It spins with the interpreter's lock held, so no
Python code could end the process.
"""

from __future__ import annotations

import ctypes
import sys

_SIGEV_THREAD = 2  # <bits/sigevent-consts.h>
_CLOCK_MONOTONIC = 1


class _Event(ctypes.Structure):
    """``struct sigevent``, whose thread calls ``function(value)``."""

    _fields_ = [
        ("value", ctypes.c_size_t),
        ("number", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("rest", ctypes.c_char * 32),
    ]


class _Timer(ctypes.Structure):
    """``struct itimerspec``."""

    _fields_ = [(name, ctypes.c_long) for name in ("again", "again_ns", "first", "first_ns")]


def end_within(seconds: float, code: int) -> None:
    """End this process with an exit code after some seconds, unless it has ended by then.

    Output is flushed now; nothing is cleaned up at the end. The timer is the C library's.
    """
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    library = ctypes.CDLL(None)
    leave = ctypes.cast(library._exit, ctypes.c_void_p)
    event = _Event(value=code, notify=_SIGEV_THREAD, function=leave)
    timer = ctypes.c_void_p()
    if library.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
        whole = int(seconds)
        times = _Timer(first=whole, first_ns=int(1e9 * (seconds - whole)))
        library.timer_settime(timer, 0, ctypes.byref(times), None)
