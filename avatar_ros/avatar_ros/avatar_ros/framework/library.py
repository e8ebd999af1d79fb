"""The only directory that names from the network can reach.

A name in a request is a path inside ``library_dir`` and must lead to a regular file there, also
through links. The file is checked again after opening, so that a change of the library in between
cannot lead outside.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from avatar_core.common.files import FileError, content_of, opened
from avatar_core.errors import AvatarError

LONGEST_NAME = 200  # longest file name, with room for the suffix of a temporary file [bytes]
LONGEST_PATH = 1000  # longest path [characters]


class RefusedError(AvatarError):
    """A request that this node does not serve."""


def find_in_library(name: str, library_dir: str, max_bytes: int) -> Path:
    """Return the path of the file ``name`` in the library, to be opened.

    Raises
    ------
    RefusedError
        If it lies outside, is no regular file, is missing or too large.
    """
    with _opened(name, library_dir, max_bytes) as (_, path):
        return path


def read_in_library(name: str, library_dir: str, max_bytes: int) -> bytes:
    """Return the content of the file ``name``; RefusedError as :func:`find_in_library`."""
    with _opened(name, library_dir, max_bytes) as (source, _):
        try:
            return content_of(source)
        except FileError as error:
            raise RefusedError(f"{name}: {error}; load it when it is complete") from error


def file_name(name: str) -> str:
    """Check the name of a file in library_dir itself; return it with the suffix .h5.

    Raises
    ------
    RefusedError
        For a path, a hidden or an overlong name.
    """
    if "/" in name or name.startswith(".") or not name.isprintable():
        raise RefusedError(
            f"name {name[:LONGEST_NAME]!r}: give a plain file name, no path and no leading dot"
        )
    if len(name.encode()) > LONGEST_NAME:
        raise RefusedError(f"name: longer than {LONGEST_NAME} bytes; give a shorter one")
    return name if name.endswith(".h5") else f"{name}.h5"


@contextmanager
def _opened(name: str, library_dir: str, max_bytes: int) -> Iterator[tuple[BinaryIO, Path]]:
    _require_plain(name)
    library = Path(library_dir).resolve()
    try:
        path = (library / name).resolve(strict=True)
    except (OSError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "links to itself"
        raise RefusedError(f"{name}: {reason}; the library is {library}") from error
    if not path.is_relative_to(library):
        raise RefusedError(f"{name}: a link out of library_dir; copy the file into {library}")
    try:
        with opened(path, max_bytes) as source:
            if not Path(os.readlink(f"/proc/self/fd/{source.fileno()}")).is_relative_to(library):
                raise RefusedError(f"{name}: led out of library_dir while it was opened")
            yield source, path
    except FileError as error:
        remedy = "; raise max_megabytes to read it" if "MB" in str(error) else ""
        raise RefusedError(f"{name}: {error}{remedy}") from error


def _require_plain(name: str) -> None:
    """Raise RefusedError unless a name is a printable path downwards."""
    if not name:
        raise RefusedError("no file name: give one in library_dir")
    if not name.isprintable() or len(name) > LONGEST_PATH:
        raise RefusedError(f"file name: give at most {LONGEST_PATH} letters, all of them printable")
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise RefusedError(f"{name}: give a path inside library_dir, not absolute and without ..")
