"""The displacement of a cloud of points, laid out for the compiled step.

A cloud takes the first blocks of a vademecum's field (:mod:`avatar_core.reduction.block_field`):
the blocks that hold displayed vertices, or all. The modes and their rounding concern the display
alone. The force comes from the contact compliance, which keeps all its modes in single precision.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avatar_core.reduction.block_field import POINTS, BlockField
from avatar_core.vademecum.accuracy import Cloud

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


class CloudArrays(NamedTuple):
    """The arrays of the same names in :class:`avatar_core.contact.layout.MODEL`, and their source.

    vertex : ndarray, vertex of the mesh, in each place of the blocks; -1 where a block is not full
    large_start : ndarray, like ``region_start``, for the modes of large deformation, which come
        last
    """

    space: np.ndarray
    core: np.ndarray
    level: np.ndarray
    block_start: np.ndarray
    region_start: np.ndarray
    regional_load: np.ndarray
    vertex: np.ndarray
    large_start: np.ndarray


def cloud_arrays(
    vademecum: Vademecum, cloud: Cloud, large: BlockField | None = None
) -> CloudArrays:
    """Return the blocks of a cloud from the vademecum's field and large deformation's field."""
    field, n_blocks = vademecum.field, shown_blocks(vademecum, cloud)
    parts, start = [_first_blocks(field, n_blocks)], np.cumsum(field.count, dtype=np.int64)
    large_start = np.full_like(start, start[-1])
    if large is not None:
        large_start += np.cumsum(large.count)
        parts.append(_first_blocks(large, n_blocks))
    space, core, level, block_start = _joined(parts)
    vertex = vademecum.blocks.vertex[: n_blocks * POINTS]
    return CloudArrays(space, core, level, block_start, start, field.load, vertex, large_start)


def shown_vertices(vademecum: Vademecum, cloud: Cloud) -> np.ndarray:
    """Return mesh vertices that a cloud shows or interpolates from, ascending."""
    # Here, because the contact node needs none of it.
    from avatar_core.vademecum.display import displayed_vertices

    if cloud == "off":
        return np.arange(0)
    if cloud == "volume":
        return np.arange(len(vademecum.mesh.vertices))
    return displayed_vertices(vademecum.mesh, vademecum.display)


def shown_blocks(vademecum: Vademecum, cloud: Cloud) -> int:
    """Return the number of blocks that hold these vertices."""
    return vademecum.blocks.that_hold(shown_vertices(vademecum, cloud))


_Part = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _first_blocks(field: BlockField, n_blocks: int) -> _Part:
    """Return space, core, level and start of the first blocks of a field."""
    start = field.start[:, : n_blocks + 1]
    if n_blocks + 1 == field.start.shape[1]:
        return field.space, field.core, field.level, start
    rows = np.concatenate([np.arange(part[0], part[-1]) for part in start])
    before = np.cumsum(start[:, -1] - start[:, 0])
    moved = start - start[:, :1] + np.concatenate([[0], before[:-1]])[:, None]
    return field.space[rows], field.core[rows], field.level[rows], moved


def _joined(parts: list[_Part]) -> _Part:
    """Return the blocks of all fields; global modes are taken from the first field only."""
    if len(parts) == 1:
        space, core, level, start = parts[0]
        return space, np.ascontiguousarray(core), level, np.ascontiguousarray(start)
    most = max(core.shape[1] for _, core, _, _ in parts)
    before = np.cumsum([0] + [len(space) for space, _, _, _ in parts])
    core = np.zeros((before[-1], most), np.float32)
    for first, (_, own, _, _) in zip(before, parts, strict=False):
        core[first : first + len(own), : own.shape[1]] = own
    later = zip(before[1:], parts[1:], strict=False)
    starts = [parts[0][3], *(first + start[1:] for first, (*_, start) in later)]
    space, level = (np.concatenate([part[k] for part in parts]) for k in (0, 2))
    return space, core, level, np.concatenate(starts)
