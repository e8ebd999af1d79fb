"""Opening of regular files of unknown origin and limited size; writing and finding our own.

A path may name something else between the check and the opening, so the open descriptor is checked
again; opening never blocks.
"""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from avatar_core.errors import AvatarError, StorageError, one_line


class FileError(AvatarError):
    """A path does not name a readable regular file; the message completes "PATH ..."."""


@contextmanager
def opened(path: Path, max_bytes: int) -> Iterator[BinaryIO]:
    """Open a regular file for reading.

    Raises
    ------
    FileError
        If the file is missing, forbidden, a directory, device or pipe, or larger than
        ``max_bytes``.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # opening a device may act on it
            raise FileError("not a file")
        # O_NONBLOCK: do not wait for a writer if a pipe has taken the file's place.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except (OSError, ValueError) as error:
        raise FileError(_reason(error)) from error
    with os.fdopen(descriptor, "rb") as source:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise FileError("not a file")
        if status.st_size > max_bytes:
            raise FileError(f"{status.st_size / 1e6:.6g} MB, more than {max_bytes / 1e6:.6g}")
        yield source


def content_of(source: BinaryIO) -> bytes:
    """Return the bytes of an open file; FileError if it grows during reading."""
    size = os.fstat(source.fileno()).st_size
    try:
        content = source.read(size + 1)  # allocates no more than this
    except OSError as error:
        raise FileError(_reason(error)) from error
    if len(content) > size:
        raise FileError("it grows while it is read")
    return content


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a file to write, which replaces another file on leaving without an error.

    Raises
    ------
    StorageError
        For a missing folder or a full disk; nothing is left behind.
    """
    if not path.parent.is_dir():
        raise StorageError(f"folder {path.parent} does not exist; create it first")
    whole = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        yield whole
        with whole.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(whole, path)
    except OSError as error:
        raise StorageError(
            f"cannot write {path} ({one_line(error, 120)}); "
            "free disk space or choose another folder"
        ) from error
    finally:
        with suppress(OSError):
            whole.unlink(missing_ok=True)


def shipped(name: str) -> Path | None:
    """Return the path of a file or folder of ``params``; None if it is not installed.

    It lies in ``params`` of a checkout, or in ``share/avatar_params`` below a prefix. The prefix is
    that of this package, or one of AMENT_PREFIX_PATH, since colcon has a prefix for each package.
    """
    here = Path(__file__)
    ament = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    prefixes = [*here.parents, *(Path(prefix) for prefix in ament if prefix)]
    checkout = here.resolve().parents[2] / "params"
    for found in (checkout, *(prefix / "share" / "avatar_params" for prefix in prefixes)):
        if (found / name).exists():
            return found / name
    return None


def shipped_files(folder: str) -> dict[str, Path]:
    """Return the YAML files in a folder of ``params``, by name without suffix; sorted."""
    found = shipped(folder)
    return {path.stem: path for path in sorted(found.glob("*.yaml"))} if found else {}


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else str(error)) or type(error).__name__
