"""Finished anatomies of an unfinished build, one file each, in a folder beside the atlas."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from avatar_core.atlas.anatomy import Anatomy, AtlasError
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.storage import load_anatomy, load_atlas, save_anatomy, save_atlas
from avatar_core.errors import StorageError

EMPTY = "empty-"  # prefix of files that hold an atlas without members


@dataclass(frozen=True)
class Checkpoint:
    """The folder ``ATLAS.h5.parts``; the key of an anatomy is a hash of its inputs."""

    folder: Path

    def load(self, key: str | None) -> Anatomy | None:
        """An anatomy; None if there is none, or its file cannot be read."""
        with suppress(StorageError):
            return load_anatomy(self._file(key)) if key and self._file(key).exists() else None
        return None

    def save(self, key: str | None, anatomy: Anatomy) -> None:
        """Save an anatomy, if it has a key."""
        if key:
            save_anatomy(anatomy, self._file(key))

    def load_empty(self, key: str) -> Atlas | None:
        """The atlas without members that the build began with; None if there is none."""
        with suppress(StorageError):
            return load_atlas(self._file(EMPTY + key))
        return None

    def save_empty(self, key: str, atlas: Atlas) -> None:
        """Save the atlas without members: meshing its template again would give another mesh."""
        save_atlas(atlas, self._file(EMPTY + key))

    def clear(self, keys: Iterable[str | None] | None = None) -> None:
        """Remove some anatomies, or everything."""
        chosen = self.folder.iterdir() if keys is None else (self._file(k) for k in keys if k)
        for file in list(chosen):
            file.unlink(missing_ok=True)

    def _file(self, key: str | None) -> Path:
        return self.folder / f"{key}.h5"


@contextmanager
def checkpoint_of(path: Path) -> Iterator[Checkpoint]:
    """The checkpoint of the atlas at a path, locked for one build; removed afterwards if empty.

    Raises AtlasError if another build holds it, StorageError if the folder cannot be made.
    """
    folder = path.with_name(f"{path.name}.parts")
    try:
        folder.mkdir(exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise StorageError(
            f"cannot make {folder} ({error.strerror}); create its folder first, or choose another"
        ) from error
    try:
        _lock(handle, path)
        try:
            yield Checkpoint(folder)
        finally:
            _tidy(folder)
    finally:
        os.close(handle)


def _tidy(folder: Path) -> None:
    """Remove the folder unless it holds anatomies; files with a dot are left by killed writes."""
    rest = list(folder.iterdir())
    if all(file.name.startswith((EMPTY, ".")) for file in rest):
        for file in rest:
            file.unlink(missing_ok=True)
        folder.rmdir()


def _lock(handle: int, path: Path) -> None:
    """Lock the folder until the handle is closed, by the system if the process is killed."""
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise AtlasError(
            f"another build is at work on {path}; wait until it has finished"
        ) from error
