"""Frictional contact of tips close to each other, by Newton's method on the projections.

The division of a load between close tips depends on small differences in compliance, which
Gauss-Seidel resolves slowly. The solution is the fixed point of all projections,

    g_t = - n a + P_D(z),    a = max(0, lambda - w / c_n),    z = tau + (y - U)_t / c_t,

solved for all tips together (Alart & Curnier, CMAME 92:353, 1991). D is the disc of radius mu a,
c_n and c_t are the tip's own compliances and w its gap. Far from the solution Newton steps may
diverge: the step of least residual is kept. If two tips nearly coincide, one may have to pass its
whole load to the other. Steps from the present pushes do not find that solution. Therefore each tip
alone is a start, too.

The steps only propose a start: the following sweeps decide on convergence.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.contact.effects.grasp import is_held, missed, stiffness_times
from avatar_core.contact.effects.large_deformation import bend_held
from avatar_core.contact.tip_solver import added_depth

STEPS = 7
LEAST_PIVOT = 1e-9


@fast
def patch_displacement(model, data, t):  # type: ignore[no-untyped-def]
    """Return U of a tip's patch: the displacement by the present pushes and without them."""
    superposition = data.superposition
    u0, u1, u2 = (
        superposition.free_displacement[t, 0],
        superposition.free_displacement[t, 1],
        superposition.free_displacement[t, 2],
    )
    for s in range(data.passage.shape[0]):
        if s != t and (not model.several_tools.on or not data.active[s]):
            continue
        c, g = data.friction.compliance[t, s], data.friction.push[s]
        u0 += c[0, 0] * g[0] + c[0, 1] * g[1] + c[0, 2] * g[2]
        u1 += c[1, 0] * g[0] + c[1, 1] * g[1] + c[1, 2] * g[2]
        u2 += c[2, 0] * g[0] + c[2, 1] * g[1] + c[2, 2] * g[2]
    return u0, u1, u2


@inlined
def newton_steps(model, data, start):  # type: ignore[no-untyped-def]
    """Replace all pushes by those of the Newton step with the least residual.

    start : 0 from the present pushes, t from tip t - 1 alone
    """
    friction = data.friction
    push, best, n_tools = friction.push, friction.best, data.passage.shape[0]
    least = np.inf
    for k in range(STEPS + 1):
        size = 0.0
        for t in range(n_tools):
            size += _linearise(model, data, t)
        if size < least:
            least = size
            for t in range(n_tools):
                for d in range(3):
                    best[t, d] = push[t, d]
        if k == 0 and start > 0 and data.active[start - 1] and not is_held(model, data, start - 1):
            _start_from_one_tip(data, start - 1)
        elif k < STEPS:
            _gauss(friction.matrix, friction.rhs)
            for t in range(n_tools):
                for d in range(3):
                    push[t, d] += friction.rhs[3 * t + d]
    for t in range(n_tools):
        for d in range(3):
            push[t, d] = best[t, d]
        n, g = data.normal[t], push[t]
        if is_held(model, data, t):
            data.force[t] = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        else:
            data.force[t] = max(0.0, -(g[0] * n[0] + g[1] * n[1] + g[2] * n[2]))


@inlined
def _start_from_one_tip(data, t):  # type: ignore[no-untyped-def]
    """Set the push of a tip as if no other is in contact and it slips."""
    friction = data.friction
    n, y, c = data.normal[t], friction.offset[t], friction.compliance[t, t]
    gap, stiff, along = data.gap[t], 0.0, 0.0
    for i in range(3):
        gap -= n[i] * data.superposition.free_displacement[t, i]
        stiff += n[i] * (c[i, 0] * n[0] + c[i, 1] * n[1] + c[i, 2] * n[2])
        along += y[i] * n[i]
    across = 0.0
    for i in range(3):
        across += (y[i] - along * n[i]) ** 2
    force = max(0.0, -gap / stiff)
    drag = friction.limit[t] / np.sqrt(across) if across > 0.0 else 0.0
    friction.push[:] = 0.0
    for i in range(3):
        friction.push[t, i] = force * (drag * (y[i] - along * n[i]) - n[i])


@inlined
def _linearise(model, data, t):  # type: ignore[no-untyped-def]
    """Write a tip's rows of the Newton system; return its squared residual [N^2]."""
    friction = data.friction
    matrix, rhs, n_tools = friction.matrix, friction.rhs, data.passage.shape[0]
    for i in range(3):
        rhs[3 * t + i] = 0.0
        for column in range(3 * n_tools):
            matrix[3 * t + i, column] = 1.0 if column == 3 * t + i else 0.0
    if not data.active[t]:
        return 0.0
    if is_held(model, data, t):
        return _linearise_held(model, data, t)
    n, g, y, c = data.normal[t], friction.push[t], friction.offset[t], friction.compliance[t, t]
    normal = 0.0
    for i in range(3):
        normal += n[i] * (c[i, 0] * n[0] + c[i, 1] * n[1] + c[i, 2] * n[2])
    across = 0.5 * (c[0, 0] + c[1, 1] + c[2, 2] - normal)
    u0, u1, u2 = patch_displacement(model, data, t)
    force = -(g[0] * n[0] + g[1] * n[1] + g[2] * n[2])
    w, bending = data.gap[t] - (n[0] * u0 + n[1] * u1 + n[2] * u2), 0.0
    if model.large_deformation.on or model.law.on:
        data.force[t] = max(0.0, force)
        added, bending = added_depth(model, data, t)
        w += added
    pressed = force - w / (normal + bending)
    x0, x1, x2 = y[0] - u0, y[1] - u1, y[2] - u2
    along = x0 * n[0] + x1 * n[1] + x2 * n[2]
    z0 = g[0] + force * n[0] + (x0 - along * n[0]) / across
    z1 = g[1] + force * n[1] + (x1 - along * n[1]) / across
    z2 = g[2] + force * n[2] + (x2 - along * n[2]) / across
    size, bound = np.sqrt(z0 * z0 + z1 * z1 + z2 * z2), friction.limit[t] * max(0.0, pressed)
    part, limit = 1.0, 0.0  # factors of dz and of da
    e0 = e1 = e2 = 0.0
    if size > bound:
        part, limit = bound / size, friction.limit[t]
        e0, e1, e2 = z0 / size, z1 / size, z2 / size
    if pressed <= 0.0:
        pressed = part = limit = 0.0
    kept = (part * z0, part * z1, part * z2)
    e, square = (e0, e1, e2), 0.0
    for i in range(3):
        residual = -n[i] * max(0.0, pressed) + kept[i] - g[i]
        rhs[3 * t + i] = residual
        square += residual * residual
    if pressed <= 0.0:
        return square
    for s in range(n_tools):
        if not data.active[s]:
            continue
        for d in range(3):
            own = 1.0 if s == t else 0.0
            b = friction.compliance[t, s]
            lifted = n[0] * b[0, d] + n[1] * b[1, d] + n[2] * b[2, d]
            a = lifted / (normal + bending) - own * n[d] * (1.0 - bending / (normal + bending))
            slid = 0.0  # e . dz
            for i in range(3):
                dz = own * ((1.0 if i == d else 0.0) - n[i] * n[d])
                slid += e[i] * (dz - (b[i, d] - n[i] * lifted) / across)
            for i in range(3):
                dz = own * ((1.0 if i == d else 0.0) - n[i] * n[d])
                dz -= (b[i, d] - n[i] * lifted) / across
                new = -n[i] * a + e[i] * limit * a + part * (dz - e[i] * slid)
                matrix[3 * t + i, 3 * s + d] -= new
    return square


@inlined
def _linearise_held(model, data, t):  # type: ignore[no-untyped-def]
    """Write rows of a tool that holds tissue: dg_t + K sum_s!=t C_ts dg_s = K (y - u)."""
    friction, row = data.friction, 3 * t
    bend_held(model, data, t)
    u0, u1, u2 = patch_displacement(model, data, t)
    x0, x1, x2 = missed(data, t, u0, u1, u2)
    z0, z1, z2 = stiffness_times(data, t, x0, x1, x2)
    friction.rhs[row], friction.rhs[row + 1], friction.rhs[row + 2] = z0, z1, z2
    for s in range(data.passage.shape[0]):
        if s != t and data.active[s]:
            b = friction.compliance[t, s]
            for d in range(3):
                k0, k1, k2 = stiffness_times(data, t, b[0, d], b[1, d], b[2, d])
                friction.matrix[row, 3 * s + d] = k0
                friction.matrix[row + 1, 3 * s + d] = k1
                friction.matrix[row + 2, 3 * s + d] = k2
    return z0 * z0 + z1 * z1 + z2 * z2


@inlined
def _gauss(a, b):  # type: ignore[no-untyped-def]
    """Solve a x = b by elimination with partial pivoting, in place; tiny pivots are replaced."""
    n = b.shape[0]
    for k in range(n):
        p = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[p, k]):
                p = i
        if p != k:
            for j in range(k, n):
                a[k, j], a[p, j] = a[p, j], a[k, j]
            b[k], b[p] = b[p], b[k]
        if abs(a[k, k]) < LEAST_PIVOT:
            a[k, k] = LEAST_PIVOT
        for i in range(k + 1, n):
            f = a[i, k] / a[k, k]
            if f != 0.0:
                for j in range(k + 1, n):
                    a[i, j] -= f * a[k, j]
                b[i] -= f * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= a[k, j] * b[j]
        b[k] /= a[k, k]
