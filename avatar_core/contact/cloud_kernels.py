"""The compiled part of the contact step that deforms the cloud: far field by modes, near by blocks.

    u(x) = - sum_t lambda_t a_t [ sum_k X_k(x) Y_k . f_t  +  sum_j w_j N_j(x) n_t ]

with f_t = w(p_t) n_t as in :mod:`avatar_core.contact.kernels`, N_j the exact near field of load
position j, and for large deformation the terms of :mod:`avatar_core.vademecum.large_deformation`.
That is an organ under patches; near a tip, :mod:`avatar_core.contact.dent` shows the tip's dent.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.contact.cloud import BLOCK
from avatar_core.contact.dent import add_dents
from avatar_core.contact.effects.large_deformation import (
    add_nonlinear_amplitudes,
    add_nonlinear_near,
    powers_of_depth,
)
from avatar_core.contact.effects.respiration import shift_cloud
from avatar_core.contact.effects.viscoelasticity import least_shown

LEAST_WEIGHT = 0.02  # of a load position, below which its near field is left out


@fast
def deform(model, state, out, effects):  # type: ignore[no-untyped-def]
    """The cloud under the forces of a period."""
    e = effects
    _displace(
        model, state, out, e.superposition, e.large_deformation, e.friction, e.viscoelasticity
    )
    add_dents(model, state, e.tip_law, e.dent)
    write_cloud(model.rest, state.field, out.cloud)
    shift_cloud(e.respiration, out.cloud)


@fast
def _displace(  # type: ignore[no-untyped-def]
    model, state, out, superposition, large_deformation, friction, viscoelasticity
):
    """Far and near field into ``state.field``."""
    if superposition is None and out.n_contacts[0] == 0:
        state.field[:] = np.float32(0.0)
        return
    _amplitudes(state, superposition, large_deformation)
    _far_field(model, state, large_deformation)
    for t in range(state.passage.shape[0]):
        if state.force[t] > 0.0:
            _near_field(model, state, large_deformation, friction, viscoelasticity, t)
    if viscoelasticity is not None:
        _near_history(model, state, viscoelasticity)


@fast
def write_cloud(rest, field, cloud):  # type: ignore[no-untyped-def]
    """Deformed position and displacement of every point (n_points, 6)."""
    n_points = cloud.shape[0]
    flat_rest, flat_cloud = rest.reshape(6 * n_points), cloud.reshape(6 * n_points)
    for v in range(n_points):
        for d in range(6):
            flat_cloud[6 * v + d] = flat_rest[6 * v + d] + field[3 * v + d % 3]


@fast
def _amplitudes(state, superposition, large_deformation):  # type: ignore[no-untyped-def]
    """Far amplitudes - sum_t lambda_t a_t Y^T f_t, then those of large deformation."""
    amplitude = state.amplitude
    n_modes = amplitude.shape[0]
    amplitude[:] = np.float32(0.0)
    if large_deformation is not None:
        n_modes -= large_deformation.load.shape[2]
    if superposition is not None:
        for k in range(n_modes):
            amplitude[k] = np.float32(superposition.total[k])
    for t in range(state.passage.shape[0]):
        if state.force[t] <= 0.0:
            continue
        if superposition is None:
            force = np.float32(state.force[t] * state.scale[t])
            for k in range(n_modes):
                amplitude[k] -= force * state.mode[t, k]
        if large_deformation is not None:
            add_nonlinear_amplitudes(state, large_deformation, t, amplitude)


@fast
def _far_field(model, state, large_deformation):  # type: ignore[no-untyped-def]
    """sum_k X_k a_k over the modes that are shown, then those of large deformation."""
    amplitude, scale = state.amplitude, model.space_scale
    shown = min(state.shown[0], scale.shape[0])
    for b in range(model.space.shape[0]):
        u = state.field[b * BLOCK : (b + 1) * BLOCK]
        x = model.space[b]
        for i in range(BLOCK):
            u[i] = np.float32(0.0)
        for k in range(0, shown - 3, 4):
            a0, a1 = amplitude[k] * scale[k], amplitude[k + 1] * scale[k + 1]
            a2, a3 = amplitude[k + 2] * scale[k + 2], amplitude[k + 3] * scale[k + 3]
            for i in range(BLOCK):
                u[i] += x[k, i] * a0 + x[k + 1, i] * a1 + x[k + 2, i] * a2 + x[k + 3, i] * a3
        for k in range(shown - shown % 4, shown):
            a = amplitude[k] * scale[k]
            for i in range(BLOCK):
                u[i] += x[k, i] * a
        if large_deformation is not None:
            _add_modes(amplitude, scale, x, u, scale.shape[0] - large_deformation.load.shape[2])


@fast
def _add_modes(amplitude, scale, x, u, first):  # type: ignore[no-untyped-def]
    """The same sum from mode ``first``. Calling it in the loop above costs the bare step 6 %."""
    end = scale.shape[0]
    for k in range(first, end - 3, 4):
        a0, a1 = amplitude[k] * scale[k], amplitude[k + 1] * scale[k + 1]
        a2, a3 = amplitude[k + 2] * scale[k + 2], amplitude[k + 3] * scale[k + 3]
        for i in range(BLOCK):
            u[i] += x[k, i] * a0 + x[k + 1, i] * a1 + x[k + 2, i] * a2 + x[k + 3, i] * a3
    for k in range(end - (end - first) % 4, end):
        a = amplitude[k] * scale[k]
        for i in range(BLOCK):
            u[i] += x[k, i] * a


@fast
def _near_field(model, state, large_deformation, friction, viscoelasticity, t):  # type: ignore[no-untyped-def]
    """The exact near field around the load positions that carry the force of a tip."""
    kept = 0.0
    for i in range(state.n_nodes[t]):
        kept += _soft_threshold(state.weight[t, i, 0])
    n, scale = state.normal[t], state.scale[t] / kept
    f0, f1, f2 = -state.force[t] * n[0], -state.force[t] * n[1], -state.force[t] * n[2]
    if friction is not None:
        f0, f1, f2 = friction.push[t, 0], friction.push[t, 1], friction.push[t, 2]
    second = third = 0.0
    if large_deformation is not None:
        second, third = powers_of_depth(state, large_deformation, t)
    for i in range(state.n_nodes[t]):
        w = _soft_threshold(state.weight[t, i, 0])
        if w != 0.0:
            j, part = state.nodes[t, i], w * scale
            if viscoelasticity is None:
                _add_row(model, state, j, part * f0, part * f1, part * f2)
            if large_deformation is not None:
                add_nonlinear_near(model, state, large_deformation, j, w / kept, second, third)


@fast
def _near_history(model, state, viscoelasticity):  # type: ignore[no-untyped-def]
    """The near field of the load history; its weakest loads fade out."""
    least = least_shown(viscoelasticity)
    for m in range(viscoelasticity.count[0]):
        e = viscoelasticity.near_elastic[m]
        size = np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
        if size > least:
            part = (size - least) / size
            _add_row(
                model, state, viscoelasticity.position[m], part * e[0], part * e[1], part * e[2]
            )


@inlined
def _soft_threshold(w):  # type: ignore[no-untyped-def]
    """Soft thresholding, so that the near field of a load position vanishes continuously."""
    if w > 0.0:
        return max(w - LEAST_WEIGHT, 0.0)
    return min(w + LEAST_WEIGHT, 0.0)


@fast
def _add_row(model, state, j, x, y, z):  # type: ignore[no-untyped-def]
    u, f0, f1, f2 = state.field, np.float32(x), np.float32(y), np.float32(z)
    for e in range(model.near_start[j], model.near_start[j + 1]):
        v = 3 * model.near_target[e]
        block = model.near_block[e]
        for d in range(3):
            u[v + d] += block[d, 0] * f0 + block[d, 1] * f1 + block[d, 2] * f2
