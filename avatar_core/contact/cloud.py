"""The displacement modes of a cloud of points, laid out for the compiled step.

Their number and precision concern the display alone: the force comes from the contact compliance,
which keeps all its modes in single precision.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avatar_core.vademecum.accuracy import Cloud, Precision

if TYPE_CHECKING:
    from avatar_core.reduction.regional import RegionalField
    from avatar_core.vademecum.model import Vademecum

BLOCK = 256  # displacements that are summed together, within the first-level cache

_LARGEST = {"int16": 32767, "int8": 127}


class CloudArrays(NamedTuple):
    """The arrays of the same names in :class:`avatar_core.contact.layout.Layout`, and their source.

    points : vertices of the mesh that are shown
    large_start : as ``region_start``, of the modes of large deformation, which come last
    """

    space: np.ndarray
    space_scale: np.ndarray
    region_start: np.ndarray
    regional_load: np.ndarray
    points: np.ndarray
    large_start: np.ndarray


def cloud_arrays(
    vademecum: Vademecum,
    modes: int,
    cloud: Cloud,
    precision: Precision,
    large: RegionalField | None = None,
) -> CloudArrays:
    """Global modes, those of all regions, and those of large deformation at the points of a cloud.

    modes : at a place, global ones first, then those of its region
    """
    points = shown_vertices(vademecum, cloud)
    far = vademecum.far.space[:, :modes]
    regional = vademecum.regional.truncated(modes - vademecum.far.rank)
    parts = [far, regional.space] + ([large.space] if large else [])
    space = np.concatenate([_at(part, points) for part in parts], axis=2)
    start = far.shape[1] + regional.start
    large_start = start[-1] + (large.start if large else np.zeros_like(start))
    load = np.ascontiguousarray(regional.load)
    return CloudArrays(*in_blocks(space, precision), start, load, points, large_start)


def _at(space: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Modes (3 n_vertices, n) at some vertices, shape (n_points, 3, n) float32."""
    by_vertex = space.reshape(len(space) // 3, 3, space.shape[1])
    return by_vertex[points].astype(np.float32)


def shown_vertices(vademecum: Vademecum, cloud: Cloud) -> np.ndarray:
    """Vertices of the mesh that a cloud shows, or that carry what it shows, ascending."""
    mesh, display = vademecum.mesh, vademecum.display
    if cloud == "surface":
        if display is None:
            return mesh.surface_vertices
        return np.union1d(mesh.surface_vertices, display.corners)
    return np.arange(len(mesh.vertices) if cloud == "volume" else 0)


def in_blocks(space: np.ndarray, precision: Precision = "int16") -> tuple[np.ndarray, np.ndarray]:
    """Modes (n_points, 3, rank) as (n_blocks, rank, BLOCK), and the scale (rank,) of each.

    The time of the cloud is that of reading its modes; integers take a half or a quarter of single
    precision. Rounding costs 1 / 65536 or 1 / 256 of each mode's peak.
    """
    flat = space.reshape(-1, space.shape[2])
    kind, scale = np.dtype(precision), np.ones(flat.shape[1], np.float32)
    if precision in _LARGEST:
        peak = np.abs(flat).max(axis=0, initial=1e-30)
        scale = (peak / _LARGEST[precision]).astype(np.float32)
    n_blocks = -(-len(flat) // BLOCK)
    padded = np.zeros((n_blocks * BLOCK, len(scale)), kind)
    padded[: len(flat)] = np.rint(flat / scale) if precision in _LARGEST else flat
    blocks = padded.reshape(n_blocks, BLOCK, len(scale)).transpose(0, 2, 1)
    return np.ascontiguousarray(blocks), scale


def out_of_blocks(blocks: np.ndarray, scale: np.ndarray, n_points: int) -> np.ndarray:
    """The inverse of :func:`in_blocks` up to rounding, shape (3 n_points, rank) float32."""
    rank = len(scale)
    flat = blocks.transpose(0, 2, 1).reshape(-1, rank)[: 3 * n_points]
    return np.asarray(flat * scale, np.float32)
