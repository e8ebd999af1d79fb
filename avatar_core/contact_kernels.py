"""The compiled part of the contact step. No allocation of size, no exception, no I/O.

Each tool tip (sphere, centre p, radius r) presses through one patch, at the surface point below
it, along the normal n = grad phi / |grad phi|. Forces lambda solve the Signorini conditions

    gap_t = phi(p_t) - r_t,   gap_t + sum_t' C_tt' lambda_t' >= 0,   lambda >= 0,  complementary,

by projected Gauss-Seidel, C as in :mod:`avatar_core.tip_response`. The stored energy
W(p) = lambda . C lambda / 2 is a function of the tip positions alone, and the force on a tip is
its exact derivative,

    F_t = - dW/dp_t
        = lambda_t [ grad phi + lambda_t grad gamma / 2 + sum_t'!=t lambda_t' dC_tt'/dp_t ]:

the normal force, and the small tangential one by which a frictionless tip slides towards softer
tissue. Without it a closed path would gain or lose energy.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

from avatar_core.near_field import find_block
from avatar_core.tip_field import FAR, evaluate, second_derivatives
from avatar_core.tip_response import gather

MAX_TOOLS = 8
MAX_SWEEPS = 1000
BLOCK = 256  # displacements that are summed together while they lie in the fastest cache

OK, NO_MODEL, NO_POSE, STALE_POSE, INVALID_POSE, NOT_CONVERGED, TOO_MANY, OUT_OF_RANGE = range(8)
UNKNOWN_FRAME = 8

GAP_TOLERANCE = 1e-9  # [m] of gap change that ends Gauss-Seidel
ENTRY_DEPTH = 5e-3  # [m] a centre deeper than this did not come in through the surface
MAX_DEPTH = 25e-3  # [m] of the centre below the surface at rest
MIN_ACCESS = 1e-2  # below, the tip is off the accessible surface
FULL_ACCESS = 0.99  # below, the force fades
LEAST_WEIGHT = 0.01  # load positions that carry less leave their near field to the others

# What the step reads; `prepare` fills it once. Shapes in avatar_core.contact.ContactModel.
ModelArrays = namedtuple(
    "ModelArrays",
    [
        "distance",
        "access",
        "origin",
        "spacing",
        "row",
        "carrier",
        "share",
        "self_compliance",
        "position",
        "load",
        "contact_start",
        "contact_slot",
        "contact_block",
        "contact_reach",
        "softness",
        "space",
        "space_scale",
        "near_start",
        "near_target",
        "near_block",
        "rest",
        "tip_radius",
    ],
)

# What the step keeps between calls (engaged, force) and its scratch.
State = namedtuple(
    "State",
    [
        "engaged",  # (T,) the tip came in through the surface
        "force",  # (T,) lambda
        "active",  # (T,) the tip is closer than its radius, where it may touch
        "gap",  # (T,) phi - r
        "slope",  # (T, 3) grad phi
        "normal",  # (T, 3) n
        "turning",  # (T, 3, 3) dn_i / dp_d
        "hessian",  # (3, 3) of phi
        "access",  # (T,) chi
        "access_slope",  # (T, 3)
        "point",  # (T, 3) s
        "local",  # (n_positions,) scratch of gather, all -1
        "nodes",  # (T, MAX_STENCIL) load positions that carry the tip
        "n_nodes",  # (T,)
        "weight",  # (T, MAX_STENCIL, 4) w and its gradient
        "extent",  # (T,) radius of these positions about s
        "mode",  # (T, k) Y^T f
        "mode_slope",  # (T, 3, k) its gradient
        "column",  # (T, T, MAX_STENCIL, 3) near displacement at the second's nodes by the first
        "near",  # (T, T) whether the near fields of two tips meet
        "self_compliance",  # (T,) gamma
        "self_slope",  # (T, 3) grad gamma
        "gram",  # (T, T) f_t . C f_t'
        "scale",  # (T,) a_t
        "compliance",  # (T, T)
        "gram_slope",  # (3,) d(f_t . C f_t')/dp_t
        "amplitude",  # (k,) of the far field
        "field",  # (n_blocks BLOCK,) displacement of the cloud, component after component
    ],
)

Out = namedtuple(
    "Out",
    [
        "force",
        "torque",
        "status",
        "cloud",
        "n_contacts",
        "contact_tool",
        "contact_position",
        "contact_normal",
        "contact_force",
        "contact_penetration",
    ],
)


@njit(cache=True)
def contact_solve(model, state, out, tips):  # type: ignore[no-untyped-def]
    """First half of a period: locate, gather, assemble, solve, differentiate."""
    n_tools = tips.shape[0]
    status = OK
    n_active = 0
    for t in range(n_tools):
        out.status[t] = _locate(model, state, t, tips[t])
        status = max(status, out.status[t])
        if state.active[t]:
            n_active += 1
            gather(model, state, t, tips[t])
            _mode(model, state, t)
            _measure_extent(model, state, t)
    for t in range(n_tools):
        for s in range(n_tools):
            if state.active[t] and state.active[s]:
                _near_column(model, state, t, s)
    _assemble(model, state)
    if not _solve(state):
        for t in range(n_tools):
            if state.active[t]:
                out.status[t] = NOT_CONVERGED
        status = max(status, NOT_CONVERGED)
    _write_forces(model, state, out, tips, n_active > 1)
    return status


@njit(cache=True)
def contact_step(model, state, out, tips):  # type: ignore[no-untyped-def]
    """One period: forces, then the deformed cloud. Returns the worst status."""
    status = contact_solve(model, state, out, tips)
    contact_deform(model, state, out)
    return status


@njit(cache=True)
def _locate(model, state, t, tip):  # type: ignore[no-untyped-def]
    """Gap, normal, access, compliance and surface point of a tip; whether it may touch."""
    state.active[t] = False
    state.access[t] = 1.0
    engaged = state.engaged[t]
    state.engaged[t] = False
    if not np.isfinite(tip[0] + tip[1] + tip[2]):
        return INVALID_POSE
    grid, h = model.origin, model.spacing[0]
    phi = evaluate(model.distance, grid, h, tip, state.slope[t], FAR)
    state.gap[t] = phi - model.tip_radius[t]
    if state.gap[t] >= 0.0:
        return OK
    access = evaluate(model.access, grid, h, tip, state.access_slope[t], 0.0)
    state.access[t] = min(access, 1.0)
    entered = engaged or phi > -ENTRY_DEPTH
    if not entered or phi < -MAX_DEPTH or access < MIN_ACCESS:
        return OUT_OF_RANGE
    state.engaged[t] = True
    state.active[t] = True
    _direct(model, state, t, tip, phi)
    state.self_compliance[t] = evaluate(
        model.self_compliance, grid, h, tip, state.self_slope[t], 1.0
    )
    return OK if access >= FULL_ACCESS else OUT_OF_RANGE


@njit(cache=True)
def _direct(model, state, t, p, phi):  # type: ignore[no-untyped-def]
    """n = g / |g| with g = grad phi, dn/dp = (I - n n^T) grad g / |g|, and s = p - phi n."""
    n, hessian = state.normal[t], state.hessian
    g = state.slope[t]
    scale = 1.0 / max(np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2), 1e-3)
    for d in range(3):
        n[d] = g[d] * scale
        state.point[t, d] = p[d] - phi * n[d]
    second_derivatives(model.distance, model.origin, model.spacing[0], p, hessian)
    for d in range(3):
        along = n[0] * hessian[0, d] + n[1] * hessian[1, d] + n[2] * hessian[2, d]
        for i in range(3):
            state.turning[t, i, d] = (hessian[i, d] - n[i] * along) * scale


@njit(cache=True, fastmath=True)
def _mode(model, state, t):  # type: ignore[no-untyped-def]
    """Y^T f: how a unit normal force of tip t drives the modes."""
    mode, n = state.mode[t], state.normal[t]
    mode[:] = np.float32(0.0)
    for i in range(state.n_nodes[t]):
        w, load = state.weight[t, i, 0], model.load[state.nodes[t, i]]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        for k in range(mode.shape[0]):
            mode[k] += w0 * load[0, k] + w1 * load[1, k] + w2 * load[2, k]


@njit(cache=True, fastmath=True)
def _mode_slope(model, state, t):  # type: ignore[no-untyped-def]
    """d(Y^T f)/dp with df/dp_d = dw/dp_d n + w dn/dp_d."""
    slope, n, turning = state.mode_slope[t], state.normal[t], state.turning[t]
    slope[:] = np.float32(0.0)
    for i in range(state.n_nodes[t]):
        weight, load = state.weight[t, i], model.load[state.nodes[t, i]]
        for d in range(3):
            f0 = np.float32(weight[1 + d] * n[0] + weight[0] * turning[0, d])
            f1 = np.float32(weight[1 + d] * n[1] + weight[0] * turning[1, d])
            f2 = np.float32(weight[1 + d] * n[2] + weight[0] * turning[2, d])
            for k in range(slope.shape[1]):
                slope[d, k] += f0 * load[0, k] + f1 * load[1, k] + f2 * load[2, k]


@njit(cache=True, fastmath=True)
def _measure_extent(model, state, t):  # type: ignore[no-untyped-def]
    farthest = 0.0
    for i in range(state.n_nodes[t]):
        j, squared = state.nodes[t, i], 0.0
        for d in range(3):
            squared += (model.position[j, d] - state.point[t, d]) ** 2
        farthest = max(farthest, squared)
    state.extent[t] = np.sqrt(farthest)


@njit(cache=True, fastmath=True)
def _near_column(model, state, t, s):  # type: ignore[no-untyped-def]
    """Near displacement at the nodes of tip s under a unit normal force of tip t."""
    reach, apart = model.contact_reach[0], 0.0
    for d in range(3):
        apart += (state.point[s, d] - state.point[t, d]) ** 2
    state.near[t, s] = np.sqrt(apart) < reach + state.extent[t] + state.extent[s]
    if not state.near[t, s]:
        return
    n, column, position = state.normal[t], state.column[t, s], model.position
    column[: state.n_nodes[s]] = 0.0
    for i in range(state.n_nodes[t]):
        w, j = state.weight[t, i, 0], state.nodes[t, i]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        for q in range(state.n_nodes[s]):
            m = state.nodes[s, q]
            distance = (position[j, 0] - position[m, 0]) ** 2
            distance += (position[j, 1] - position[m, 1]) ** 2
            distance += (position[j, 2] - position[m, 2]) ** 2
            if distance > reach * reach:
                continue
            e = find_block(model.contact_start, model.contact_slot, j, m)
            if e >= 0:
                block = model.contact_block[e]
                for d in range(3):
                    column[q, d] += block[d, 0] * w0 + block[d, 1] * w1 + block[d, 2] * w2


@njit(cache=True, fastmath=True)
def _assemble(model, state):  # type: ignore[no-untyped-def]
    """Compliance between the tips; softer where access fades."""
    n_tools = state.engaged.shape[0]
    for t in range(n_tools):
        if not state.active[t]:
            state.force[t] = 0.0
            continue
        for s in range(t + 1):
            if state.active[s]:
                state.gram[t, s] = state.gram[s, t] = _gram(state, t, s)
        state.scale[t] = np.sqrt(state.self_compliance[t] / state.gram[t, t])
    for t in range(n_tools):
        for s in range(n_tools):
            if state.active[t] and state.active[s]:
                state.compliance[t, s] = state.scale[t] * state.scale[s] * state.gram[t, s]
        if state.active[t]:
            state.compliance[t, t] += model.softness[0] * (1.0 / state.access[t] - 1.0)


@njit(cache=True, fastmath=True)
def _gram(state, t, s):  # type: ignore[no-untyped-def]
    """f_t . C f_s."""
    n, far, near = state.normal[t], np.float32(0.0), 0.0
    for k in range(state.mode.shape[1]):
        far += state.mode[t, k] * state.mode[s, k]
    if state.near[s, t]:
        for i in range(state.n_nodes[t]):
            u = state.column[s, t, i]
            near += state.weight[t, i, 0] * (n[0] * u[0] + n[1] * u[1] + n[2] * u[2])
    return far + near


@njit(cache=True)
def _solve(state):  # type: ignore[no-untyped-def]
    """Projected Gauss-Seidel on 0 <= lambda  perp  gap + C lambda >= 0, from the last forces."""
    n_tools = state.engaged.shape[0]
    for _ in range(MAX_SWEEPS):
        worst = 0.0
        for t in range(n_tools):
            if not state.active[t]:
                continue
            gap = state.gap[t]
            for s in range(n_tools):
                if state.active[s]:
                    gap += state.compliance[t, s] * state.force[s]
            new = max(0.0, state.force[t] - gap / state.compliance[t, t])
            worst = max(worst, abs(new - state.force[t]) * state.compliance[t, t])
            state.force[t] = new
        if worst < GAP_TOLERANCE:
            return True
    return False


@njit(cache=True, fastmath=True)
def _write_forces(model, state, out, tips, several):  # type: ignore[no-untyped-def]
    """Forces on the tools and the contacts that make them."""
    n = 0
    for t in range(state.engaged.shape[0]):
        out.force[t] = 0.0
        out.torque[t] = 0.0
        force, chi = state.force[t], state.access[t]
        if force <= 0.0:
            continue
        for d in range(3):
            out.force[t, d] = force * (state.slope[t, d] + 0.5 * force * state.self_slope[t, d])
            if chi < 1.0:
                fading = -model.softness[0] / (chi * chi) * state.access_slope[t, d]
                out.force[t, d] += 0.5 * force * force * fading
        if several:
            _add_coupling(model, state, out, t)
        gap = state.gap[t] - model.softness[0] * (1.0 / chi - 1.0) * force
        for s in range(state.engaged.shape[0]):
            if state.active[s]:
                gap += state.compliance[t, s] * state.force[s]
        out.contact_tool[n] = t
        out.contact_penetration[n] = max(0.0, -gap)
        for d in range(3):
            out.contact_force[n, d] = out.force[t, d]
            out.contact_normal[n, d] = state.normal[t, d]
            out.contact_position[n, d] = tips[t, d] - model.tip_radius[t] * state.normal[t, d]
        n += 1
    out.n_contacts[0] = n


@njit(cache=True, fastmath=True)
def _add_coupling(model, state, out, t):  # type: ignore[no-untyped-def]
    """lambda_t sum_t' lambda_t' dC_tt'/dp_t, with C_tt' = a_t a_t' f_t . C f_t'."""
    _mode_slope(model, state, t)
    slope, force = state.gram_slope, state.force[t]
    _gram_slope(state, t, t)
    change0 = 0.5 * state.self_slope[t, 0] / state.self_compliance[t] - slope[0] / state.gram[t, t]
    change1 = 0.5 * state.self_slope[t, 1] / state.self_compliance[t] - slope[1] / state.gram[t, t]
    change2 = 0.5 * state.self_slope[t, 2] / state.self_compliance[t] - slope[2] / state.gram[t, t]
    for s in range(state.engaged.shape[0]):
        if s == t or state.force[s] <= 0.0:
            continue
        _gram_slope(state, t, s)
        product, scale = force * state.force[s], state.scale[t] * state.scale[s]
        out.force[t, 0] += product * (state.compliance[t, s] * change0 + scale * slope[0])
        out.force[t, 1] += product * (state.compliance[t, s] * change1 + scale * slope[1])
        out.force[t, 2] += product * (state.compliance[t, s] * change2 + scale * slope[2])


@njit(cache=True, fastmath=True)
def _gram_slope(state, t, s):  # type: ignore[no-untyped-def]
    """(df_t/dp_t) . C f_s."""
    n, turning, slope = state.normal[t], state.turning[t], state.gram_slope
    for d in range(3):
        far = np.float32(0.0)
        for k in range(state.mode.shape[1]):
            far += state.mode_slope[t, d, k] * state.mode[s, k]
        near = 0.0
        if state.near[s, t]:
            for i in range(state.n_nodes[t]):
                w, dw, u = state.weight[t, i, 0], state.weight[t, i, 1 + d], state.column[s, t, i]
                for c in range(3):
                    near += (dw * n[c] + w * turning[c, d]) * u[c]
        slope[d] = far + near


@njit(cache=True, fastmath=True)
def contact_deform(model, state, out):  # type: ignore[no-untyped-def]
    """Second half of a period: the cloud, far field by modes and near field by blocks."""
    cloud, field = out.cloud, state.field
    if out.n_contacts[0] == 0:
        field[:] = np.float32(0.0)
    else:
        _amplitudes(state)
        _far_field(model, state)
        _near_field(model, state)
    for v in range(cloud.shape[0]):
        for d in range(3):
            cloud[v, d] = model.rest[v, d] + field[3 * v + d]
            cloud[v, 3 + d] = field[3 * v + d]


@njit(cache=True, fastmath=True)
def _amplitudes(state):  # type: ignore[no-untyped-def]
    """Far amplitudes - sum_t lambda_t a_t Y^T f_t: the tips press inwards."""
    amplitude = state.amplitude
    amplitude[:] = np.float32(0.0)
    for t in range(state.engaged.shape[0]):
        if state.force[t] > 0.0:
            force = np.float32(state.force[t] * state.scale[t])
            for k in range(amplitude.shape[0]):
                amplitude[k] -= force * state.mode[t, k]


@njit(cache=True, fastmath=True)
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


@njit(cache=True, fastmath=True)
def _near_field(model, state):  # type: ignore[no-untyped-def]
    """The exact remainder around the load positions that carry the forces."""
    for t in range(state.engaged.shape[0]):
        if state.force[t] <= 0.0:
            continue
        kept = 0.0
        for i in range(state.n_nodes[t]):
            if abs(state.weight[t, i, 0]) >= LEAST_WEIGHT:
                kept += state.weight[t, i, 0]
        force = -state.force[t] * state.scale[t] / kept
        for i in range(state.n_nodes[t]):
            w = state.weight[t, i, 0]
            if abs(w) >= LEAST_WEIGHT:
                _add_row(model, state, state.nodes[t, i], w * force, state.normal[t])


@njit(cache=True, fastmath=True)
def _add_row(model, state, j, force, n):  # type: ignore[no-untyped-def]
    u = state.field
    f0, f1, f2 = np.float32(force * n[0]), np.float32(force * n[1]), np.float32(force * n[2])
    for e in range(model.near_start[j], model.near_start[j + 1]):
        v = 3 * model.near_target[e]
        block = model.near_block[e]
        for d in range(3):
            u[v + d] += block[d, 0] * f0 + block[d, 1] * f1 + block[d, 2] * f2
