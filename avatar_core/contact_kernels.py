"""The compiled part of the contact step. No allocation of size, no exception, no I/O.

Each tool tip (sphere, centre p, radius r) presses through one patch, at the surface point below
it, along the normal n = grad phi / |grad phi|. Forces lambda solve the Signorini conditions

    gap = phi(p) - r + sum_t' C_tt' lambda_t' >= 0,   lambda >= 0,   lambda gap = 0,
    C_tt' = n_t . C(s_t, s_t') n_t'                              (projected Gauss-Seidel)

The stored energy W(p) = lambda . C lambda / 2 is a function of the tip positions alone, and the
force on a tip is its exact derivative,

    F_t = - dW/dp_t = lambda_t d/dp_t [ phi(p_t) - n(p_t) . u_bar(s(p_t)) ]    (u_bar held fixed):

the normal force, and the small tangential one by which a frictionless tip slides towards softer
tissue. Without it a closed path would gain or lose energy.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

from avatar_core.shepard import add_weights, find_candidates, number_stencil
from avatar_core.tip_field import FAR, evaluate

MAX_TOOLS = 8
MAX_SWEEPS = 1000

OK, NO_MODEL, NO_POSE, STALE_POSE, INVALID_POSE, NOT_CONVERGED, TOO_MANY, OUT_OF_RANGE = range(8)
UNKNOWN_FRAME = 8

GAP_TOLERANCE = 1e-9  # [m] of gap change that ends Gauss-Seidel
ENTRY_DEPTH = 5e-3  # [m] a centre deeper than this did not come in through the surface
MAX_DEPTH = 25e-3  # [m] of the centre below the surface at rest
MIN_ACCESS = 1e-2  # below, the tip is off the accessible surface
FULL_ACCESS = 0.99  # below, the force fades
_EPSILON = 2e-6  # [m] of the central difference of the frozen gap
_MARGIN = 1e-4  # [m] by which stencils are searched wider

# What the step reads; `prepare` fills it once. Shapes in avatar_core.contact.ContactModel.
ModelArrays = namedtuple(
    "ModelArrays",
    [
        "distance",
        "access",
        "origin",
        "spacing",
        "position",
        "normal",
        "tangent",
        "reach",
        "neighbor",
        "fit",
        "load",
        "contact_start",
        "contact_target",
        "contact_block",
        "contact_distance",
        "contact_reach",
        "softness",
        "space",
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
        "gap",  # (T,) phi - r
        "access",  # (T,) chi
        "access_gradient",  # (T, 3)
        "direction",  # (T, 3) n
        "point",  # (T, 3) s
        "candidates",  # (T, S)
        "n_candidates",  # (T,)
        "local",  # (n_positions,) number in the joint stencil, or -1
        "nodes",  # (T S,) joint stencil
        "n_local",  # (1,)
        "weight",  # (T, T S)
        "mode",  # (T, k) Y^T w n
        "column",  # (T, T S, 3) displacement of the stencil per unit lambda
        "displacement",  # (T S, 3) of the stencil
        "compliance",  # (T, T)
        "trial",  # (T S,) weights at a shifted tip
        "shifted",  # (3, 3) that tip, its direction and surface point
        "amplitude",  # (k,)
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
    """First half of a period: locate, assemble, solve, differentiate. Returns the worst status."""
    status = _locate(model, state, out, tips)
    _number(model, state)
    for t in range(tips.shape[0]):
        _column(model, state, t)
    _assemble(model, state)
    if not _solve(state):
        for t in range(tips.shape[0]):
            if state.n_candidates[t] > 0:
                out.status[t] = NOT_CONVERGED
        status = max(status, NOT_CONVERGED)
    _displace_stencil(state)
    _write_forces(model, state, out, tips)
    return status


@njit(cache=True)
def contact_step(model, state, out, tips):  # type: ignore[no-untyped-def]
    """One period: forces, then the deformed cloud. Returns the worst status."""
    status = contact_solve(model, state, out, tips)
    contact_deform(model, state, out)
    return status


@njit(cache=True)
def _locate(model, state, out, tips):  # type: ignore[no-untyped-def]
    """Gap, direction and surface point of every tip; which tips may touch."""
    worst = OK
    for t in range(tips.shape[0]):
        out.status[t] = _locate_one(model, state, t, tips[t])
        worst = max(worst, out.status[t])
    return worst


@njit(cache=True)
def _locate_one(model, state, t, tip):  # type: ignore[no-untyped-def]
    state.n_candidates[t] = 0
    state.access[t] = 1.0
    engaged = state.engaged[t]
    state.engaged[t] = False
    if not np.isfinite(tip[0] + tip[1] + tip[2]):
        return INVALID_POSE
    phi = _below(model, tip, state.direction[t], state.point[t])
    state.gap[t] = phi - model.tip_radius[t]
    if state.gap[t] >= 0.0:
        return OK
    state.access[t] = evaluate(
        model.access, model.origin, model.spacing[0], tip, state.access_gradient[t], 0.0
    )
    entered = engaged or phi > -ENTRY_DEPTH
    if not entered or phi < -MAX_DEPTH or state.access[t] < MIN_ACCESS:
        return OUT_OF_RANGE
    state.engaged[t] = True
    state.n_candidates[t] = find_candidates(model, state.point[t], _MARGIN, state.candidates[t])
    return OK if state.access[t] >= FULL_ACCESS else OUT_OF_RANGE


@njit(cache=True)
def _below(model, p, direction, point):  # type: ignore[no-untyped-def]
    """phi(p), the unit normal there, and the surface point p - phi n."""
    phi = evaluate(model.distance, model.origin, model.spacing[0], p, direction, FAR)
    length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    scale = 1.0 / length if length > 1e-6 else 0.0
    for d in range(3):
        direction[d] *= scale
        point[d] = p[d] - phi * direction[d]
    return phi


@njit(cache=True)
def _number(model, state):  # type: ignore[no-untyped-def]
    """Number the joint stencil of all tips, and weigh it for each."""
    for q in range(state.n_local[0]):
        state.local[state.nodes[q]] = -1
    n = 0
    for t in range(state.engaged.shape[0]):
        n = number_stencil(
            model, state.candidates[t], state.n_candidates[t], state.local, state.nodes, n
        )
    state.n_local[0] = n
    for t in range(state.engaged.shape[0]):
        if state.n_candidates[t] > 0:
            reached = add_weights(
                model,
                state.candidates[t],
                state.n_candidates[t],
                state.point[t],
                state.direction[t],
                state.local,
                state.weight[t, :n],
            )
            if not reached:
                state.n_candidates[t] = 0


@njit(cache=True, fastmath=True)
def _column(model, state, t):  # type: ignore[no-untyped-def]
    """Displacement of the joint stencil under a unit normal force of tip t: C w n."""
    if state.n_candidates[t] == 0:
        return
    n_modes = model.load.shape[2]
    n = state.direction[t]
    mode = state.mode[t]
    for k in range(n_modes):
        mode[k] = 0.0
    for q in range(state.n_local[0]):
        w = state.weight[t, q]
        if w != 0.0:
            j = state.nodes[q]
            w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
            for k in range(n_modes):
                mode[k] += (
                    model.load[j, 0, k] * w0 + model.load[j, 1, k] * w1 + model.load[j, 2, k] * w2
                )
    for q in range(state.n_local[0]):
        j = state.nodes[q]
        u0 = u1 = u2 = np.float32(0.0)
        for k in range(n_modes):
            u0 += model.load[j, 0, k] * mode[k]
            u1 += model.load[j, 1, k] * mode[k]
            u2 += model.load[j, 2, k] * mode[k]
        column = state.column[t, q]
        column[0], column[1], column[2] = u0, u1, u2
    radius, together = _stencil_extent(model, state, t)
    for p in range(state.n_local[0]):
        w = state.weight[t, p]
        if w == 0.0:
            continue
        j = state.nodes[p]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        limit = np.float32(np.inf if together else radius + _from_point(model, state, t, j))
        for e in range(model.contact_start[j], model.contact_start[j + 1]):
            if model.contact_distance[e] > limit:
                break
            q = state.local[model.contact_target[e]]
            if q >= 0:
                for d in range(3):
                    state.column[t, q, d] += (
                        model.contact_block[e, d, 0] * w0
                        + model.contact_block[e, d, 1] * w1
                        + model.contact_block[e, d, 2] * w2
                    )


@njit(cache=True, fastmath=True)
def _from_point(model, state, t, j):  # type: ignore[no-untyped-def]
    """Distance of load position j from the surface point under tip t [m]."""
    squared = 0.0
    for d in range(3):
        squared += (model.position[j, d] - state.point[t, d]) ** 2
    return np.sqrt(squared)


@njit(cache=True, fastmath=True)
def _stencil_extent(model, state, t):  # type: ignore[no-untyped-def]
    """Radius of the stencil of tip t [m], and whether another tip may share its near field.

    Blocks are sorted by distance, so that the search for a lone stencil can stop early.
    """
    radius = 0.0
    for q in range(state.n_local[0]):
        if state.weight[t, q] != 0.0:
            radius = max(radius, _from_point(model, state, t, state.nodes[q]))
    together = False
    for s in range(state.engaged.shape[0]):
        if s != t and state.n_candidates[s] > 0:
            squared = 0.0
            for d in range(3):
                squared += (state.point[s, d] - state.point[t, d]) ** 2
            if np.sqrt(squared) < model.contact_reach[0] + 2.0 * radius:
                together = True
    return radius + 1e-6, together


@njit(cache=True)
def _assemble(model, state):  # type: ignore[no-untyped-def]
    """Compliance between the tips; softer where access fades."""
    n_tools = state.engaged.shape[0]
    for t in range(n_tools):
        for s in range(n_tools):
            value = 0.0
            if state.n_candidates[t] > 0 and state.n_candidates[s] > 0:
                for q in range(state.n_local[0]):
                    w = state.weight[t, q]
                    if w != 0.0:
                        for d in range(3):
                            value += w * state.direction[t, d] * state.column[s, q, d]
            state.compliance[t, s] = value
        if state.n_candidates[t] > 0:
            chi = min(state.access[t], 1.0)
            state.compliance[t, t] += model.softness[0] * (1.0 / chi - 1.0)
        else:
            state.force[t] = 0.0


@njit(cache=True)
def _solve(state):  # type: ignore[no-untyped-def]
    """Projected Gauss-Seidel on 0 <= lambda  perp  gap + C lambda >= 0, from the last forces."""
    n_tools = state.engaged.shape[0]
    for _ in range(MAX_SWEEPS):
        worst = 0.0
        for t in range(n_tools):
            if state.n_candidates[t] == 0:
                continue
            gap = state.gap[t]
            for s in range(n_tools):
                gap += state.compliance[t, s] * state.force[s]
            new = max(0.0, state.force[t] - gap / state.compliance[t, t])
            worst = max(worst, abs(new - state.force[t]) * state.compliance[t, t])
            state.force[t] = new
        if worst < GAP_TOLERANCE:
            return True
    return False


@njit(cache=True)
def _displace_stencil(state):  # type: ignore[no-untyped-def]
    for q in range(state.n_local[0]):
        for d in range(3):
            state.displacement[q, d] = 0.0
    for t in range(state.engaged.shape[0]):
        if state.force[t] > 0.0:
            for q in range(state.n_local[0]):
                for d in range(3):
                    state.displacement[q, d] -= state.force[t] * state.column[t, q, d]


@njit(cache=True)
def _frozen_gap(model, state, t, p, direction, point):  # type: ignore[no-untyped-def]
    """phi(p) - n(p) . u_bar(s(p)) with the displacement of the stencil held fixed."""
    phi = _below(model, p, direction, point)
    n = state.n_local[0]
    trial = state.trial[:n]
    add_weights(
        model, state.candidates[t], state.n_candidates[t], point, direction, state.local, trial
    )
    gap = phi
    for q in range(n):
        w = trial[q]
        if w != 0.0:
            for d in range(3):
                gap -= w * direction[d] * state.displacement[q, d]
    return gap


@njit(cache=True)
def _write_forces(model, state, out, tips):  # type: ignore[no-untyped-def]
    """Forces on the tools and the contacts that make them."""
    p, direction, point = state.shifted[0], state.shifted[1], state.shifted[2]
    n = 0
    for t in range(tips.shape[0]):
        for d in range(3):
            out.force[t, d] = out.torque[t, d] = 0.0
        force = state.force[t]
        if force <= 0.0:
            continue
        chi = min(state.access[t], 1.0)
        gap = state.gap[t] - model.softness[0] * (1.0 / chi - 1.0) * force
        for s in range(tips.shape[0]):
            gap += state.compliance[t, s] * state.force[s]
        out.contact_penetration[n] = max(0.0, -gap)
        out.contact_tool[n] = t
        fade = 0.5 * force * force * model.softness[0] / (chi * chi) if chi < 1.0 else 0.0
        for d in range(3):
            p[0], p[1], p[2] = tips[t, 0], tips[t, 1], tips[t, 2]
            p[d] += _EPSILON
            up = _frozen_gap(model, state, t, p, direction, point)
            p[d] -= 2.0 * _EPSILON
            down = _frozen_gap(model, state, t, p, direction, point)
            slope = (up - down) / (2.0 * _EPSILON)
            out.force[t, d] = force * slope - fade * state.access_gradient[t, d]
            out.contact_force[n, d] = out.force[t, d]
            out.contact_normal[n, d] = state.direction[t, d]
            moved = state.point[t, d]
            for q in range(state.n_local[0]):
                moved += state.weight[t, q] * state.displacement[q, d]
            out.contact_position[n, d] = moved
        n += 1
    out.n_contacts[0] = n


@njit(cache=True, fastmath=True)
def contact_deform(model, state, out):  # type: ignore[no-untyped-def]
    """Second half of a period: the cloud, far field by modes and near field by blocks."""
    cloud, amplitude = out.cloud, state.amplitude
    n_modes = model.space.shape[2]
    for k in range(n_modes):
        amplitude[k] = 0.0
    touched = False
    for t in range(state.engaged.shape[0]):
        if state.force[t] > 0.0:
            touched = True
            force = np.float32(state.force[t])
            for k in range(n_modes):
                amplitude[k] -= force * state.mode[t, k]
    if not touched:
        for v in range(cloud.shape[0]):
            for d in range(3):
                cloud[v, d] = model.rest[v, d]
                cloud[v, 3 + d] = 0.0
        return
    for v in range(cloud.shape[0]):
        u0 = u1 = u2 = np.float32(0.0)
        for k in range(n_modes):
            u0 += model.space[v, 0, k] * amplitude[k]
            u1 += model.space[v, 1, k] * amplitude[k]
            u2 += model.space[v, 2, k] * amplitude[k]
        cloud[v, 3], cloud[v, 4], cloud[v, 5] = u0, u1, u2
    for q in range(state.n_local[0]):
        f0 = f1 = f2 = np.float32(0.0)
        for t in range(state.engaged.shape[0]):
            if state.force[t] > 0.0:
                w = -state.weight[t, q] * state.force[t]
                f0 += np.float32(w * state.direction[t, 0])
                f1 += np.float32(w * state.direction[t, 1])
                f2 += np.float32(w * state.direction[t, 2])
        if f0 == 0.0 and f1 == 0.0 and f2 == 0.0:
            continue
        j = state.nodes[q]
        for e in range(model.near_start[j], model.near_start[j + 1]):
            v = model.near_target[e]
            for d in range(3):
                cloud[v, 3 + d] += (
                    model.near_block[e, d, 0] * f0
                    + model.near_block[e, d, 1] * f1
                    + model.near_block[e, d, 2] * f2
                )
    for v in range(cloud.shape[0]):
        for d in range(3):
            cloud[v, d] = model.rest[v, d] + cloud[v, 3 + d]
