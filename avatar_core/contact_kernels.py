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

With large deformation (:mod:`avatar_core.large_deformation`) the depth of a tip is bent: to
C_tt lambda_t comes h(a_t), a_t = gamma lambda_t, to the energy what belongs to it, and to the force
its derivative. h ends as its tangent beyond the reach that was computed.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

from avatar_core.cloud_kernels import contact_deform
from avatar_core.near_field import find_block
from avatar_core.splines import cell_at, in_cell, on_grid, second_derivatives
from avatar_core.tip_response import gather

MAX_TOOLS = 8
MAX_SWEEPS = 1000

OK, NO_MODEL, NO_POSE, STALE_POSE, INVALID_POSE, NOT_CONVERGED, TOO_MANY, OUT_OF_RANGE = range(8)
UNKNOWN_FRAME, EXTRAPOLATED = 8, 9

# A tip that did not come in through the surface is barred until it is outside again: a contact
# that began at depth would give back energy that nobody put in.
OUTSIDE, ENTERED, BARRED = range(3)

GAP_TOLERANCE = 1e-9  # [m] of gap change that ends Gauss-Seidel
ENTRY_DEPTH = 5e-3  # [m] a centre deeper than this did not come in through the surface
MAX_DEPTH = 25e-3  # [m] of the centre below the surface at rest
MIN_ACCESS = 1e-2  # below, the tip is off the accessible surface
FULL_ACCESS = 0.99  # below, the force fades

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
        "bend",
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
        "bend_load",
        "bend_near",
        "rest",
        "tip_radius",
    ],
)

