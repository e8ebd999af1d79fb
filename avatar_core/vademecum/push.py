"""The organ under a push of any size; see :mod:`avatar_core.vademecum.large_deformation`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.vademecum.large_deformation import powers
from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True, eq=False)
class Push:
    """An organ pushed by a force along the inward normal.

    displacement : ndarray, shape (3 n_vertices,) [m]
    depth : of the patch [m]
    within : the force lies in the range that was computed
    """

    displacement: FloatArray
    depth: float
    within: bool


def push(vademecum: Vademecum, positions: np.ndarray, weights: FloatArray, force: float) -> Push:
    """The organ under a force along the inward normal of a point of the surface.

    Parameters
    ----------
    vademecum : Vademecum, linear where it holds no large deformation
    positions, weights : of the point, :meth:`avatar_core.fem.patch_loads.LoadSurface.weights`
    force : f >= 0 [N]
    """
    inward = -weights @ vademecum.surface.normals[positions]
    inward /= np.linalg.norm(inward)
    linear = force * (vademecum.displacement(positions, weights) @ inward)
    a = force * float(inward @ vademecum.compliance(positions, weights) @ inward)
    large = vademecum.large
    if large is None:
        return Push(linear, a, True)
    reach = float(large.reach[positions].min())
    terms = powers(a, reach)
    load = np.einsum("k,i,kin->n", terms, weights, large.load[:, positions])
    displacement = linear + large.space @ load
    for position, weight in zip(positions, weights, strict=True):
        row = slice(vademecum.near.start[position], vademecum.near.start[position + 1])
        near = np.tensordot(terms, large.near[:, row], axes=1)
        displacement.reshape(-1, 3)[vademecum.near.target[row]] += weight * near
    depth = a + float(terms @ (large.depth[:, positions] @ weights))
    return Push(displacement, depth, a <= reach)


def push_to(
    vademecum: Vademecum, positions: np.ndarray, weights: FloatArray, depth: float
) -> tuple[float, Push]:
    """The force that moves the patch by a depth, by Newton's method, and the organ under it."""
    force = depth / push(vademecum, positions, weights, 1e-9).depth * 1e-9
    found = push(vademecum, positions, weights, force)
    for _ in range(30):
        step = 1e-6 * force
        slope = (push(vademecum, positions, weights, force + step).depth - found.depth) / step
        force += (depth - found.depth) / slope
        found = push(vademecum, positions, weights, force)
        if abs(found.depth - depth) <= 1e-9 * depth:
            break
    return force, found
