"""Where a tip is not alone with an organ at rest: what all causes do at its load positions.

The organ is linear: other tips, the past, its weight and its swing add up. All of them are

    u(s) = sum_k Y_k(s) q_k + near field,      q = free + gain * (Y^T f),

f the loads of all tips. ``free`` is where the modes would be at the end of the period without any
load, ``gain`` how far a load moves them within it (0 and 1 where nothing remembers or swings). The
same for the near field, whose memory is a distribution of loads, and which has no mass.

The force on a tip is the derivative of the elastic energy at fixed loads and memory. With the
displacement u_j at the load positions by all causes, U = a sum_j w_j u_j that of the patch, and g
the force on the tissue,

    F_d = - g . d(target)/dp_d + (da/dp_d / a) g . U + a sum_j dw_j/dp_d g . u_j,

target the displacement that the tip asks of its patch, along n only where nothing sticks, and
a^2 = gamma / (f . C f) from :mod:`avatar_core.contact.tip_response`.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from avatar_core.common.jit import fast
from avatar_core.common.splines import cell_at, second_derivatives
from avatar_core.contact.effects import friction as stick_slip
from avatar_core.contact.effects import several_tools as coupling
from avatar_core.contact.effects import viscoelasticity as relaxation

Reply = namedtuple(
    "Reply",
    [
        "free",  # (k,) modes at the end of the period without any load
        "gain",  # (k,) what a load of one moves them
        "total",  # (k,) modes at the end of the period
        "near_gain",  # (1,) the same for the near field
        "lift",  # (T,) displacement along n of the patch without any load [m]
        "lifted",  # (T, 3) in all directions
        "trail",  # (T, MAX_STENCIL, 3) near displacement at the nodes by remembered loads
        "own",  # (MAX_STENCIL, 3) displacement at the nodes by a unit normal force at rest
        "joint",  # (MAX_STENCIL, 3) displacement at the nodes by all causes
        "hessian",  # (3, 3) of phi
        "turning",  # (3, 3) dn_i / dp_d
    ],
)


def make_reply(n_tools: int, n_modes: int, n_nodes: int) -> Reply:
    """Scratch, at rest."""
    return Reply(
        free=np.zeros(n_modes),
        gain=np.ones(n_modes),
        total=np.zeros(n_modes),
        near_gain=np.ones(1),
        lift=np.zeros(n_tools),
        lifted=np.zeros((n_tools, 3)),
        trail=np.zeros((n_tools, n_nodes, 3)),
        own=np.zeros((n_nodes, 3)),
        joint=np.zeros((n_nodes, 3)),
        hessian=np.zeros((3, 3)),
        turning=np.zeros((3, 3)),
    )


@fast
def at_nodes(model, state, t, amplitude, out):  # type: ignore[no-untyped-def]
    """sum_k Y_k(s_j) q_k at the load positions of a tip."""
    for i in range(state.n_nodes[t]):
        load = model.load[state.nodes[t, i]]
        for d in range(3):
            value = 0.0
            for k in range(amplitude.shape[0]):
                value += load[d, k] * amplitude[k]
            out[i, d] = value


@fast
def lift_tip(model, state, reply, memory, t):  # type: ignore[no-untyped-def]
    """Displacement of a tip's patch that is there without any load in this period."""
    at_nodes(model, state, t, reply.free, reply.joint)
    if memory is not None:
        relaxation.leave_trail(model, state, memory, t, reply.trail[t])
    n = state.n_nodes[t]
    reply.lift[t] = 0.0
    for d in range(3):
        value = 0.0
        for i in range(n):
            value += state.weight[t, i, 0] * reply.joint[i, d]
            if memory is not None:
                value += state.weight[t, i, 0] * reply.trail[t, i, d]
        reply.lifted[t, d] = state.scale[t] * value
        reply.lift[t] += state.normal[t, d] * reply.lifted[t, d]