# What the step keeps between calls (passage, force) and its scratch.
State = namedtuple(
    "State",
    [
        "passage",  # (T,) whether the tip came in through the surface: OUTSIDE, ENTERED, BARRED
        "force",  # (T,) lambda
        "active",  # (T,) the tip is closer than its radius, where it may touch
        "gap",  # (T,) phi - r
        "slope",  # (T, 3) grad phi
        "steepness",  # (T,) |grad phi|
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
        "bend",  # (T, 3) beta_2, beta_3 and the reach
        "bend_slope",  # (T, 3, 3) their gradients
        "bent",  # (T, 4) h, dh/da, its integral, d2h/da2 at the reach
        "gram",  # (T, T) f_t . C f_t'
        "scale",  # (T,) a_t
        "compliance",  # (T, T)
        "gram_slope",  # (3,) d(f_t . C f_t')/dp_t
        "amplitude",  # (rank,) of the far field, and last of what large deformation adds
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
            _mode(model, state, t)
            _measure_extent(model, state, t)
    for t in range(n_tools):
        for s in range(t + 1):
            if state.active[t] and state.active[s]:
                _near_columns(model, state, t, s)
    _assemble(model, state)
    if not _solve(state, model.bend.shape[0] > 0):
        for t in range(n_tools):
            if state.active[t]:
                out.status[t] = NOT_CONVERGED
        status = max(status, NOT_CONVERGED)
    _write_forces(model, state, out, tips, n_active > 1)
    for t in range(n_tools):
        status = max(status, out.status[t])
    return status


@njit(cache=True)
def contact_step(model, state, out, tips):  # type: ignore[no-untyped-def]
    """One period: forces, then the deformed cloud. Returns the worst status."""
    status = contact_solve(model, state, out, tips)
    contact_deform(model, state, out)
    return status


@njit(cache=True, forceinline=True)
def _locate(model, state, t, tip):  # type: ignore[no-untyped-def]
    """Gap, normal, access, compliance, surface point and load positions of a tip, if it touches."""
    state.active[t] = False
    state.access[t] = 1.0
    before = state.passage[t]
    state.passage[t] = OUTSIDE
    if not np.isfinite(tip[0] + tip[1] + tip[2]):
        return INVALID_POSE
    if not on_grid(model.distance.shape, model.origin, model.spacing[0], tip):
        return OK
    cell = cell_at(model.origin, model.spacing[0], tip)
    phi = in_cell(model.distance, cell, state.slope[t])
    state.gap[t] = phi - model.tip_radius[t]
    if state.gap[t] >= 0.0:
        return OK
    access = in_cell(model.access, cell, state.access_slope[t])
    state.access[t] = min(access, 1.0)
    if access < MIN_ACCESS:
        return OUT_OF_RANGE
    deepest = MAX_DEPTH if before == ENTERED else ENTRY_DEPTH
    if before == BARRED or phi < -deepest:
        state.passage[t] = BARRED
        return OUT_OF_RANGE
    state.passage[t] = ENTERED
    state.active[t] = True
    _direct(state, t, tip, phi)
    state.self_compliance[t] = in_cell(model.self_compliance, cell, state.self_slope[t])
    for k in range(model.bend.shape[0]):
        state.bend[t, k] = in_cell(model.bend[k], cell, state.bend_slope[t, k])
    gather(model, state, t, cell)
    return OK if access >= FULL_ACCESS else OUT_OF_RANGE


@njit(cache=True, forceinline=True)
def _direct(state, t, p, phi):  # type: ignore[no-untyped-def]
    """n = g / |g| with g = grad phi, and s = p - phi n."""
    g = state.slope[t]
    state.steepness[t] = max(np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2), 1e-3)
    for d in range(3):
        state.normal[t, d] = g[d] / state.steepness[t]
        state.point[t, d] = p[d] - phi * state.normal[t, d]


@njit(cache=True, fastmath=True, forceinline=True)
def _turn(model, state, t, p):  # type: ignore[no-untyped-def]
    """dn/dp = (I - n n^T) grad g / |g|."""
    n, hessian = state.normal[t], state.hessian
    cell = cell_at(model.origin, model.spacing[0], p)
    second_derivatives(model.distance, cell, model.spacing[0], hessian)
    for d in range(3):
        along = n[0] * hessian[0, d] + n[1] * hessian[1, d] + n[2] * hessian[2, d]
        for i in range(3):
            state.turning[t, i, d] = (hessian[i, d] - n[i] * along) / state.steepness[t]


@njit(cache=True, fastmath=True, forceinline=True)
def _mode(model, state, t):  # type: ignore[no-untyped-def]
    """Y^T f: how a unit normal force of tip t drives the modes."""
    mode, n = state.mode[t], state.normal[t]
    mode[:] = np.float32(0.0)
    for i in range(state.n_nodes[t]):
        w, load = state.weight[t, i, 0], model.load[state.nodes[t, i]]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        for k in range(mode.shape[0]):
            mode[k] += w0 * load[0, k] + w1 * load[1, k] + w2 * load[2, k]


@njit(cache=True, fastmath=True, forceinline=True)
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


@njit(cache=True, fastmath=True, forceinline=True)
def _measure_extent(model, state, t):  # type: ignore[no-untyped-def]
    farthest = 0.0
    for i in range(state.n_nodes[t]):
        j, squared = state.nodes[t, i], 0.0
        for d in range(3):
            squared += (model.position[j, d] - state.point[t, d]) ** 2
        farthest = max(farthest, squared)
    state.extent[t] = np.sqrt(farthest)


@njit(cache=True, fastmath=True, forceinline=True)
def _near_columns(model, state, t, s):  # type: ignore[no-untyped-def]
    """Near displacement at the nodes of tip s under a unit normal force of tip t, and back.

    By Maxwell and Betti the block from m to j is that from j to m transposed: each is read once.
    """
    reach, apart = model.contact_reach[0], 0.0
    for d in range(3):
        apart += (state.point[s, d] - state.point[t, d]) ** 2
    near = np.sqrt(apart) < reach + state.extent[t] + state.extent[s]
    state.near[t, s] = state.near[s, t] = near
    if not near:
        return
    there, back = state.column[t, s], state.column[s, t]
    there[: state.n_nodes[s]] = np.float32(0.0)
    back[: state.n_nodes[t]] = np.float32(0.0)
    n, m, zero = state.normal[t], state.normal[s], np.float32(0.0)
    for i in range(state.n_nodes[t]):
        j, w = state.nodes[t, i], state.weight[t, i, 0]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        u0 = u1 = u2 = zero
        for q in range(i + 1 if s == t else state.n_nodes[s]):
            e = find_block(model.contact_start, model.contact_slot, j, state.nodes[s, q])
            if e < 0:
                continue
            b = model.contact_block[e]
            there[q, 0] += b[0, 0] * w0 + b[0, 1] * w1 + b[0, 2] * w2
            there[q, 1] += b[1, 0] * w0 + b[1, 1] * w1 + b[1, 2] * w2
            there[q, 2] += b[2, 0] * w0 + b[2, 1] * w1 + b[2, 2] * w2
            w = state.weight[s, q, 0] if s != t or q != i else 0.0
            v0, v1, v2 = np.float32(w * m[0]), np.float32(w * m[1]), np.float32(w * m[2])
            u0 += b[0, 0] * v0 + b[1, 0] * v1 + b[2, 0] * v2
            u1 += b[0, 1] * v0 + b[1, 1] * v1 + b[2, 1] * v2
            u2 += b[0, 2] * v0 + b[1, 2] * v1 + b[2, 2] * v2
        back[i, 0] += u0
        back[i, 1] += u1
        back[i, 2] += u2


@njit(cache=True, fastmath=True, forceinline=True)
def _assemble(model, state):  # type: ignore[no-untyped-def]
    """Compliance between the tips; softer where access fades."""
    n_tools = state.passage.shape[0]
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


@njit(cache=True, fastmath=True, forceinline=True)
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


@njit(cache=True, fastmath=True, forceinline=True)
def _bend(state, t):  # type: ignore[no-untyped-def]
    """h(a) = beta_2 a^2 + beta_3 a^3 at the present force, its slope and integral."""
    a = state.self_compliance[t] * state.force[t]
    b2, b3, reach = state.bend[t, 0], state.bend[t, 1], state.bend[t, 2]
    inside = min(a, reach)
    over = a - inside
    h = inside * inside * (b2 + b3 * inside)
    slope = inside * (2.0 * b2 + 3.0 * b3 * inside)
    whole = inside**3 * (b2 / 3.0 + b3 * inside / 4.0)
    state.bent[t, 0] = h + slope * over
    state.bent[t, 1] = slope
    state.bent[t, 2] = whole + over * (h + 0.5 * slope * over)
    state.bent[t, 3] = 2.0 * b2 + 6.0 * b3 * reach


@njit(cache=True, fastmath=True, forceinline=True)
def _add_bending(state, out, t):  # type: ignore[no-untyped-def]
    """d/dp of the energy H = 1/gamma int_0^a h, at fixed force."""
    gamma, reach = state.self_compliance[t], state.bend[t, 2]
    a = gamma * state.force[t]
    inside = min(a, reach)
    over = a - inside
    # derivatives of int h by beta_2, beta_3 and the reach, and of H by gamma
    by2 = inside**3 / 3.0 + over * (inside**2 + inside * over)
    by3 = inside**4 / 4.0 + over * (inside**3 + 1.5 * inside**2 * over)
    by_reach = 0.5 * state.bent[t, 3] * over * over
    by_gamma = (state.bent[t, 0] * a - state.bent[t, 2]) / gamma
    for d in range(3):
        change = by2 * state.bend_slope[t, 0, d] + by3 * state.bend_slope[t, 1, d]
        change += by_reach * state.bend_slope[t, 2, d] + by_gamma * state.self_slope[t, d]
        out.force[t, d] += change / gamma


@njit(cache=True, forceinline=True)
def _solve(state, bends):  # type: ignore[no-untyped-def]
    """Projected Gauss-Seidel on 0 <= lambda  perp  gap + C lambda + h >= 0, from the last forces.

    Where the depth is bent each update is one of Newton's.
    """
    n_tools = state.passage.shape[0]
    for _ in range(MAX_SWEEPS):
        worst = 0.0
        for t in range(n_tools):
            if not state.active[t]:
                continue
            gap = state.gap[t]
            for s in range(n_tools):
                if state.active[s]:
                    gap += state.compliance[t, s] * state.force[s]
            stiff = state.compliance[t, t]
            if bends:
                _bend(state, t)
                gap += state.bent[t, 0]
                stiff += state.bent[t, 1] * state.self_compliance[t]
            new = max(0.0, state.force[t] - gap / stiff)
            worst = max(worst, abs(new - state.force[t]) * stiff)
            state.force[t] = new
        if worst < GAP_TOLERANCE:
            return True
    return False


@njit(cache=True, fastmath=True, forceinline=True)
def _write_forces(model, state, out, tips, several):  # type: ignore[no-untyped-def]
    """Forces on the tools and the contacts that make them."""
    n = 0
    for t in range(state.passage.shape[0]):
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
            _turn(model, state, t, tips[t])
            _add_coupling(model, state, out, t)
        gap = state.gap[t] - model.softness[0] * (1.0 / chi - 1.0) * force
        if model.bend.shape[0] > 0:
            _bend(state, t)
            _add_bending(state, out, t)
            gap += state.bent[t, 0]
            if state.self_compliance[t] * force > state.bend[t, 2] and out.status[t] == OK:
                out.status[t] = EXTRAPOLATED
        for s in range(state.passage.shape[0]):
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


@njit(cache=True, fastmath=True, forceinline=True)
def _add_coupling(model, state, out, t):  # type: ignore[no-untyped-def]
    """lambda_t sum_t' lambda_t' dC_tt'/dp_t, with C_tt' = a_t a_t' f_t . C f_t'."""
    _mode_slope(model, state, t)
    slope, force = state.gram_slope, state.force[t]
    _gram_slope(state, t, t)
    change0 = 0.5 * state.self_slope[t, 0] / state.self_compliance[t] - slope[0] / state.gram[t, t]
    change1 = 0.5 * state.self_slope[t, 1] / state.self_compliance[t] - slope[1] / state.gram[t, t]
    change2 = 0.5 * state.self_slope[t, 2] / state.self_compliance[t] - slope[2] / state.gram[t, t]
    for s in range(state.passage.shape[0]):
        if s == t or state.force[s] <= 0.0:
            continue
        _gram_slope(state, t, s)
        product, scale = force * state.force[s], state.scale[t] * state.scale[s]
        out.force[t, 0] += product * (state.compliance[t, s] * change0 + scale * slope[0])
        out.force[t, 1] += product * (state.compliance[t, s] * change1 + scale * slope[1])
        out.force[t, 2] += product * (state.compliance[t, s] * change2 + scale * slope[2])


@njit(cache=True, fastmath=True, forceinline=True)
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
