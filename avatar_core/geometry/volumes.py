"""Voxels of a file: layers of labels or one image, and where they lie in the patient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import SurfaceError

MAX_VOXEL_BYTES = 2**30  # size of a decompressed file


@dataclass(frozen=True)
class Segment:
    """One label of a file: the number that chooses it, its layer and its value in there."""

    name: str
    number: int
    layer: int
    value: int

    def __str__(self) -> str:
        return f"{self.name} ({self.number})" if self.name != str(self.number) else self.name


@dataclass(frozen=True)
class Volume:
    """Layers of voxels.

    Attributes
    ----------
    values : ndarray, shape (n_layers, nx, ny, nz)
        Voxels.
    affine : ndarray, shape (4, 4)
        Map from indices to RAS [mm].
    segments : tuple[Segment, ...]
        Segments that the file names.
    notices : tuple[str, ...]
        Gaps and contradictions in the file, one line each.
    """

    values: NDArray[Any]
    affine: FloatArray
    segments: tuple[Segment, ...] = ()
    notices: tuple[str, ...] = ()


def require_loadable(name: str, shape: Sequence[int], item: int) -> int:
    """Return the bytes of an array; SurfaceError if they are too many."""
    n_bytes = item * int(np.prod(np.array(shape, dtype=object)))
    if not 0 < n_bytes <= MAX_VOXEL_BYTES:
        raise SurfaceError(
            f"{name}: voxels of {n_bytes / 1e9:.1f} GB; crop it to the organ "
            f"(limit {MAX_VOXEL_BYTES / 1e9:.1f} GB)"
        )
    return n_bytes
