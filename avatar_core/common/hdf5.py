"""The only module that opens HDF5 files: written complete or not at all, verified when read.

No link that leaves a file is followed. The claimed size of the arrays is compared with the size of
the file before they are read. The HDF5 library itself may still crash or hang on damaged files.
Files of others are therefore read in a separate process, :mod:`avatar_core.common.confined`.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import BinaryIO

import h5py
import numpy as np

from avatar_core.common.files import FileError, opened, replaced
from avatar_core.errors import StorageError, one_line

Arrays = dict[str, np.ndarray]
Attributes = dict[str, str]

# Errors that h5py raises for damaged files.
UNREADABLE = (OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError, ArithmeticError)


MAX_EXPANSION = 8  # arrays over file size, so that a small file cannot fill the memory
_PACKED_FROM = 1 << 16  # bytes of an array from which it is compressed, without loss
_PACKING = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


def replace_file(
    path: Path, arrays: dict[str, np.ndarray], attributes: dict[str, str], packed: bool = False
) -> None:
    """Write arrays and attributes with their checksum, replacing a file atomically.

    Parameters
    ----------
    packed : bool
        Compress large arrays, without loss. Not for almost constant arrays: claims above
        ``MAX_EXPANSION`` times the file's size are refused.

    Raises
    ------
    StorageError
        If the folder does not exist or the disk is full; the old file is then unchanged.
    """
    content = encoded(arrays, attributes, packed)
    with replaced(path) as whole:
        whole.write_bytes(content)


def encoded(
    arrays: dict[str, np.ndarray], attributes: dict[str, str], packed: bool = False
) -> memoryview:
    """Return the HDF5 file in memory: on a full disk, HDF5 itself would crash."""
    content = io.BytesIO()
    # the latest layout keeps an array of one chunk without an index, in which damage would hide
    with h5py.File(content, "w", libver="latest") as file:
        for key, value in attributes.items():
            file.attrs[key] = value
        for key, array in arrays.items():
            large = packed and array.nbytes > _PACKED_FROM
            how = {**_PACKING, "chunks": array.shape} if large else {}
            file.create_dataset(key, data=array, **how)
        file.attrs["checksum"] = checksum(arrays, attributes)
    return content.getbuffer()


def checksum(arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> str:
    """Return SHA-256 of names, types, shapes and values."""
    digest = hashlib.sha256()
    for key in sorted(attributes):
        digest.update(f"{key}={attributes[key]};".encode())
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        digest.update(f"{key}:{array.dtype.str}:{array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def verified(
    source: BinaryIO,
    origin: str,
    what: str,
    attributes_of: Callable[[Attributes, str], Attributes],
    keys_of: Callable[[Collection[str]], Iterable[str]],
    remedy: str = "build or copy it again",
) -> tuple[Attributes, Arrays]:
    """Return attributes and arrays of a file, checked by its checksum.

    Parameters
    ----------
    source : BinaryIO
        The file.
    origin, what : str
        Name and kind of the file in messages.
    attributes_of : Callable[[Attributes, str], Attributes]
        Function that selects the attributes to verify; raises StorageError.
    keys_of : Callable[[Collection[str]], Iterable[str]]
        Function that selects the arrays to read.
    remedy : str
        Advice in messages.

    Raises
    ------
    StorageError
        For a truncated, altered or foreign file.
    """
    try:
        size = source.seek(0, os.SEEK_END)
        with h5py.File(source, "r") as file:
            held = root_attributes(file)
            attributes = attributes_of(held, origin)
            arrays = _arrays(file, keys_of, size)
            stated = held["checksum"]
    except StorageError:
        raise
    except UNREADABLE as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else one_line(error, 120)
        raise StorageError(
            f"{origin} is no readable {what} ({why}); it may be truncated: {remedy}"
        ) from error
    if stated != checksum(arrays, attributes):
        raise StorageError(f"{origin} was altered or damaged (checksum); {remedy}")
    return attributes, arrays


def format_of(path: Path, max_bytes: int) -> str | None:
    """Return the attribute ``format`` of an HDF5 file, None for other files; reads nothing else."""
    try:
        with opened(path, max_bytes) as source, h5py.File(source, "r") as file:
            return root_attributes(file).get("format")
    except (FileError, *UNREADABLE):
        return None


def root_attributes(file: h5py.File) -> Attributes:
    """Return the text attributes of a file."""
    values = dict(file.attrs)
    return {key: value for key, value in values.items() if isinstance(value, str)}


def _arrays(
    file: h5py.File, keys_of: Callable[[Collection[str]], Iterable[str]], size: int
) -> Arrays:
    datasets: dict[str, h5py.Dataset] = {}

    def collect(key: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            datasets[key] = item

    file.visititems(collect)  # which follows no link to a name or to another file
    keys = list(keys_of(datasets))
    claimed = 0
    for key in keys:
        if key not in datasets:
            raise ValueError(f"'{key}' is missing or only a link")
        _require_plain(key, datasets[key])
        claimed += datasets[key].nbytes
        if claimed > MAX_EXPANSION * size:
            raise ValueError(f"'{key}' claims more data than the file holds")
    return {key: _array(key, datasets[key]) for key in keys}


def _require_plain(key: str, dataset: h5py.Dataset) -> None:
    if dataset.is_virtual or dataset.external:
        raise ValueError(f"'{key}' points outside the file")
    dtype = dataset.dtype
    plain = np.can_cast(dtype, np.int64) or (dtype.kind == "f" and dtype.itemsize in (2, 4, 8))
    if not (plain and dtype.isnative):
        raise ValueError(f"'{key}' is no array of plain numbers")


def _array(key: str, dataset: h5py.Dataset) -> np.ndarray:
    array: np.ndarray = dataset[...]
    if array.dtype == np.bool_ and array.size and array.view(np.uint8).max() > 1:
        raise ValueError(f"'{key}' holds truth values that are neither 0 nor 1")
    return array


def require_schema(attributes: Attributes, present: str, origin: str, remedy: str) -> None:
    """Raise StorageError unless this version of the project reads a file's schema.

    Parameters
    ----------
    remedy : str
        Advice on how to rebuild an older file.
    """
    schema = attributes["schema"]
    major, _, minor = schema.partition(".")
    if not (major.isdecimal() and minor.isdecimal() and len(schema) < 10):
        raise StorageError(f"{origin} has no schema; {remedy}")
    read = int(present.partition(".")[0])
    if int(major) != read:
        raise StorageError(
            f"{origin} has schema {schema}, this version reads {present}; "
            f"{'upgrade avatar' if int(major) > read else remedy}"
        )
