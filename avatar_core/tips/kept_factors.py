"""Shape factors of a scene's tips, computed once on a machine.

A vademecum holds no shape factors: each takes a second or three, and a scene has one tip or two.
They are kept by the content they were made of, a few in memory and some in the user's cache.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np

from avatar_core.common.compiled_cache import content
from avatar_core.common.files import FileError, opened
from avatar_core.common.hdf5 import replace_file, verified
from avatar_core.errors import StorageError
from avatar_core.geometry.tip import Tip
from avatar_core.tips.law import ShapeFactor, of_planes
from avatar_core.tips.shape_factor import factor_of, together
from avatar_core.vademecum.tip_field import TipField

_IN_MEMORY, _ON_DISK = 4, 64  # factors of some MB each
_MAX_BYTES = 1 << 28  # size of a file
_ARRAYS = ShapeFactor._fields


def factors_of(field: TipField, tips: Sequence[Tip]) -> ShapeFactor:
    """Return log s of each tip over the outline of a tip field; zero for patches or no field."""
    if field.outline is None or any(tip.shape == "patch" for tip in tips):
        return of_planes(len(tips))
    made = {tip: _kept(_Made(field, tip)) for tip in tips}
    return together([made[tip] for tip in tips])


class _Made:
    """Parts that a factor is made of; two are equal if their content is."""

    def __init__(self, field: TipField, tip: Tip) -> None:
        self.field, self.tip = field, tip
        found = hashlib.sha256(f"{content()} {tip!r}".encode())
        for array in (field.distance, field.access, field.origin, field.spacing, *field.outline):
            found.update(f"{array.dtype.str} {array.shape}".encode())
            found.update(np.ascontiguousarray(array).data)
        self.digest = found.hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Made) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


@lru_cache(_IN_MEMORY)
def _kept(made: _Made) -> ShapeFactor:
    path = _folder() / f"{made.digest[:32]}.h5"
    with suppress(FileError, StorageError), opened(path, _MAX_BYTES) as source:
        _, arrays = verified(
            source, str(path), "shape factor", lambda held, _: {}, lambda _: _ARRAYS
        )
        with suppress(OSError):
            os.utime(path)
        return ShapeFactor(*(arrays[name] for name in _ARRAYS))
    factor = factor_of(made.field, made.tip)
    with suppress(OSError, StorageError):  # a folder that is full or not ours costs time alone
        path.parent.mkdir(parents=True, exist_ok=True)
        _drop_old(path.parent)
        replace_file(path, factor._asdict(), {})
    return factor


def _folder() -> Path:
    user = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(user) / "avatar" / "tips"


def _drop_old(folder: Path) -> None:
    """Remove the least recently used files before another is kept."""
    files = sorted(folder.glob("*.h5"), key=lambda path: path.stat().st_mtime)
    for path in files[: max(0, len(files) + 1 - _ON_DISK)]:
        path.unlink(missing_ok=True)
