"""Results computed from the code under test, once for all tests that ask for them.

A result is found by a hash of its inputs: the arguments, the file of the computing function,
the core, Python and all installed packages. One worker computes a result; the others wait for it.
"""

from __future__ import annotations

import copy
import fcntl
import functools
import hashlib
import inspect
import os
import pickle
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numba.core.compiler_lock import global_compiler_lock

import avatar_core
from avatar_core.common.compiled_cache import ContentCache, content

P, T = ParamSpec("P"), TypeVar("T")

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "avatar" / "tests"
UNUSED = 14 * 86400.0  # unused results are removed after this time [s]
_CORE = Path(avatar_core.__file__).parent
_LATE_ROOMS = {"studies", "cli"}  # no stored result depends on them


def of_all(*values: Any) -> tuple[Any, ...]:
    """Return all arguments: the result depends on each of them."""
    return values


def cached_on_disk(compute: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function: keep its result, one object for all tests of a worker."""
    return in_memory(on_disk(compute))


def on_disk(
    compute: Callable[P, T], told: Callable[..., Any] = of_all, rooms: tuple[str, ...] | None = None
) -> Callable[P, T]:
    """Keep a function's result for all workers and runs; each call returns a new object.

    Parameters
    ----------
    told : callable
        Takes the arguments, returns the values that the result depends on.
    rooms : tuple of str, optional
        Rooms of the core that the result depends on; by default all but the last.
    """

    @functools.wraps(compute)
    def found(*arguments: P.args, **named: P.kwargs) -> T:
        source = Path(inspect.getfile(compute))
        key = digest(_environment(rooms), source, told(*arguments), sorted(named.items()))
        file = CACHE / f"{compute.__name__}-{key[:24]}.pickle"
        with locked(file.with_suffix(".lock")):
            if not file.is_file():
                _drop_unused()
                part = file.with_suffix(".part")
                part.write_bytes(pickle.dumps(compute(*arguments, **named), protocol=5))
                part.replace(file)
            os.utime(file)
        return pickle.loads(file.read_bytes())

    return found


def in_memory(
    compute: Callable[P, T], told: Callable[..., Any] = of_all, kept: int = sys.maxsize
) -> Callable[P, T]:
    """Keep a function's result in memory, one object for all tests of a worker.

    Parameters
    ----------
    told : callable
        Takes the arguments, returns the values that the result depends on.
    kept : int
        Number of results that are kept.
    """
    results: OrderedDict[str, T] = OrderedDict()

    @functools.wraps(compute)
    def found(*arguments: P.args, **named: P.kwargs) -> T:
        key = digest(told(*arguments), sorted(named.items()))
        if key not in results:
            results[key] = compute(*arguments, **named)
            if len(results) > kept:
                results.popitem(last=False)
        results.move_to_end(key)
        return results[key]

    return found


def copied(compute: Callable[P, T]) -> Callable[P, T]:
    """Wrap a function so that each call returns a copy of its result."""
    return lambda *arguments, **named: copy.deepcopy(compute(*arguments, **named))


def compiled_once(compile_function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Replace ``Dispatcher.compile``: wait for code that another worker is compiling."""

    def compile_locked(dispatcher: Any, signature: Any) -> Any:
        if not isinstance(dispatcher._cache, ContentCache):
            return compile_function(dispatcher, signature)
        function = dispatcher.py_func
        key = digest(content(), function.__module__, function.__qualname__, str(signature))
        with global_compiler_lock, locked(CACHE / f"compiled-{key[:24]}.lock"):
            return compile_function(dispatcher, signature)

    return compile_locked


def digest(*values: Any) -> str:
    """Hash arrays, files, numbers, texts and collections by their content."""
    total = hashlib.blake2b(digest_size=32)

    def take(value: Any) -> None:
        if isinstance(value, np.ndarray):
            total.update(f"{value.dtype} {value.shape} {value.flags.c_contiguous}".encode())
            total.update(np.ascontiguousarray(value))
        elif isinstance(value, Path):
            total.update(value.read_bytes())
        elif isinstance(value, np.generic):
            take(value.item())
        elif value is None or isinstance(value, (int, float, str)):
            total.update(f"{value!r} ".encode())
        elif isinstance(value, (tuple, list)):
            total.update(f"{len(value)} ".encode())
            for one in value:
                take(one)
        else:
            take([getattr(value, field.name) for field in fields(value)])

    take(values)
    return total.hexdigest()


@functools.cache
def _environment(rooms: tuple[str, ...] | None) -> str:
    """Hash of Python, all packages and some rooms of the core."""
    late = _LATE_ROOMS if rooms is None else _all_rooms() - {*rooms}
    files = [f for f in _CORE.rglob("*.py") if f.relative_to(_CORE).parts[0] not in late]
    packages = sorted((d.name, d.version) for d in distributions())
    return digest(sys.version, packages, sorted(files, key=lambda f: f.relative_to(_CORE).parts))


def _all_rooms() -> set[str]:
    return {path.name for path in _CORE.iterdir() if path.is_dir()}


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of a file against other processes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _drop_unused() -> None:
    for file in CACHE.iterdir():
        with suppress(FileNotFoundError):  # another worker has just renamed its part
            if file.stat().st_mtime < time.time() - UNUSED:
                file.unlink()
