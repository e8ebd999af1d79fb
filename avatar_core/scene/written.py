"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avatar_core.errors import StorageError, one_line


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A file to write in the place of another, which it takes on leaving without an error.

    Raises
    ------
    StorageError
        For a missing folder or a full disk; nothing is left behind.
    """
    if not path.parent.is_dir():
        raise StorageError(f"folder {path.parent} does not exist; create it first")
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            whole = Path(folder) / path.name
            yield whole
            os.replace(whole, path)
    except OSError as error:
        raise StorageError(
            f"cannot write {path} ({one_line(error, 120)}); "
            "free disk space or choose another folder"
        ) from error