@fast
def superpose(state, reply, friction):  # type: ignore[no-untyped-def]
    """The modes under the forces found."""
    total = reply.total
    total[:] = 0.0
    for t in range(state.passage.shape[0]):
        if state.force[t] <= 0.0:
            continue
        if friction is not None:
            stick_slip.drive(state, friction, t, total)
        else:
            force = state.force[t] * state.scale[t]
            for k in range(total.shape[0]):
                total[k] -= force * state.mode[t, k]
    for k in range(total.shape[0]):
        total[k] = reply.free[k] + reply.gain[k] * total[k]


@fast
def add_superposed_force(  # type: ignore[no-untyped-def]
    model, state, out, tips, reply, several, large, friction, memory, t
):
    """F of the module's text, without what bending and fading add."""
    n, a = state.normal[t], state.scale[t]
    _turn(model, state, reply, t, tips[t])
    at_nodes(model, state, t, state.mode[t], reply.own)
    at_nodes(model, state, t, reply.total, reply.joint)
    count = state.n_nodes[t]
    for i in range(count):
        for d in range(3):
            reply.own[i, d] += state.column[t, i, d]
    if friction is not None:
        stick_slip.add_near(model, state, reply, several, friction, t)
    else:
        near = -state.force[t] * a * reply.near_gain[0]
        for i in range(count):
            for d in range(3):
                reply.joint[i, d] += near * state.column[t, i, d]
        if several is not None:
            coupling.add_near(state, reply, several, t)
    if memory is not None:
        for i in range(count):
            for d in range(3):
                reply.joint[i, d] += reply.trail[t, i, d]
    g0, g1, g2 = -state.force[t] * n[0], -state.force[t] * n[1], -state.force[t] * n[2]
    if friction is not None:
        g0, g1, g2 = friction.push[t, 0], friction.push[t, 1], friction.push[t, 2]
    u0 = u1 = u2 = v0 = v1 = v2 = 0.0
    for i in range(count):
        w, u, v = state.weight[t, i, 0], reply.joint[i], reply.own[i]
        u0 += w * u[0]
        u1 += w * u[1]
        u2 += w * u[2]
        v0 += w * v[0]
        v1 += w * v[1]
        v2 += w * v[2]
    for d in range(3):
        # da / a, from the grids' gamma and the derivative of f . C f
        turn0, turn1, turn2 = reply.turning[0, d], reply.turning[1, d], reply.turning[2, d]
        slope = turn0 * v0 + turn1 * v1 + turn2 * v2
        joint = 0.0
        for i in range(count):
            dw, u, v = state.weight[t, i, 1 + d], reply.joint[i], reply.own[i]
            slope += dw * (n[0] * v[0] + n[1] * v[1] + n[2] * v[2])
            joint += dw * (g0 * u[0] + g1 * u[1] + g2 * u[2])
        change = 0.5 * state.self_slope[t, d] / state.self_compliance[t] - slope / state.gram[t, t]
        value = a * (joint + change * (g0 * u0 + g1 * u1 + g2 * u2))
        if friction is not None:
            value -= stick_slip.asked(model, state, reply, large, friction, t, d)
        else:
            turned = turn0 * u0 + turn1 * u1 + turn2 * u2
            value += state.force[t] * (state.slope[t, d] - a * turned)
        out.force[t, d] = value


@fast
def _turn(model, state, reply, t, p):  # type: ignore[no-untyped-def]
    """dn/dp = (I - n n^T) grad g / |g|, g = grad phi."""
    n, hessian = state.normal[t], reply.hessian
    cell = cell_at(model.origin, model.spacing[0], p)
    second_derivatives(model.distance, cell, model.spacing[0], hessian)
    for d in range(3):
        along = n[0] * hessian[0, d] + n[1] * hessian[1, d] + n[2] * hessian[2, d]
        for i in range(3):
            reply.turning[i, d] = (hessian[i, d] - n[i] * along) / state.steepness[t]
