"""HDF5 files that appear complete or not at all, and tell whether they were altered since."""

from __future__ import annotations

import hashlib
import io
import os
import tempfile
from pathlib import Path

import h5py
import numpy as np

from avatar_core.errors import StorageError


def replace_file(path: Path, arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> None:
    """Put arrays and attributes, with their checksum, in the place of a file in one step.

    Raises
    ------
    StorageError
        If the folder does not exist or the disk is full; what was at the path is then unharmed.
    """
    if not path.parent.is_dir():
        raise StorageError(f"folder {path.parent} does not exist; create it first")
    content = encoded(arrays, attributes)
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise StorageError(
            f"cannot write {path} ({reason(error)}); free disk space or choose another folder"
        ) from error


def encoded(arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> memoryview:
    """The HDF5 file in memory: on a full disk, HDF5 itself would crash."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for key, value in attributes.items():
            file.attrs[key] = value
        for key, array in arrays.items():
            file.create_dataset(key, data=array)
        file.attrs["checksum"] = checksum(arrays, attributes)
    return content.getbuffer()


def checksum(arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> str:
    """SHA-256 of names, types, shapes and values."""
    digest = hashlib.sha256()
    for key in sorted(attributes):
        digest.update(f"{key}={attributes[key]};".encode())
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        digest.update(f"{key}:{array.dtype.str}:{array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def within(index: np.ndarray, limit: int) -> bool:
    """Whether all indices lie in 0 ... limit - 1."""
    return index.size == 0 or (int(index.min()) >= 0 and int(index.max()) < limit)


def reason(error: BaseException) -> str:
    """What an error says, in one short line."""
    return " ".join(str(error).split())[:120] or type(error).__name__
