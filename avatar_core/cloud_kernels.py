"""The compiled part of the contact step that deforms the cloud: far field by modes, near by blocks.

    u(x) = - sum_t lambda_t a_t [ sum_k X_k(x) Y_k . f_t  +  sum_j w_j N_j(x) n_t ]

with f_t = w(p_t) n_t as in :mod:`avatar_core.contact_kernels`, N_j the exact near field of load
position j, and for large deformation the terms of :mod:`avatar_core.large_deformation`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

BLOCK = 256  # displacements that are summed together while they lie in the fastest cache
LEAST_WEIGHT = 0.02  # what each load position leaves of its near field to the others


@njit(cache=True, fastmath=True)
def contact_deform(model, state, out):  # type: ignore[no-untyped-def]
    """Second half of a period: the cloud under the forces of the first."""
    if out.n_contacts[0] == 0:
        state.field[:] = np.float32(0.0)
    else:
        _amplitudes(model, state)
        _far_field(model, state)
        _near_field(model, state)
    write_cloud(model.rest, state.field, out.cloud)


@njit(cache=True, fastmath=True, forceinline=True)
def write_cloud(rest, field, cloud):  # type: ignore[no-untyped-def]
    """Deformed position and displacement of every point (n_points, 6)."""
    n_points = cloud.shape[0]
    flat_rest, flat_cloud = rest.reshape(6 * n_points), cloud.reshape(6 * n_points)
    for v in range(n_points):
        for d in range(6):
            flat_cloud[6 * v + d] = flat_rest[6 * v + d] + field[3 * v + d % 3]


@njit(cache=True, fastmath=True, forceinline=True)
def _amplitudes(model, state):  # type: ignore[no-untyped-def]
    """Far amplitudes - sum_t lambda_t a_t Y^T f_t: the tips press inwards. Then the bent ones."""
    amplitude, bent = state.amplitude, model.bend_load.shape[2]
    n_modes = amplitude.shape[0] - bent
    amplitude[:] = np.float32(0.0)
    for t in range(state.passage.shape[0]):
        if state.force[t] <= 0.0:
            continue
        force = np.float32(state.force[t] * state.scale[t])
        for k in range(n_modes):
            amplitude[k] -= force * state.mode[t, k]
        if bent > 0:
            second, third = _powers(state, t)
            for i in range(state.n_nodes[t]):
                w, j = state.weight[t, i, 0], state.nodes[t, i]
                w2, w3 = np.float32(w * second), np.float32(w * third)
                y2, y3 = model.bend_load[0, j], model.bend_load[1, j]
                for k in range(bent):
                    amplitude[n_modes + k] += w2 * y2[k] + w3 * y3[k]


@njit(cache=True, fastmath=True, forceinline=True)
def _powers(state, t):  # type: ignore[no-untyped-def]
    """a^2 and a^3 of a tip's linear depth, tangential beyond the reach."""
    a = state.self_compliance[t] * state.force[t]
    inside = min(a, state.bend[t, 2])
    over = a - inside
    return inside * (inside + 2.0 * over), inside * inside * (inside + 3.0 * over)


@njit(cache=True, fastmath=True, forceinline=True)
def _far_field(model, state):  # type: ignore[no-untyped-def]
    """sum_k X_k a_k, four modes at a time; modes are stored as 16-bit fractions of their peak."""
    amplitude, scale = state.amplitude, model.space_scale
    n_modes = scale.shape[0]
    for b in range(model.space.shape[0]):
        u = state.field[b * BLOCK : (b + 1) * BLOCK]
        x = model.space[b]
        for i in range(BLOCK):
            u[i] = np.float32(0.0)
        for k in range(0, n_modes - 3, 4):
            a0, a1 = amplitude[k] * scale[k], amplitude[k + 1] * scale[k + 1]
            a2, a3 = amplitude[k + 2] * scale[k + 2], amplitude[k + 3] * scale[k + 3]
            for i in range(BLOCK):
                u[i] += x[k, i] * a0 + x[k + 1, i] * a1 + x[k + 2, i] * a2 + x[k + 3, i] * a3
        for k in range(n_modes - n_modes % 4, n_modes):
            a = amplitude[k] * scale[k]
            for i in range(BLOCK):
                u[i] += x[k, i] * a


@njit(cache=True, fastmath=True, forceinline=True)
def _near_field(model, state):  # type: ignore[no-untyped-def]
    """The exact remainder around the load positions that carry the forces."""
    bends = model.bend_near.shape[1] > 0
    for t in range(state.passage.shape[0]):
        if state.force[t] <= 0.0:
            continue
        kept = 0.0
        for i in range(state.n_nodes[t]):
            kept += _shrunk(state.weight[t, i, 0])
        force = -state.force[t] * state.scale[t] / kept
        second, third = _powers(state, t)
        for i in range(state.n_nodes[t]):
            w = _shrunk(state.weight[t, i, 0])
            if w != 0.0:
                _add_row(model, state, state.nodes[t, i], w * force, state.normal[t])
                if bends:
                    _add_bent_row(model, state, state.nodes[t, i], w / kept, second, third)


@njit(cache=True, forceinline=True)
def _shrunk(w):  # type: ignore[no-untyped-def]
    """A weight moved towards zero, so that a load position that leaves does so without a jump."""
    if w > 0.0:
        return max(w - LEAST_WEIGHT, 0.0)
    return min(w + LEAST_WEIGHT, 0.0)


@njit(cache=True, fastmath=True, forceinline=True)
def _add_row(model, state, j, force, n):  # type: ignore[no-untyped-def]
    u = state.field
    f0, f1, f2 = np.float32(force * n[0]), np.float32(force * n[1]), np.float32(force * n[2])
    for e in range(model.near_start[j], model.near_start[j + 1]):
        v = 3 * model.near_target[e]
        block = model.near_block[e]
        for d in range(3):
            u[v + d] += block[d, 0] * f0 + block[d, 1] * f1 + block[d, 2] * f2


@njit(cache=True, fastmath=True, forceinline=True)
def _add_bent_row(model, state, j, w, second, third):  # type: ignore[no-untyped-def]
    u = state.field
    w2, w3 = np.float32(w * second), np.float32(w * third)
    for e in range(model.near_start[j], model.near_start[j + 1]):
        v = 3 * model.near_target[e]
        for d in range(3):
            u[v + d] += w2 * model.bend_near[0, e, d] + w3 * model.bend_near[1, e, d]
