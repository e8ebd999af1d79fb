"""Modes that live in one block of points each: a separated field, separated once more in space.

Far from its loads a field u(x) = sum_m B_m(x) a_m is smooth: a few modes suffice there, against
dozens near the loads. With the points in compact blocks b,

    u(x) ~ sum_k Z_bk(x) sum_m C_bkm a_m,    x in b.

Z_b are the principal components of the displacement of a block under the loads, as many as it
needs. These are the low-rank blocks of a hierarchical matrix (Hackbusch, Computing 62, 1999) with a
basis common to all loads of a region. One threshold holds for all blocks of a field. With as many
modes, no other choice has a smaller error; and fewer modes of a field are those of a higher
threshold.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_core.common.arrays import FloatArray, IntArray


class BlockModes(NamedTuple):
    """The modes of a field in every block.

    space : ndarray of float32, shape (n, values of a block), Z, each with a peak of 1
    core : ndarray of float32, shape (n, m), C, from the amplitudes of m modes of the whole field
    level : ndarray of int32, shape (n,), rank at which this mode is first kept, averaged over
        blocks; from 1 on, ascending in each block
    start : ndarray of int64, shape (n_blocks + 1,), first mode of each block, the strongest first
    """

    space: FloatArray
    core: FloatArray
    level: IntArray
    start: IntArray

    @staticmethod
    def none(n_blocks: int, size: int, m: int) -> BlockModes:
        """Return the modes of a zero field."""
        single, start = np.float32, np.zeros(n_blocks + 1, np.int64)
        return BlockModes(
            np.zeros((0, size), single), np.zeros((0, m), single), np.zeros(0, np.int32), start
        )


def compact_order(points: FloatArray, size: int) -> IntArray:
    """Return an order of points in which each ``size`` successive ones lie together.

    Recursive coordinate bisection (Berger & Bokhari, IEEE Trans. Computers 36, 1987) halves the
    points across the longest side, at a multiple of ``size``.

    points : ndarray, shape (n, 3)
    """

    def halved(some: IntArray) -> list[IntArray]:
        if len(some) <= size:
            return [some]
        at = points[some]
        along = some[np.argsort(at[:, np.argmax(np.ptp(at, axis=0))], kind="stable")]
        middle = size * (-(-len(some) // size) // 2)
        return halved(along[:middle]) + halved(along[middle:])

    return np.concatenate(halved(np.arange(len(points))))


def load_sizes(fields: FloatArray, mass: FloatArray, loads: FloatArray) -> FloatArray:
    """Return the L2 norm of the displacement by each load, shape (n_loads,).

    For the parameters see :func:`separate_blocks`.
    """
    gram = np.tensordot(fields, mass[:, :, None] * fields, ((0, 1), (0, 1)))
    return np.asarray(np.sqrt(np.einsum("ij,jk,ik->i", loads, gram, loads)))


def separate_blocks(
    fields: FloatArray, mass: FloatArray, loads: FloatArray, sizes: FloatArray, tolerance: float
) -> BlockModes:
    """Return the modes of every block.

    fields : ndarray, shape (n_blocks, values of a block, m), B
    mass : ndarray, shape (n_blocks, values of a block), lumped mass, which weights errors
    loads : ndarray, shape (n_loads, m), amplitudes a for which the error is measured
    sizes : ndarray, shape (n_loads,), L2 norms to which the errors of these loads are relative
    tolerance : root mean square over the loads of the remaining relative L2 error
    """
    if fields.size == 0:
        return BlockModes.none(*fields.shape)
    gram = np.swapaxes(fields, 1, 2) @ (mass[:, :, None] * fields)
    scaled = loads / np.maximum(sizes, np.finfo(float).tiny)[:, None] / np.sqrt(len(loads))
    root = np.asarray(np.linalg.qr(scaled, mode="r"))
    energy, vectors = np.linalg.eigh(root @ gram @ root.T)
    energy, vectors = energy[:, ::-1], vectors[:, :, ::-1]  # the strongest first
    order = np.argsort(-energy, axis=None, kind="stable")
    left = np.cumsum(np.maximum(energy.flat[order[::-1]], 0.0))[::-1]
    kept = order[left > tolerance**2]
    level = np.zeros(energy.shape, np.int32)
    level.flat[kept] = 1 + np.arange(len(kept)) // len(fields)
    counts = (level > 0).sum(axis=1)
    space, core = [], []
    for b, n in enumerate(counts):
        mixed = root.T @ vectors[b, :, :n]
        z = mixed.T @ fields[b].T
        peak = np.abs(z).max(axis=1, keepdims=True)
        space.append(z / peak)
        core.append(peak * (mixed.T @ gram[b]) / energy[b, :n, None])
    single, start = np.float32, np.concatenate([[0], np.cumsum(counts)])
    return BlockModes(
        np.vstack(space).astype(single), np.vstack(core).astype(single), level[level > 0], start
    )
