"""The displacement of an organ under every load: one field, separated by regions and by blocks.

    u(x, s_j) = sum_k Z_rbk(x) sum_m C_rbkm W_m(s_j),    x in block b, s_j in region r.

The load surface is divided in regions, whose loads have common amplitudes a_m = sum_j f_j W_m(s_j)
(:mod:`avatar_core.reduction.regional`). The points of the mesh are divided in compact blocks
(:mod:`avatar_core.reduction.block_modes`). A step reads the few modes Z_rb of the touched regions
in each block, and sums them in the first-level cache.

The first amplitudes of each region are those of the global modes. Motions of the whole organ beside
its loads (mass, weight, history) can therefore be separated from them; a part of its own displays
them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.common.processes import on_all_cores
from avatar_core.reduction.block_modes import BlockModes, compact_order, load_sizes, separate_blocks

if TYPE_CHECKING:
    from avatar_core.reduction.regional import RegionModes

POINTS = 64  # points of a block
BLOCK = 3 * POINTS  # displacements that are summed together, within the first-level cache
TOLERANCE = 2e-3  # root mean square of the relative error that blocks add to a load's displacement
PART = 1e-2  # the same for a part of a displacement, e.g. by large deformation
_BESIDE = 1e-3  # the same beside the loads: an untouched organ shows only its sag

_NONE = -1  # in a place of a block that is not filled up
_LARGEST = np.float32(32767)  # largest int16: rounding costs 1 / 65536 of a mode's peak


@dataclass(frozen=True, eq=False)
class Blocks:
    """The vertices of a mesh in compact blocks.

    Attributes
    ----------
    vertex : ndarray of int32, shape (n_blocks POINTS,)
        Vertex in each place; -1 where a block is not full.
    """

    vertex: IntArray

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return len(self.vertex) // POINTS

    @cached_property
    def place(self) -> IntArray:
        """Place of each vertex, shape (n_vertices,)."""
        full = np.flatnonzero(self.vertex != _NONE)
        out = np.empty(len(full), np.int32)
        out[self.vertex[full]] = full
        return out

    def that_hold(self, vertices: IntArray) -> int:
        """Return the number of leading blocks that hold all of some vertices."""
        return int(self.place[vertices].max(initial=-1)) // POINTS + 1

    def of(self, field: FloatArray) -> FloatArray:
        """Return columns (3 n_vertices, n) as (n_blocks, BLOCK, n), zero in unused places."""
        rows = field.reshape(len(field) // 3, 3, field.shape[1])
        found = np.zeros((len(self.vertex), 3, field.shape[1]), field.dtype)
        found[self.place] = rows
        return found.reshape(self.n_blocks, BLOCK, field.shape[1])

    def at_vertices(self, field: FloatArray) -> FloatArray:
        """Return the columns (3 n_vertices, n) of values in the blocks (n_blocks, BLOCK, n)."""
        rows = field.reshape(len(self.vertex), 3, field.shape[2])[self.place]
        return np.asarray(rows.reshape(-1, field.shape[2]))


def blocks_of(points: FloatArray, shown: IntArray) -> Blocks:
    """Return compact blocks of a mesh's points (n, 3); shown points fill the first blocks."""
    hidden = np.setdiff1d(np.arange(len(points)), shown)
    parts = [part[compact_order(points[part], POINTS)] for part in (np.unique(shown), hidden)]
    filled = [np.pad(part, (0, -len(part) % POINTS), constant_values=_NONE) for part in parts]
    return Blocks(np.concatenate(filled).astype(np.int32))


@dataclass(frozen=True, eq=False)
class BlockField:
    """A field over load positions and the blocks of a mesh.

    Part 0 displays global modes that move beside the loads; one part for each region follows.

    Attributes
    ----------
    region : ndarray of int32, shape (n_positions,)
        Region of each load position.
    load : ndarray, shape (n_positions, n_loads, most)
        W; zero beyond the region's amplitudes.
    count : ndarray of int32, shape (n_parts,)
        Number of amplitudes of each part; part 0 has the global ones.
    space : ndarray of int16, shape (n, BLOCK)
        Z, each with a peak of 32767.
    core : ndarray, shape (n, most)
        C.
    level : ndarray of int32, shape (n,)
        Level of each mode in its part; see :class:`BlockModes`.
    start : ndarray of int64, shape (n_parts, n_blocks + 1)
        First mode of each part in each block.
    """

    region: IntArray
    load: FloatArray
    count: IntArray
    space: IntArray
    core: FloatArray
    level: IntArray
    start: IntArray

    @property
    def n_regions(self) -> int:
        """Number of regions."""
        return len(self.count) - 1

    @property
    def n_shared(self) -> int:
        """Number of global modes, the first amplitudes of every region."""
        return int(self.count[0])

    @property
    def rank(self) -> int:
        """Largest number of amplitudes of a region."""
        return self.load.shape[2]

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        arrays = (self.region, self.load, self.count, self.space, self.core, self.level, self.start)
        return sum(a.nbytes for a in arrays)

    def of_part(self, part: int, amplitude: FloatArray) -> FloatArray:
        """Return displacement by amplitudes (count, n) of a part, shape (n_blocks, BLOCK, n)."""
        n_blocks = self.start.shape[1] - 1
        out = np.empty((n_blocks, BLOCK, amplitude.shape[1]), np.float32)
        amplitude = amplitude.astype(np.float32)
        for b in range(n_blocks):
            rows = slice(self.start[part, b], self.start[part, b + 1])
            moved = self.core[rows, : len(amplitude)] @ amplitude
            out[b] = self.space[rows].T.astype(np.float32) @ moved
        return out

    def amplitude(self, region: int, positions: IntArray, forces: FloatArray) -> FloatArray:
        """Return a region's amplitudes by forces (n, n_loads, m) at some positions, (count, m)."""
        load = self.load[positions, :, : self.count[1 + region]]
        return np.asarray(np.tensordot(load, forces, ((0, 1), (0, 1))))

    def under(self, positions: IntArray, forces: FloatArray) -> FloatArray:
        """Return displacement by forces (n, n_loads, m) at some positions, (n_blocks, BLOCK, m)."""
        out = np.zeros((self.start.shape[1] - 1, BLOCK, forces.shape[2]), np.float32)
        regions = self.region[positions]
        for r in np.unique(regions):
            at = regions == r
            out += self.of_part(1 + r, self.amplitude(r, positions[at], forces[at]))
        return out

    def combined(self, positions: IntArray, weights: FloatArray) -> FloatArray:
        """Return the weighted sum over some load positions, shape (n_blocks, BLOCK, n_loads)."""
        one = np.eye(self.load.shape[1], dtype=np.float32)
        return self.under(positions, np.asarray(weights, np.float32)[:, None, None] * one)

    def with_most(self, most: int) -> BlockField:
        """Return the same field with the first amplitudes of each region alone."""
        return replace(
            self,
            load=self.load[:, :, :most],
            count=np.minimum(self.count, most),
            core=self.core[:, :most],
        )

    def softened(self, factor: float) -> BlockField:
        """Return the field times a number; global modes and their amplitudes each get its root."""
        root, n = np.float32(np.sqrt(factor)), self.n_shared
        load, core = np.float32(factor) * self.load, self.core.copy()
        load[:, :, :n] = root * self.load[:, :, :n]
        core[:, :n] *= root
        return replace(self, load=load, core=core)


