"""Independent pieces of work on this machine's cores or on a Dask cluster.

Results come as they are ready. A piece whose process dies is told apart from the others, which are
done all the same.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from avatar_core.atlas.anatomy import AtlasError
from avatar_core.common.processes import thread_limits

Item = TypeVar("Item")
Result = TypeVar("Result")

CONNECT_SECONDS = 10  # for a scheduler to answer


@dataclass(frozen=True)
class Workers:
    """Who does the work.

    jobs : processes on this machine, None for one a CPU; 1 works in this process
    scheduler : address of a Dask scheduler whose workers do it instead; they need avatar too

    Raises AtlasError if there are no jobs.
    """

    jobs: int | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.jobs is not None and self.jobs < 1:
            raise AtlasError(f"{self.jobs} jobs asked for; choose --jobs 1 or more")

    def map(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Exception]]:
        """Number and result of each item, or the error with which its process ended.

        function, items : picklable, unless there is one job

        Raises AtlasError if the cluster is not there.
        """
        numbered = dict(enumerate(items))
        jobs = min(self.jobs or len(os.sched_getaffinity(0)), len(items))
        if self.scheduler is not None:
            return _on_cluster(function, numbered, self.scheduler)
        if jobs > 1:
            return _in_processes(function, numbered, jobs)
        return ((number, function(item)) for number, item in numbered.items())


# --- this machine -----------------------------------------------------------------------------


def _in_processes(
    function: Callable[[Item], Result], items: dict[int, Item], jobs: int
) -> Iterator[tuple[int, Result | Exception]]:
    """In a pool; when a process dies the whole pool does, so what is left gets one pool each."""
    left = dict(items)
    for number, result in _in_pool(function, items, jobs):
        del left[number]
        yield number, result
    for number, item in left.items():
        died = RuntimeError("its process died, perhaps for want of memory; try fewer --jobs")
        yield next(_in_pool(function, {number: item}, 1), (number, died))


def _in_pool(
    function: Callable[[Item], Result], items: Mapping[int, Item], jobs: int
) -> Iterator[tuple[int, Result | Exception]]:
    """Results until one of the processes dies."""
    spawn = multiprocessing.get_context("spawn")  # forked, the threads of libraries would hang
    with (
        _one_thread_each(),
        ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_start_worker) as pool,
    ):
        futures = {pool.submit(function, item): number for number, item in items.items()}
        try:
            for future in as_completed(futures):
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    return
                if isinstance(error, Exception):
                    yield futures[future], error
                else:
                    yield futures[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _start_worker() -> None:
    """Die silently when interrupted, and with the parent, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started meanwhile use one thread: cores are shared among them already."""
    limits = thread_limits()
    before = {name: os.environ.get(name) for name in limits}
    os.environ.update(limits)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


# --- a cluster --------------------------------------------------------------------------------


def _on_cluster(
    function: Callable[[Item], Result], items: Mapping[int, Item], address: str
) -> Iterator[tuple[int, Result | Exception]]:
    client, completed = _connected(address)
    with client:
        shared = client.scatter(function)
        futures = {
            client.submit(_call, shared, item, pure=False): number for number, item in items.items()
        }
        for future in completed(list(futures)):
            error = future.exception()
            yield futures[future], future.result() if error is None else error


def _call(function: Callable[[Item], Result], item: Item) -> Result:
    return function(item)


def _connected(address: str) -> tuple[Any, Any]:
    """A client of the scheduler, and what waits for its results."""
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError as error:
        raise AtlasError(
            f"--scheduler needs Dask ({error}); install it by: pip install 'avatar[cluster]'"
        ) from error
    try:
        return Client(address, timeout=CONNECT_SECONDS), completed
    except (OSError, ValueError) as error:
        raise AtlasError(
            f"no Dask scheduler answers at {address} ({type(error).__name__}); start one by 'dask "
            "scheduler', or leave out --scheduler to use this machine"
        ) from error
