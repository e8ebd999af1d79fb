"""What tests compute from the code under test, computed once for all workers and runs.

A result is found by the content of everything that it may follow from: the core, the file of the
function that computes it, its arguments, Python and all installed packages.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import inspect
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import distributions
from pathlib import Path
from typing import ParamSpec, TypeVar

import avatar_core

P, T = ParamSpec("P"), TypeVar("T")

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "avatar" / "tests"
UNUSED = 14 * 86400.0  # after which a result is removed [s]
_LATE_ROOMS = ("studies", "cli")  # nothing that is stored comes from them


def cached_on_disk(compute: Callable[P, T]) -> Callable[P, T]:
    """Decorator: keep what a function gives; its arguments tell themselves by ``repr``, files
    by their content. It is the same object for all tests of a worker."""
    return functools.cache(disk_copy(compute))


def disk_copy(compute: Callable[P, T], rooms: tuple[str, ...] | None = None) -> Callable[P, T]:
    """The same, each time as another object.

    rooms : of the core, which the result may follow from; by default all but the last
    """

    @functools.wraps(compute)
    def found(*arguments: P.args, **named: P.kwargs) -> T:
        key = hashlib.sha256(_of_all(rooms).encode())
        key.update(Path(inspect.getfile(compute)).read_bytes() + compute.__name__.encode())
        for value in (*arguments, *sorted(named.items())):
            text = repr(value)
            assert "..." not in text and " at 0x" not in text, "give what tells itself by repr"
            key.update(value.read_bytes() if isinstance(value, Path) else text.encode())
        file = CACHE / f"{compute.__name__}-{key.hexdigest()[:24]}.pickle"
        CACHE.mkdir(parents=True, exist_ok=True)
        with _locked(file.with_suffix(".lock")):
            if not file.is_file():
                _drop_unused()
                part = file.with_suffix(".part")
                part.write_bytes(pickle.dumps(compute(*arguments, **named), protocol=5))
                part.replace(file)
            os.utime(file)
        return pickle.loads(file.read_bytes())

    return found


@functools.cache
def _of_all(rooms: tuple[str, ...] | None) -> str:
    """Hash of what every result may follow from, where it is made in some rooms of the core."""
    found = hashlib.sha256(sys.version.encode())
    found.update(repr(sorted((d.name, d.version) for d in distributions())).encode())
    core = Path(avatar_core.__file__).parent
    late = _LATE_ROOMS if rooms is None else _rooms(core) - {*rooms}
    files = [f for f in core.rglob("*.py") if f.relative_to(core).parts[0] not in late]
    for file in sorted(files, key=lambda f: f.relative_to(core).as_posix()):
        found.update(file.read_bytes())
    return found.hexdigest()


def _rooms(core: Path) -> set[str]:
    return {path.name for path in core.iterdir() if path.is_dir()}


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _drop_unused() -> None:
    for file in CACHE.iterdir():
        with suppress(FileNotFoundError):  # another worker has just finished its part
            if file.stat().st_mtime < time.time() - UNUSED:
                file.unlink()
