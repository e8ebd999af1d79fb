"""Threads of the numerical libraries, here and in modules that run as processes of their own."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
T = TypeVar("T")
Item = TypeVar("Item")

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # parameters of mallopt(3)
_LARGE = 1 << 20  # size of a large array [byte]
_ARENAS = 2
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMBA", "RAYON", "IGL")


def thread_limits(n_threads: int = 1) -> dict[str, str]:
    """Return the environment variables that limit the threads of each numerical library."""
    return {f"{library}_NUM_THREADS": str(n_threads) for library in _LIBRARIES}


def cpu_seconds() -> float:
    """Return user + system time of this process so far, and of its children that have ended [s]."""
    return sum(os.times()[:4])


def n_cores() -> int:
    """Return the cores that this process may use, at most those that ``OMP_NUM_THREADS`` allows."""
    cores, allowed = len(os.sched_getaffinity(0)), os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, int(allowed)) if allowed.isdigit() and int(allowed) > 0 else cores


def on_all_cores(function: Callable[[Item], T], items: Iterable[Item]) -> Iterator[T]:
    """Yield the function of each item, in their order, in one thread for each core.

    The function should spend its time outside the interpreter, and give the same bits whatever runs
    beside it. Items that have not begun are dropped when the caller stops.
    """
    with ThreadPoolExecutor(n_cores()) as pool:
        yield from pool.map(function, items)


def return_memory() -> None:
    """Give freed memory of this process back to the system, where its C library can (glibc)."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def free_at_once() -> None:
    """Return freed arrays to the system at once from now on (glibc).

    Otherwise, each large freed array raises the size, up to 32 MB, below which later arrays stay
    with the process. A process that replays recordings of 27 MB kept 30 to 60 MB more. Each thread
    also frees into an arena of its own, of which there are eight for each core.
    """
    with contextlib.suppress(AttributeError, OSError):
        for option, value in ((_M_MMAP_THRESHOLD, _LARGE), (_M_ARENA_MAX, _ARENAS)):
            ctypes.CDLL(None).mallopt(option, value)


def repeatable(function: Callable[P, T]) -> Callable[P, T]:
    """Make a function repeatable: the same arguments give the same bits, on any number of cores.

    On two threads BLAS adds in another order than on one. Modes of almost equal energy then come
    out mixed: the same accuracy from other numbers. One thread costs less processor time (22 s for
    28 s, 700 vertices).
    """

    @functools.wraps(function)
    def on_one_thread(*arguments: P.args, **named: P.kwargs) -> T:
        with threadpool_limits(1, user_api="blas"):
            return function(*arguments, **named)

    return on_one_thread


class ModuleProcess(subprocess.Popen[Any]):
    """Process ``python -m MODULE ARGUMENTS`` with one thread per numerical library by default.

    It runs in its own session: Ctrl-C reaches only its starter, which then ends it. Its directory
    is ``/``, because ``-m`` prefers modules in the current directory to installed ones.

    Parameters
    ----------
    environment : Mapping[str, str] or None
        Environment variables; None for those of this process.
    options
        Options of ``subprocess.Popen``.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        n_threads: int = 1,
        environment: Mapping[str, str] | None = None,
        **options: Any,
    ) -> None:
        inherited = os.environ if environment is None else environment
        super().__init__(
            [sys.executable, "-m", module, *arguments],
            cwd="/",
            env={**inherited, **thread_limits(n_threads)},
            **({"start_new_session": True} | options),
        )

    def finish(self, seconds: float, number: int = signal.SIGTERM) -> int:
        """Send a signal, kill the process if it does not end in time, and return its exit code."""
        self.send_signal(number)  # does nothing to a process that has ended
        try:
            return self.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
            return self.wait()
