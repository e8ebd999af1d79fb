"""Mutations of vademecum and atlas files.

Arrays with false sizes and links are tested in test_hostile_files.py.

Bytes change at random, structure on purpose. Most mutants then get a valid checksum, so that the
reader itself must find the fault. Each mutation is a function of a seed alone.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avatar_core.atlas.storage import FRAME, LEVEL_SET, RESPONSE, SHAPE, save_anatomy, save_frame
from avatar_core.common.hdf5 import UNREADABLE, checksum, root_attributes
from avatar_core.vademecum.storage import save_vademecum
from tests.helpers.byte_mutations import OF_BYTES, pick, some
from tests.helpers.small_files import small_atlas, small_vademecum

_SEALED = 0.7  # part of the mutants that get a valid checksum
_JSON_VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 10**400, 1e308, float("nan"), "", "x", [], {}, [1], [[1]], {"a": 1}),
    *("\n\x1b[31m", "x" * 5000, 2**53, 0.5, "neo-hookean", [float("inf")] * 3),
)
_DTYPES = ("f2", "f4", "f8", ">f8", "i1", "i8", ">i4", "u8", "?", "S8", "c16", "f4,i4")
_VALUES = (0.0, -1.0, 1.0, 1e300, -1e300, 1e-300, np.nan, np.inf, 2.0**31, 2.0**63)


ATLAS_FILES = (FRAME, SHAPE, LEVEL_SET, RESPONSE)


def write_small_atlas(folder: Path) -> None:
    """Write an atlas of two balls to a new folder."""
    folder.mkdir()
    frame, anatomies = small_atlas()
    save_frame(folder, frame, "small")
    for anatomy in anatomies:
        save_anatomy(folder, anatomy)


@cache
def pristine(kind: str, variant: int = 0) -> bytes:
    """Return the bytes of an ATLAS_FILES kind or of a small vademecum, its parts by variant."""
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name, "small")
        if kind == "vademecum":
            save_vademecum(small_vademecum(variant & 1 == 1, variant & 2 == 2), Path(name, "v.h5"))
            return Path(name, "v.h5").read_bytes()
        write_small_atlas(folder)
        return (folder / kind if kind == FRAME else folder / "ball-1" / kind).read_bytes()


def mutant(kind: str, seed: int) -> bytes:
    """Return a mutated file of a kind."""
    rng = np.random.default_rng(seed)
    raw = pristine(kind, seed % 4 if kind == "vademecum" else 0)
    if seed % 2:
        raw = bytes(some(rng, bytearray(raw), OF_BYTES))
        return sealed(raw) if rng.random() < _SEALED else raw
    content = io.BytesIO(raw)
    with h5py.File(content, "r+") as file:
        for _ in range(int(rng.integers(1, 3))):
            _pick_fitting(rng)(rng, file)
        if rng.random() < _SEALED:
            _seal(file)
    return content.getvalue()


# --- the checksum -------------------------------------------------------------------------------


def sealed(raw: bytes) -> bytes:
    """Replace the stated checksum by that of the present content, if it can still be read."""
    found = forked(_checksums, raw)
    if not found:
        return raw
    stated, true = found.split()
    return raw.replace(stated, true)


def forked(function: Callable[[bytes], bytes], raw: bytes, seconds: int = 2) -> bytes:
    """Call a function in a child process; return nothing if the child dies, as HDF5 may."""
    ours, theirs = os.pipe()
    pid = os.fork()
    if pid == 0:
        signal.alarm(seconds)
        with contextlib.suppress(Exception):
            os.write(theirs, function(raw))
        os._exit(0)
    os.close(theirs)
    with os.fdopen(ours, "rb") as answer:
        found = answer.read()
    os.waitpid(pid, 0)
    return found


def _checksums(raw: bytes) -> bytes:
    """Return the stated and the true checksum."""
    with h5py.File(io.BytesIO(raw), "r") as file:
        attributes = root_attributes(file)
        stated = attributes.pop("checksum")
        return f"{stated} {checksum(_small_arrays(file), attributes)}".encode()


def _small_arrays(file: h5py.File) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}

    def collect(key: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and item.nbytes < 1 << 20 and item.dtype.kind in "fiub":
            arrays[key] = item[...]

    file.visititems(collect)
    return arrays


def _seal(file: h5py.File) -> None:
    try:
        attributes = root_attributes(file)
        attributes.pop("checksum", None)
        file.attrs["checksum"] = checksum(_small_arrays(file), attributes)
    except UNREADABLE:
        return  # there is no checksum of links that point nowhere


# --- mutations of structure -----------------------------------------------------------------------


def _dataset(rng: np.random.Generator, file: h5py.File) -> h5py.Dataset:
    found: list[h5py.Dataset] = []

    def collect(_: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            found.append(item)

    file.visititems(collect)
    return found[int(rng.integers(0, len(found)))]


def _replaced(file: h5py.File, dataset: h5py.Dataset, **made: Any) -> None:
    key = dataset.name
    del file[key]
    file.create_dataset(key, **made)


def _values(rng: np.random.Generator, file: h5py.File) -> None:
    dataset = _dataset(rng, file)
    array = dataset[...]
    if array.size and array.dtype.kind in "fiu":
        flat = array.reshape(-1)
        hit = rng.integers(0, flat.size, int(rng.integers(1, 4)))
        with np.errstate(all="ignore"):
            flat[hit] = np.asarray(rng.choice(_VALUES)).astype(array.dtype)
        dataset[...] = array


def _shape(rng: np.random.Generator, file: h5py.File) -> None:
    dataset = _dataset(rng, file)
    array = dataset[...]
    changed = (
        lambda: array[: len(array) // 2] if array.ndim else array.reshape(1),
        lambda: np.concatenate([array, array]) if array.ndim else array.reshape(1, 1),
        lambda: array.reshape(-1),
        lambda: array[..., None],
        lambda: array[:0] if array.ndim else array,
        lambda: array.T.copy(),
    )
    _replaced(file, dataset, data=changed[int(rng.integers(0, len(changed)))]())


def _dtype(rng: np.random.Generator, file: h5py.File) -> None:
    dataset = _dataset(rng, file)
    dtype = np.dtype(_DTYPES[int(rng.integers(0, len(_DTYPES)))])
    with np.errstate(all="ignore"):
        data = dataset[...].astype(dtype) if dtype.names is None else np.zeros(dataset.shape, dtype)
    _replaced(file, dataset, data=data)


def _removed(rng: np.random.Generator, file: h5py.File) -> None:
    key = _dataset(rng, file).name
    del file[key if rng.random() < 0.7 else key.rpartition("/")[0] or key]


def _groups(rng: np.random.Generator, file: h5py.File) -> None:
    """Add very deep or very many groups."""
    if rng.random() < 0.5:
        group = file
        for _ in range(200):
            group = group.create_group("g")
    else:
        for k in range(300):
            file.create_group(f"many/{k}")


def _attribute(rng: np.random.Generator, file: h5py.File) -> None:
    """Give an attribute another type or size."""
    name = pick(rng, tuple(file.attrs))
    values: tuple[Any, ...] = (
        1,
        b"x",
        np.bytes_(b"fixed"),
        ["a", "b"],
        h5py.Empty("f"),
        "\ud800".encode(errors="surrogatepass"),
        "99.0",
        "2.x",
        "-1",
        "1" * 10_000,
        "{" + '"a":' * 10,
        "",
    )
    file.attrs[name] = values[int(rng.integers(0, len(values)))]


def _json(rng: np.random.Generator, file: h5py.File) -> None:
    """Change a value in the JSON of an attribute."""
    names = [name for name, value in file.attrs.items() if str(value)[:1] in "{["]
    if names:
        name = pick(rng, tuple(names))
        file.attrs[name] = json.dumps(_changed(rng, json.loads(file.attrs[name])))


def _changed(rng: np.random.Generator, value: Any) -> Any:
    """Change, remove or add one value at some depth of a JSON document."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = pick(rng, tuple(value))
        if rng.random() < 0.1:
            return {k: v for k, v in value.items() if k != key}
        if rng.random() < 0.05:
            return {**value, "unknown": 1}
        return {**value, key: _changed(rng, value[key])}
    if isinstance(value, list) and value and rng.random() < 0.6:
        at = int(rng.integers(0, len(value)))
        return [*value[:at], _changed(rng, value[at]), *value[at + 1 :]]
    return pick(rng, _JSON_VALUES)


_OF_STRUCTURE = (
    *(_values, _values, _shape, _dtype),
    *(_removed, _groups, _attribute, _json, _json),
)


def _pick_fitting(rng: np.random.Generator) -> Callable[..., None]:
    change = pick(rng, _OF_STRUCTURE)

    def attempt(rng: np.random.Generator, file: h5py.File) -> None:
        try:
            change(rng, file)
        except (OSError, RuntimeError, KeyError, TypeError, ValueError, MemoryError):
            return  # an earlier change left nothing to change

    return attempt
