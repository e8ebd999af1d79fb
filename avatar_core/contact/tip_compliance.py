"""Response to a unit normal force of a tip: of the modes, near the tip, and at the tip itself.

Compiled parts of the contact step; f . C f and gamma as in
:mod:`avatar_core.contact.tip_response`.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import fast
from avatar_core.reduction.near_field import find_block


@fast
def modal_load(model, state, t):  # type: ignore[no-untyped-def]
    """Y^T f: the modal load of a unit normal force of tip t."""
    mode, n = state.mode[t], state.normal[t]
    mode[:] = np.float32(0.0)
    for i in range(state.n_nodes[t]):
        w, load = state.weight[t, i, 0], model.load[state.nodes[t, i]]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        for k in range(mode.shape[0]):
            mode[k] += w0 * load[0, k] + w1 * load[1, k] + w2 * load[2, k]


@fast
def near_column(model, state, t):  # type: ignore[no-untyped-def]
    """Near displacement at the nodes of a tip under its own unit normal force.

    By Maxwell and Betti the block from j to m is the transpose of that from m to j: one is read.
    """
    column, n = state.column[t], state.normal[t]
    column[: state.n_nodes[t]] = np.float32(0.0)
    n0, n1, n2 = np.float32(n[0]), np.float32(n[1]), np.float32(n[2])
    for i in range(state.n_nodes[t]):
        j, w = state.nodes[t, i], np.float32(state.weight[t, i, 0])
        u0 = u1 = u2 = np.float32(0.0)
        for q in range(i + 1):
            e = find_block(model.contact_start, model.contact_slot, j, state.nodes[t, q])
            if e < 0:
                continue
            b = model.contact_block[e]
            column[q, 0] += w * (b[0, 0] * n0 + b[0, 1] * n1 + b[0, 2] * n2)
            column[q, 1] += w * (b[1, 0] * n0 + b[1, 1] * n1 + b[1, 2] * n2)
            column[q, 2] += w * (b[2, 0] * n0 + b[2, 1] * n1 + b[2, 2] * n2)
            if q == i:
                continue
            v = np.float32(state.weight[t, q, 0])
            u0 += v * (b[0, 0] * n0 + b[1, 0] * n1 + b[2, 0] * n2)
            u1 += v * (b[0, 1] * n0 + b[1, 1] * n1 + b[2, 1] * n2)
            u2 += v * (b[0, 2] * n0 + b[1, 2] * n1 + b[2, 2] * n2)
        column[i, 0] += u0
        column[i, 1] += u1
        column[i, 2] += u2


@fast
def near_gram(model, state, t):  # type: ignore[no-untyped-def]
    """Near part of f . C f of one tip."""
    n, near = state.normal[t], 0.0
    n0, n1, n2 = n[0], n[1], n[2]
    for i in range(state.n_nodes[t]):
        j, w = state.nodes[t, i], state.weight[t, i, 0]
        for q in range(i + 1):
            e = find_block(model.contact_start, model.contact_slot, j, state.nodes[t, q])
            if e < 0:
                continue
            b = model.contact_block[e]
            u0 = b[0, 0] * n0 + b[0, 1] * n1 + b[0, 2] * n2
            u1 = b[1, 0] * n0 + b[1, 1] * n1 + b[1, 2] * n2
            u2 = b[2, 0] * n0 + b[2, 1] * n1 + b[2, 2] * n2
            both = w * state.weight[t, q, 0] * (1.0 if q == i else 2.0)
            near += both * (n0 * u0 + n1 * u1 + n2 * u2)
    return near


@fast
def assemble_own(model, state, t, near):  # type: ignore[no-untyped-def]
    """Compliance of a single tip on an organ at rest; it grows where access fades.

    What the stencil blurs of it, gamma - f . C f, is a local dent of the tip alone.
    """
    far = np.float32(0.0)
    for k in range(state.mode.shape[1]):
        far += state.mode[t, k] * state.mode[t, k]
    state.blurred[t] = state.self_compliance[t] - (far + near)
    fade = model.softness[0] * (1.0 / state.access[t] - 1.0)
    state.compliance[t, t] = state.self_compliance[t] + fade


@fast
def near_along_normal(state, t, column):  # type: ignore[no-untyped-def]
    """n . sum_j w_j u_j over the nodes of a tip."""
    n, near = state.normal[t], 0.0
    for i in range(state.n_nodes[t]):
        u = column[i]
        near += state.weight[t, i, 0] * (n[0] * u[0] + n[1] * u[1] + n[2] * u[2])
    return near