def separate_field(
    blocks: Blocks,
    volumes: FloatArray,
    region: IntArray,
    regions: Sequence[RegionModes],
    shared: tuple[FloatArray, FloatArray] | None = None,
    motion: FloatArray | None = None,
    tolerance: float = TOLERANCE,
    progress: Callable[[float], None] = lambda fraction: None,
) -> BlockField:
    """Return the field of global modes and regions' modes, in blocks.

    Parameters
    ----------
    volumes : ndarray, shape (n_vertices,)
        Weights of errors.
    region : ndarray of int32, shape (n_positions,)
        Region of each load position.
    regions : Sequence[RegionModes]
        Modes of each region.
    shared : tuple[ndarray, ndarray] or None
        Global modes (3 n_vertices, k) and their amounts in each load (n_positions, n_loads, k);
        None if there are none.
    motion : ndarray, shape (n, k)
        Amplitudes that the global modes may have beside the loads.
    tolerance : float
        Tolerance of a region's loads; see :func:`separate_blocks`.
    progress : Callable[[float], None]
        Called with the finished fraction.
    """
    n_loads = regions[0].load.shape[1]
    if shared is None:
        n_dofs = 3 * len(volumes)
        shared = np.zeros((n_dofs, 0)), np.zeros((len(region), n_loads, 0), np.float32)
    mass = blocks.of(np.repeat(volumes, 3)[:, None])[:, :, 0].astype(float)
    fields = blocks.of(np.asarray(shared[0], float))
    parts, n_shared = [_separated(fields, mass, motion, _BESIDE)], fields.shape[2]
    count = n_shared + np.array([0, *(modes.space.shape[1] for modes in regions)])
    load = np.zeros((len(region), n_loads, count.max()), np.float32)
    load[:, :, :n_shared] = shared[1]

    def separate(r: int) -> BlockModes:
        here, modes = region == r, regions[r]
        load[here, :, n_shared : count[1 + r]] = modes.load
        own = np.concatenate([fields, blocks.of(modes.space.astype(float))], axis=2)
        loads = load[here, :, : own.shape[2]].reshape(-1, own.shape[2]).astype(float)
        return _separated(own, mass, loads, tolerance)

    for part in on_all_cores(separate, range(len(regions))):
        parts.append(part)
        progress((len(parts) - 1) / len(regions))
    return BlockField(region, load, count.astype(np.int32), *_joined(parts, load.shape[2]))


def _separated(
    fields: FloatArray, mass: FloatArray, loads: FloatArray | None, tolerance: float
) -> BlockModes:
    if loads is None:
        return BlockModes.none(len(fields), BLOCK, fields.shape[2])
    return separate_blocks(fields, mass, loads, load_sizes(fields, mass, loads), tolerance)


def _joined(
    parts: Sequence[BlockModes], most: int
) -> tuple[IntArray, FloatArray, IntArray, IntArray]:
    """Return space in 16 bits, core, level and start of all parts.

    A step's time is the time to read its modes; 16 bits take half as long as single precision.
    """
    before = np.cumsum([0] + [len(part.space) for part in parts])
    core = np.zeros((before[-1], most), np.float32)
    for first, part in zip(before, parts, strict=False):
        core[first : first + len(part.core), : part.core.shape[1]] = part.core / _LARGEST
    space = [np.rint(part.space * _LARGEST).astype(np.int16) for part in parts]
    level = np.concatenate([part.level for part in parts])
    start = np.stack([first + part.start for first, part in zip(before, parts, strict=False)])
    return np.concatenate(space), core, level, start.astype(np.int64)
