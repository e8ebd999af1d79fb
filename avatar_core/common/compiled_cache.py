"""Compiled functions on disk, found by the content of everything that they may be made of.

numba's own cache looks at the file of a function alone. Code inlined from another file, or
constants read from it, may change without its notice: it then runs the old code. Here the folder's
name is the hash of all rooms from which compiled functions take code. A change anywhere in them is
a new folder. Each specialisation is a file of its own, because two processes that rewrite numba's
index at once can mix up their results.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile

_PACKAGE = Path(__file__).parents[1]
# Imports never run back (tests/core/test_rooms.py): compiled code comes from no later room.
ROOMS = [
    "common",
    "geometry",
    "fem",
    "reduction",
    "shapes",
    "vademecum",
    "tips",
    "contact",
    "haptics",
]
_KEPT = 8  # folders of other contents, for the versions that are in use side by side


@functools.cache
def content() -> str:
    """Return the hash of all sources that compiled functions may be made of."""
    found = hashlib.sha256()
    for room in ROOMS:
        for file in sorted((_PACKAGE / room).rglob("*.py")):
            found.update(file.relative_to(_PACKAGE).as_posix().encode() + file.read_bytes())
    return found.hexdigest()[:16]


@functools.cache
def folder() -> Path:
    """Return the folder of compiled functions: below NUMBA_CACHE_DIR, the user's cache, or here.

    Raises
    ------
    RuntimeError
        If none of these can be written.
    """
    for parent in _candidates():
        found = parent / content()
        try:
            _drop_old(parent)
            found.mkdir(parents=True, exist_ok=True)
            os.utime(found)
        except OSError:
            continue
        if os.access(found, os.W_OK):
            return found
    raise RuntimeError("compiled code cannot be kept: set NUMBA_CACHE_DIR to a writable folder")


def _candidates() -> Iterator[Path]:
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        yield Path(given) / "avatar"
    user = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(user):
        yield Path(user) / "avatar" / "compiled"
    yield _PACKAGE / "__pycache__"


def _drop_old(parent: Path) -> None:
    """Remove the least recently used folders before another is made."""
    if not parent.is_dir() or (parent / content()).is_dir():
        return
    others = [path for path in parent.iterdir() if path.is_dir() and len(path.name) == 16]
    for path in sorted(others, key=lambda path: path.stat().st_mtime)[:-_KEPT]:
        shutil.rmtree(path, ignore_errors=True)


class _Locator:
    """Locator that tells numba the folder; freshness is in the folder's name."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file, self._line = file, function.__code__.co_firstlineno
        # Files outside those rooms, e.g. benchmarks, add their own content.
        own = hashlib.sha256(Path(file).read_bytes()).hexdigest()[:8]
        self._path = str(folder() / f"{Path(file).stem}-{own}")

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator | None:
        return cls(function, file) if os.path.exists(file) else None

    def ensure_cache_path(self) -> None:
        os.makedirs(self._path, exist_ok=True)

    def get_cache_path(self) -> str:
        return self._path

    def get_source_stamp(self) -> str:
        return content()

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Implementation(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012, numba's name for it


class _OneFileEach(IndexDataCacheFile):
    """Index that derives file names of specialisations from their types, so needs no index file."""

    def save(self, key: Any, data: Any) -> None:
        self._save_data(self._name_of(key), data)

    def load(self, key: Any) -> Any:
        try:
            return self._load_data(self._name_of(key))
        except OSError:  # not compiled yet
            return None

    def _name_of(self, key: Any) -> str:
        return self._data_name_pattern.format(
            number=int(hashlib.sha256(repr(key).encode()).hexdigest()[:16], 16)
        )


class ContentCache(FunctionCache):
    """Cache of one function, put in the place of a dispatcher's own."""

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _OneFileEach(
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )
