"""The displacement modes of a cloud of points, laid out for the compiled step.

The points are put in compact blocks, and the field of each region is separated once more in each of
them (:mod:`avatar_core.reduction.block_modes`): a step reads the few modes that move a block, and
sums them in the first-level cache. Their number and rounding concern the display alone: the force
comes from the contact compliance, which keeps all its modes in single precision.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avatar_core.reduction.block_modes import BlockModes, compact_order, load_sizes, separate_blocks
from avatar_core.vademecum.accuracy import Cloud

if TYPE_CHECKING:
    from avatar_core.reduction.regional import RegionalField
    from avatar_core.vademecum.model import Vademecum

POINTS = 64  # of a block
BLOCK = 3 * POINTS  # displacements that are summed together, within the first-level cache
TOLERANCE = 2e-3  # root mean square of the relative error that blocks add to a load's displacement
PART = 1e-2  # the same of what is but a part of a displacement: added by large deformation, or
# moved by the organ's history and weight

_LARGEST = np.float32(32767)  # of int16


class CloudArrays(NamedTuple):
    """The arrays of the same names in :class:`avatar_core.contact.layout.MODEL`, and their source;
    the modes in single precision.

    points : vertices of the mesh that are shown, in the order of the blocks
    large_start : as ``region_start``, of the modes of large deformation, which come last
    """

    space: np.ndarray
    core: np.ndarray
    level: np.ndarray
    block_start: np.ndarray
    region_start: np.ndarray
    regional_load: np.ndarray
    points: np.ndarray
    large_start: np.ndarray


def cloud_arrays(
    vademecum: Vademecum,
    cloud: Cloud,
    large: RegionalField | None = None,
    motion: np.ndarray | None = None,
) -> CloudArrays:
    """The modes of all regions, and those of large deformation, in the blocks of a cloud.

    motion : ndarray, shape (n, n_global), amplitudes that the global modes may have beside those of
        the loads that are shown; see :func:`avatar_core.contact.layout.own_motion`. None
        if there are none
    """
    blocks, regional = _Blocks(vademecum, cloud), vademecum.regional
    load = _loads(vademecum)
    apart = 0 if motion is None else vademecum.far.rank
    parts = [_moved_modes(vademecum, blocks, motion), *_linear_modes(vademecum, blocks, load)]
    start = apart + np.concatenate([[0], np.cumsum(vademecum.far.rank + np.diff(regional.start))])
    large_start = np.full_like(start, start[-1])
    if large is not None:
        large_start = large_start + large.start
        parts += [_large_modes(large, r, blocks) for r in range(large.n_regions)]
    load = np.ascontiguousarray(load, np.float32)
    return CloudArrays(*_joined(parts), start, load, blocks.points, large_start)


class _Blocks:
    """The points of a cloud in compact blocks.

    points : vertices of the mesh; mass : ndarray, shape (n_blocks, BLOCK), lumped
    """

    def __init__(self, vademecum: Vademecum, cloud: Cloud) -> None:
        self.points = shown_vertices(vademecum, cloud)
        volumes = np.repeat(vademecum.mesh.vertex_volumes, 3)
        self.mass = self.of(volumes[:, None])[:, :, 0]

    def of(self, field: np.ndarray) -> np.ndarray:
        """Columns (3 n_vertices, n) as (n_blocks, BLOCK, n), the last block filled up by zeros."""
        rows = field.reshape(len(field) // 3, 3, field.shape[1])[self.points]
        n_blocks = -(-len(self.points) // POINTS)
        found = np.zeros((n_blocks * POINTS, 3, field.shape[1]))
        found[: len(rows)] = rows
        return found.reshape(n_blocks, BLOCK, field.shape[1])


def _loads(vademecum: Vademecum) -> np.ndarray:
    """Of each position in the global modes and in those of its region, (n_positions, 3, n)."""
    far, regional = vademecum.far, vademecum.regional
    shared = far.load.reshape(vademecum.surface.n_positions, 3, far.rank)
    return np.concatenate([shared, regional.load], axis=2)


def _moved_modes(vademecum: Vademecum, blocks: _Blocks, motion: np.ndarray | None) -> BlockModes:
    """Of the global modes, as far as they move by more than the loads that are shown."""
    shared = blocks.of(vademecum.far.space)
    if motion is None:
        return BlockModes.none(len(shared), BLOCK, 0)
    size = load_sizes(shared, blocks.mass, motion)
    return separate_blocks(shared, blocks.mass, motion, size, PART)


def _linear_modes(vademecum: Vademecum, blocks: _Blocks, load: np.ndarray) -> list[BlockModes]:
    """Of every region with the global modes."""
    regional, shared, parts = vademecum.regional, blocks.of(vademecum.far.space), []
    for r in range(regional.n_regions):
        here, own = regional.region == r, slice(*regional.start[r : r + 2])
        fields = np.concatenate([shared, blocks.of(regional.space[:, own])], axis=2)
        loads = load[here, :, : fields.shape[2]].reshape(-1, fields.shape[2]).astype(float)
        size = load_sizes(fields, blocks.mass, loads)
        parts.append(separate_blocks(fields, blocks.mass, loads, size, TOLERANCE))
    return parts


def _large_modes(large: RegionalField, region: int, blocks: _Blocks) -> BlockModes:
    """Of what large deformation adds to the loads of a region."""
    fields = blocks.of(large.space[:, slice(*large.start[region : region + 2])])
    loads = large.load[large.region == region, :, : fields.shape[2]]
    loads = loads.reshape(-1, fields.shape[2]).astype(float)
    sizes = load_sizes(fields, blocks.mass, loads)
    return separate_blocks(fields, blocks.mass, loads, sizes, PART)


def shown_vertices(vademecum: Vademecum, cloud: Cloud) -> np.ndarray:
    """Vertices of the mesh that a cloud shows, or that carry what it shows, in compact blocks."""
    mesh, display = vademecum.mesh, vademecum.display
    if cloud == "off":
        return np.arange(0)
    shown = np.arange(len(mesh.vertices))
    if cloud == "surface":
        shown = mesh.surface_vertices
        if display is not None:
            shown = np.union1d(shown, display.corners)
    return np.asarray(shown[compact_order(mesh.vertices[shown], POINTS)])


def rounded(arrays: CloudArrays) -> CloudArrays:
    """The same with modes in 16 bits.

    The time of the cloud is that of reading its modes; these take half as long as in single
    precision. Rounding costs 1 / 65536 of each mode's peak, which is 1.
    """
    space = np.rint(arrays.space * _LARGEST).astype(np.int16)
    return arrays._replace(space=space, core=arrays.core / _LARGEST)


def _joined(parts: list[BlockModes]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """space, core, level and block_start of all parts."""
    space = np.concatenate([part.space for part in parts])
    core = np.zeros((len(space), max(part.core.shape[1] for part in parts)), np.float32)
    before = np.cumsum([0] + [len(part.space) for part in parts])
    for first, part in zip(before, parts, strict=False):
        core[first : first + len(part.core), : part.core.shape[1]] = part.core
    level = np.concatenate([part.level for part in parts])
    start = np.stack([first + part.start for first, part in zip(before, parts, strict=False)])
    return space, core, level, start
