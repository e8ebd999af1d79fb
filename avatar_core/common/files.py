"""Opening files of others: once, ordinary ones only, and no larger than said.

What a name stands for may change between a look and an opening; so the file is looked at again when
it is open, which waits for nobody.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from avatar_core.errors import AvatarError


class FileError(AvatarError):
    """What a name stands for is no file that may be read; the message begins after its name."""


@contextmanager
def opened(path: Path, max_bytes: int) -> Iterator[BinaryIO]:
    """An ordinary file, open for reading.

    Raises
    ------
    FileError
        No such file, no permission, a directory, device or pipe, or more than ``max_bytes``.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # some devices act when they are opened
            raise FileError("not a file")
        # Not to wait until somebody writes into a pipe that took its place.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except (OSError, ValueError) as error:
        raise FileError(_reason(error)) from error
    with os.fdopen(descriptor, "rb") as source:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise FileError("not a file")
        if status.st_size > max_bytes:
            raise FileError(f"{status.st_size / 1e6:.0f} MB, more than {max_bytes / 1e6:.0f}")
        yield source


def content_of(source: BinaryIO) -> bytes:
    """The bytes of an open file; FileError if it grows meanwhile."""
    size = os.fstat(source.fileno()).st_size
    try:
        content = source.read(size + 1)  # so much is allocated
    except OSError as error:
        raise FileError(_reason(error)) from error
    if len(content) > size:
        raise FileError("it grows while it is read")
    return content


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else str(error)) or type(error).__name__
