"""The displacement modes of a cloud of points, laid out for the compiled step.

Their number and precision concern the display alone: the force comes from the contact compliance,
which keeps all modes in single precision.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avatar_core.reduction.near_field import LocalBlocks, plateau
from avatar_core.vademecum.accuracy import Cloud, Precision

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum

BLOCK = 256  # displacements that are summed together, within the first-level cache

_LARGEST = {"int16": 32767, "int8": 127}
_FADE = 0.5  # of its radius, where a shortened near field begins to fade


class CloudArrays(NamedTuple):
    """The arrays of the same names in :class:`avatar_core.contact.layout.Layout`, and their source.

    points : vertices of the mesh that are shown
    fade : factor of each block of the vademecum's near field; zero where it is left out
    """

    space: np.ndarray
    space_scale: np.ndarray
    near: LocalBlocks
    points: np.ndarray
    fade: np.ndarray


def cloud_arrays(
    vademecum: Vademecum,
    modes: int | None,
    cloud: Cloud,
    precision: Precision,
    near: float,
    nonlinear: np.ndarray | None = None,
) -> CloudArrays:
    """Far and near field at the points of a cloud.

    Parameters
    ----------
    modes : of the far field; None for all
    near : radius of the near field over the vademecum's own, 0 to 1
    nonlinear : ndarray, shape (3 n_vertices, n), modes of large deformation
    """
    points = shown_vertices(vademecum, cloud)
    n_vertices = len(vademecum.mesh.vertices)
    space = vademecum.far.space.reshape(n_vertices, 3, -1)[points, :, :modes]
    if nonlinear is not None:
        space = np.concatenate([space, nonlinear.reshape(n_vertices, 3, -1)[points]], axis=2)
    blocks, fade = _near_at(vademecum.near, _fade(vademecum, near), points, n_vertices)
    return CloudArrays(*in_blocks(space, precision), blocks, points, fade)


def shown_vertices(vademecum: Vademecum, cloud: Cloud) -> np.ndarray:
    """Vertices of the mesh in a cloud, ascending."""
    if cloud == "surface":
        return vademecum.mesh.surface_vertices
    return np.arange(len(vademecum.mesh.vertices) if cloud == "volume" else 0)


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


def _fade(vademecum: Vademecum, fraction: float) -> np.ndarray:
    """Factor of every block of a near field that is cut to a fraction of its radius."""
    near = vademecum.near
    distance = _reach(vademecum)
    if fraction >= 1.0 or len(distance) == 0:
        return np.ones(len(distance))
    if fraction <= 0.0:
        return np.zeros(len(distance))
    filled = np.flatnonzero(np.diff(near.start))
    farthest = np.maximum.reduceat(distance, near.start[filled])
    radius = fraction * float(np.median(farthest))  # median: some positions reach across the organ
    return plateau(distance, _FADE * radius, radius)


def _reach(vademecum: Vademecum) -> np.ndarray:
    """Distance of every block's vertex from its load position [m]."""
    centers, vertices = vademecum.surface.centers, vademecum.mesh.vertices
    near = vademecum.near
    return np.asarray(np.linalg.norm(centers[near.position] - vertices[near.target], axis=1))


def _near_at(
    near: LocalBlocks, fade: np.ndarray, points: np.ndarray, n_vertices: int
) -> tuple[LocalBlocks, np.ndarray]:
    """The faded near field at some vertices, renumbered in their order, and the blocks' factors.

    The factors (n_blocks,) are zero where a block is left out.
    """
    number = np.full(n_vertices, -1, np.int32)
    number[points] = np.arange(len(points), dtype=np.int32)
    fade = np.where(number[near.target] >= 0, fade, 0.0)
    kept = near.kept(fade > 0.0)
    block = kept.block * fade[fade > 0.0][:, None, None].astype(kept.block.dtype)
    return replace(kept, target=number[kept.target], block=block), fade
