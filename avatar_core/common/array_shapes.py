"""Checks of the kind and shape that the arrays of a file must have, with named sizes.

    {"mesh/vertices": "f: vertices 3", "far/space": "f: 3*vertices rank"}

A name stands for one size everywhere; ``3*vertices`` is three times ``vertices``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avatar_core.errors import StorageError

Shapes = dict[str, str]

# f: float32 or float64; s: int16; i: whole numbers; b: truth values
_KINDS = {"f": "f", "s": "i", "i": "iu", "b": "b"}
_SHORT, _HALF = np.dtype(np.int16), np.dtype(np.float16)


def require_shapes(arrays: Mapping[str, np.ndarray], shapes: Shapes) -> dict[str, int]:
    """Return the size of each name.

    Raises
    ------
    StorageError
        If an array is missing, of another kind, not finite, or its sizes do not fit the arrays
        before it. The message names the first.
    """
    sizes: dict[str, int] = {}
    for key, wanted in shapes.items():
        if key not in arrays:
            raise StorageError(f"'{key}' is missing; build the file again")
        kind, _, names = wanted.partition(":")
        array = arrays[key]
        fits = array.dtype == _SHORT if kind == "s" else array.dtype.kind in _KINDS[kind]
        if not fits or array.dtype == _HALF:
            raise StorageError(f"'{key}' holds numbers of another kind; build the file again")
        if not _fits(array.shape, names.split(), sizes):
            raise StorageError(
                f"'{key}' has the shape {array.shape}, which does not fit the other arrays; build "
                "the file again"
            )
        if kind == "f" and not np.isfinite(array).all():
            raise StorageError(f"'{key}' is NaN or infinite; build the file again")
    return sizes


def require_indices(key: str, index: np.ndarray, limit: int) -> None:
    """Raise StorageError unless all indices lie in 0 ... limit - 1."""
    if index.size and not (int(index.min()) >= 0 and int(index.max()) < limit):
        raise StorageError(f"'{key}' points outside its target; build the file again")


def _fits(shape: tuple[int, ...], names: list[str], sizes: dict[str, int]) -> bool:
    """Return whether a shape has the sizes of its names; a name that is new takes its size."""
    if len(shape) != len(names):
        return False
    for n, name in zip(shape, names, strict=True):
        factor, _, base = name.rpartition("*")
        times = int(factor or 1)
        wanted = int(base) if base.isdigit() else sizes.setdefault(base, n // times)
        if n != times * wanted:
            return False
    return True
