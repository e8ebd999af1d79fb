"""Services of the operating system for a real-time loop: priority, core, memory, clock."""

from __future__ import annotations

import ctypes
import ctypes.util
import gc
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Calls through ctypes release Python's global lock, so other threads run while one sleeps here.
_libc = ctypes.CDLL(ctypes.util.find_library("c") or "libc.so.6", use_errno=True)

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_MADV_POPULATE_READ = 22
_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15
_PR_SET_TIMERSLACK = 29
_THREAD_SWITCH_INTERVAL = 1e-4  # longest wait of the loop for the global lock [s]


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


@dataclass(frozen=True)
class Privileges:
    """Granted privileges, and for each refused one a line that says how to get it.

    Attributes
    ----------
    priority : int
        SCHED_FIFO priority, 0 without.
    cpu : int
        Core the loop is bound to, -1 for any.
    memory_locked : bool
        Whether pages of the process stay in memory.
    """

    priority: int
    cpu: int
    memory_locked: bool
    refusals: tuple[str, ...] = ()


def claim(priority: int, cpu: int = -1, lock_memory: bool = True) -> Privileges:
    """Take SCHED_FIFO for every thread of this process, and lock its memory.

    A thread of lower priority may hold Python's global lock or carry the middleware's messages. It
    would delay the loop, so all threads get the priority. ``cpu`` is checked here and taken by
    ``bind_thread``. Priority 0 asks for nothing and is granted.
    """
    refusals: list[str] = []
    granted = 0
    locked = False
    if priority > 0:
        try:
            for thread in _threads():
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
            granted = priority
        except PermissionError:
            refusals.append(
                f"SCHED_FIFO {priority} not permitted, the loop shares the processor with"
                " everything else: run as root, or add 'USER - rtprio 98' to"
                " /etc/security/limits.conf, or give the container CAP_SYS_NICE"
            )
        if lock_memory:
            if _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0:
                locked = True
            else:
                refusals.append(
                    f"memory not locked ({os.strerror(ctypes.get_errno())}): raise 'memlock' in"
                    " /etc/security/limits.conf, or set realtime.lock_memory to false"
                )
    available = os.sched_getaffinity(0)
    if cpu >= 0 and cpu not in available:
        refusals.append(f"no core {cpu} here, the loop runs on any: choose of {sorted(available)}")
        cpu = -1
    return Privileges(granted, cpu, locked, tuple(refusals))


def bind_thread(cpu: int) -> None:
    """Bind the calling thread to one core (-1: leave it) and let its timers fire on time."""
    if cpu >= 0:
        os.sched_setaffinity(0, {cpu})
    _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # otherwise 50 us are added without SCHED_FIFO


def name_thread(name: str) -> None:
    """Name the calling thread for tools such as ``top -H``, in at most 15 bytes.

    Python before 3.14 does not pass its thread names on to the system.
    """
    _libc.prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)


def release() -> None:
    """Return to ordinary scheduling at low priority; for a process started by a real-time one."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    os.nice(10)


def tune_interpreter() -> None:
    """Disable automatic garbage collection, and shorten the switch interval of the global lock.

    The caller must call ``gc.collect()`` from time to time outside the loop. Objects that exist now
    are frozen and never examined again, so that collection takes well below a millisecond.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(_THREAD_SWITCH_INTERVAL)


def sleep_until(deadline: int) -> None:
    """Sleep until ``time.monotonic_ns()`` reaches ``deadline`` [ns]. Real-time safe."""
    when = _Timespec(deadline // 1_000_000_000, deadline % 1_000_000_000)
    while _libc.clock_nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(when), None) != 0:
        pass  # interrupted by a signal


def prefault(pages: np.ndarray) -> None:
    """Map every page of ``pages`` now, without holding the global lock, not at first use."""
    page = os.sysconf("SC_PAGESIZE")
    start = pages.ctypes.data // page * page
    length = ctypes.c_size_t(pages.ctypes.data + pages.nbytes - start)
    if _libc.madvise(ctypes.c_void_p(start), length, _MADV_POPULATE_READ) != 0:
        pages.view(np.uint8)[::page].max()  # kernels before 5.14


def die_with_parent(signal_number: int) -> None:
    """Make the kernel send this process a signal when the thread that started it ends."""
    _libc.prctl(_PR_SET_PDEATHSIG, int(signal_number), 0, 0, 0)


def _threads() -> list[int]:
    return [int(task.name) for task in Path("/proc/self/task").iterdir()]
