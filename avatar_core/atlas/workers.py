"""Independent tasks on this machine's cores or on a Dask cluster.

Results arrive in the order in which they are ready. A task whose process dies yields an error; the
other tasks are still done. With concurrent.futures, as with joblib, a process that dies breaks its
whole pool. Unfinished tasks then get a pool each.
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
    """Place where tasks run.

    Raises AtlasError if there are no jobs.

    Attributes
    ----------
    jobs : int or None
        Processes on this machine; None for one per CPU, 1 for this process.
    scheduler : str or None
        Address of a Dask scheduler whose workers run the tasks instead; the workers need avatar,
        too.

    Examples
    --------
    >>> dict(av.Workers(jobs=1).map(abs, [-1, -2]))
    {0: 1, 1: 2}
    """

    jobs: int | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.jobs is not None and self.jobs < 1:
            raise AtlasError(f"{self.jobs} jobs asked for; choose --jobs 1 or more")

    def map(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Exception]]:
        """Yield the number of each item with its result, or with the error that ended it.

        Raises AtlasError if no scheduler answers.

        Parameters
        ----------
        function, items
            Function of one item, and the items; picklable, unless there is one job.
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
    """Run items in one pool; once a process has died, each unfinished item gets its own pool."""
    left = dict(items)
    for number, result in _in_pool(function, items, jobs):
        del left[number]
        yield number, result
    for number, item in left.items():
        died = RuntimeError("its process died, perhaps out of memory; try fewer --jobs")
        yield next(_in_pool(function, {number: item}, 1), (number, died))


def _in_pool(
    function: Callable[[Item], Result], items: Mapping[int, Item], jobs: int
) -> Iterator[tuple[int, Result | Exception]]:
    """Yield the results, until a process dies."""
    spawn = multiprocessing.get_context("spawn")  # threads of numerical libraries hang when forked
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
                yield futures[future], error if isinstance(error, Exception) else future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _start_worker() -> None:
    """End without a traceback on Ctrl-C, and end with the parent even if that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Limit processes that start in the body to one thread each: there is one per core."""
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
        # a result, not scattered data, which would be lost with the workers that hold it
        shared = client.submit(_itself, function, pure=False)
        futures = {
            client.submit(_call, shared, item, pure=False): number for number, item in items.items()
        }
        for future in completed(list(futures)):
            error = future.exception()
            yield futures[future], future.result() if error is None else error


def _itself(function: Callable[[Item], Result]) -> Callable[[Item], Result]:
    return function


def _call(function: Callable[[Item], Result], item: Item) -> Result:
    return function(item)


def _connected(address: str) -> tuple[Any, Any]:
    """Return a client of the scheduler, and the as_completed that goes with it."""
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError as error:
        raise AtlasError(
            f"--scheduler needs Dask ({error}); install it by: pip install '.[cluster]'"
        ) from error
    try:
        return Client(address, timeout=CONNECT_SECONDS), completed
    except (OSError, ValueError) as error:
        raise AtlasError(
            f"no Dask scheduler answers at {address} ({type(error).__name__}); start one by 'dask "
            "scheduler', or leave out --scheduler to use this machine"
        ) from error
