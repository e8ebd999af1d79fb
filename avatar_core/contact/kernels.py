"""The compiled contact step. No allocation of size, no exception, no I/O.

Each tool tip (sphere, centre p, radius r) presses through one patch, at the surface point below
it, along the normal n = grad phi / |grad phi|. Forces lambda solve the Signorini conditions

    gap_t = phi(p_t) - r_t,   gap_t + sum_t' C_tt' lambda_t' >= 0,   lambda >= 0,  complementary,

by projected Gauss-Seidel, C as in :mod:`avatar_core.contact.tip_response`. The stored energy W is a
function of the tip positions alone, and the force on a tip is its exact derivative, F = - dW/dp.
For one tip on an organ at rest, W = lambda gamma lambda / 2,

    F = lambda [ grad phi + lambda grad gamma / 2 ]:

the normal force, and the small tangential one by which a frictionless tip slides towards softer
tissue. Without it a closed path would gain or lose energy.

The arguments after ``tips`` are the effects of a scene (:mod:`avatar_core.contact.effects`), each
None or the arrays that it works on. numba compiles the step anew for every selection: of an effect
that is
None, no instruction is left. ``reply`` is there with any effect for which one tip is not alone with
an organ at rest (:mod:`avatar_core.contact.superposition`).
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from avatar_core.common.jit import entry, fast, inlined
from avatar_core.common.splines import cell_at, in_cell, on_grid, value_in_cell
from avatar_core.contact.cloud_kernels import deform
from avatar_core.contact.effects import friction as stick_slip
from avatar_core.contact.effects import inertia as swing
from avatar_core.contact.effects import large_deformation as bending
from avatar_core.contact.effects import respiration as breath
from avatar_core.contact.effects import several_tools as coupling
from avatar_core.contact.effects import viscoelasticity as relaxation
from avatar_core.contact.superposition import add_superposed_force, lift_tip, superpose
from avatar_core.contact.tip_compliance import (
    assemble_own,
    mode,
    near_along_normal,
    near_column,
    near_gram,
)
from avatar_core.contact.tip_response import gather

MAX_TOOLS = 8
MAX_SWEEPS = 1000

OK, NO_MODEL, NO_POSE, STALE_POSE, INVALID_POSE, NOT_CONVERGED, TOO_MANY, OUT_OF_RANGE = range(8)
UNKNOWN_FRAME, EXTRAPOLATED = 8, 9

# A tip that did not come in through the surface is barred until it is outside again: a contact
# that began at depth would give back energy that nobody put in.
OUTSIDE, ENTERED, BARRED = range(3)

PATIENCE = 8  # sweeps before the exact solution is worth its time,
MAX_EXACT = 64  # and after which it has not helped
GAP_TOLERANCE = 1e-9  # [m] of gap change that ends Gauss-Seidel
ENTRY_DEPTH = 5e-3  # [m] a centre deeper than this did not come in through the surface
LEAP = 50e-3  # [m] in a period: whoever is that far off did not move there, but comes in anew
MAX_DEPTH = 25e-3  # [m] of the centre below the surface at rest
MIN_ACCESS = 1e-2  # below, the tip is off the accessible surface
FULL_ACCESS = 0.99  # below, the force fades

# What the step reads; `prepare` fills it once. Shapes in avatar_core.contact.layout.Layout.
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
        "force_error",
        "position",
        "load",
        "contact_start",
        "contact_slot",
        "contact_block",
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

# What the step keeps between calls (passage, seen, active, force) and its scratch.
State = namedtuple(
    "State",
    [
        "passage",  # (T,) whether the tip came in through the surface: OUTSIDE, ENTERED, BARRED
        "seen",  # (T, 3) the last valid tip that was in contact [m]
        "force",  # (T,) lambda
        "active",  # (T,) the tip is closer than its radius, where it may touch
        "gap",  # (T,) phi - r
        "slope",  # (T, 3) grad phi
        "steepness",  # (T,) |grad phi|
        "normal",  # (T, 3) n
        "access",  # (T,) chi
        "access_slope",  # (T, 3)
        "point",  # (T, 3) s
        "local",  # (n_positions,) scratch of gather, all -1
        "nodes",  # (T, MAX_STENCIL) load positions that carry the tip
        "n_nodes",  # (T,)
        "weight",  # (T, MAX_STENCIL, 4) w and its gradient
        "mode",  # (T, k) Y^T f
        "column",  # (T, MAX_STENCIL, 3) near displacement at the nodes by a unit normal force
        "self_compliance",  # (T,) gamma
        "self_slope",  # (T, 3) grad gamma
        "gram",  # (T, T) f_t . C f_t'
        "scale",  # (T,) a_t
        "compliance",  # (T, T)
        "shown",  # (1,) modes of the far field that the cloud shows
        "amplitude",  # (rank,) of the far field, and last of what large deformation adds
        "field",  # (n_blocks BLOCK,) displacement of the cloud, component after component
    ],
)

Out = namedtuple(
    "Out",
    [
        "force",
        "torque",
        "force_error",
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


@entry
def contact_step(  # type: ignore[no-untyped-def]
    model, state, out, tips, reply, several, large, friction, memory, inertia, weight, motion
):
    """One period: forces, then the deformed cloud. Returns the worst status."""
    status = _solve_period(
        model, state, out, tips, reply, several, large, friction, memory, inertia, weight, motion
    )
    deform(model, state, out, reply, large, friction, memory, motion)
    return status


@entry
def contact_solve(  # type: ignore[no-untyped-def]
    model, state, out, tips, reply, several, large, friction, memory, inertia, weight, motion
):
    """First half of a period: forces and contacts."""
    return _solve_period(
        model, state, out, tips, reply, several, large, friction, memory, inertia, weight, motion
    )


@entry
def contact_deform(  # type: ignore[no-untyped-def]
    model, state, out, reply, large, friction, memory, motion
):
    """Second half: the cloud under the forces of the first."""
    deform(model, state, out, reply, large, friction, memory, motion)


@entry
def force_error(model, out, tips):  # type: ignore[no-untyped-def]
    """How wrong the forces of a period may be: the relative error at the tip, times the force."""
    for t in range(tips.shape[0]):
        force = out.force[t]
        size = np.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
        out.force_error[t] = 0.0
        if size > 0.0:
            cell = cell_at(model.origin, model.spacing[0], tips[t])
            out.force_error[t] = size * value_in_cell(model.force_error, cell)


@inlined
def _solve_period(  # type: ignore[no-untyped-def]
    model, state, out, tips, reply, several, large, friction, memory, inertia, weight, motion
):
    """Locate, assemble, solve, differentiate. ``tips`` may change."""
    if motion is not None:
        breath.into_organ(motion, tips)
    status = OK
    for t in range(tips.shape[0]):
        out.status[t] = locate(model, state, t, tips[t], reply)
        status = max(status, out.status[t])
        if not state.active[t]:
            state.force[t] = 0.0
            continue
        mode(model, state, t)
        if reply is not None:
            near_column(model, state, t)
            near = near_along_normal(state, t, state.column[t])
        else:
            near = near_gram(model, state, t)
        assemble_own(model, state, t, near)
        if large is not None:
            bending.sample(model, large, t, tips[t])
        if friction is not None:
            stick_slip.gather(model, state, friction, t)
    if several is not None:
        coupling.connect(model, state, several, friction)
    if reply is not None:
        _expect(reply, memory, inertia, weight)
        for t in range(tips.shape[0]):
            if state.active[t]:
                lift_tip(model, state, reply, memory, t)
        _assemble_moving(state, reply, memory, inertia)
    if several is not None and friction is None:
        coupling.assemble(state, reply, several)
    if friction is not None:
        converged = stick_slip.solve(model, state, tips, reply, several, large, friction)
    elif several is not None or large is not None:
        converged = solve_together(state, reply, several, large)
    else:
        converged = solve_alone(state, reply)
    if not converged:
        for t in range(tips.shape[0]):
            if state.active[t]:
                out.status[t] = NOT_CONVERGED
    if reply is not None:
        superpose(state, reply, friction)
    write_forces(model, state, out, tips, reply, several, large, friction, memory)
    if memory is not None:
        relaxation.remember(state, reply, memory, friction, weight)
    if inertia is not None:
        swing.advance(reply, inertia)
    if motion is not None:
        breath.out_of_organ(motion, out)
    for t in range(tips.shape[0]):
        status = max(status, out.status[t])
    return status


@inlined
def locate(model, state, t, tip, reply):  # type: ignore[no-untyped-def]
    """Gap, normal, access, compliance, surface point and load positions of a tip, if it touches."""
    before, goes_on = state.passage[t], _goes_on(state, t, tip)
    state.active[t] = False
    state.access[t] = 1.0
    if not np.isfinite(tip[0] + tip[1] + tip[2]):
        return INVALID_POSE  # wherever the tip is: it may well be where it was
    state.passage[t] = OUTSIDE
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
    deepest = MAX_DEPTH if before == ENTERED and goes_on else ENTRY_DEPTH
    if before == BARRED or phi < -deepest:
        state.passage[t] = BARRED
        return OUT_OF_RANGE
    state.passage[t] = ENTERED
    state.active[t] = True
    for d in range(3):
        state.seen[t, d] = tip[d]
    if not goes_on:
        state.force[t] = 0.0
    _direct(state, t, tip, phi)
    state.self_compliance[t] = in_cell(model.self_compliance, cell, state.self_slope[t])
    gather(model, state, t, cell, reply)
    return OK if access >= FULL_ACCESS else OUT_OF_RANGE


@inlined
def _goes_on(state, t, tip):  # type: ignore[no-untyped-def]
    """Whether a tip in contact is where it can have moved from its last contact.

    After invalid poses nobody has seen it move: as deep as a contact may begin, it may have.
    """
    square = 0.0
    for d in range(3):
        square += (tip[d] - state.seen[t, d]) ** 2
    farthest = LEAP if state.active[t] else ENTRY_DEPTH
    return square < farthest * farthest


@inlined
def _direct(state, t, p, phi):  # type: ignore[no-untyped-def]
    """n = g / |g| with g = grad phi, and s = p - phi n."""
    g = state.slope[t]
    state.steepness[t] = max(np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2), 1e-3)
    for d in range(3):
        state.normal[t, d] = g[d] / state.steepness[t]
        state.point[t, d] = p[d] - phi * state.normal[t, d]


@inlined
def _expect(reply, memory, inertia, weight):  # type: ignore[no-untyped-def]
    """Where the modes would be at the end of the period without any force, and their gain."""
    if memory is not None:
        relaxation.expect(memory)
    if inertia is not None:
        swing.expect(reply, inertia, memory, weight)
    elif memory is not None:
        relaxation.expect_modes(reply, memory, weight)
    elif weight is not None:
        for k in range(reply.free.shape[0]):
            reply.free[k] = weight.amplitude[k]
    if memory is not None:
        reply.near_gain[0] = memory.gain[0]


@fast
def _assemble_moving(state, reply, memory, inertia):  # type: ignore[no-untyped-def]
    """The part of a tip's compliance that answers within the period."""
    for t in range(state.passage.shape[0]):
        if not state.active[t]:
            continue
        if inertia is not None:
            far, near = 0.0, near_along_normal(state, t, state.column[t])
            for k in range(state.mode.shape[1]):
                far += reply.gain[k] * state.mode[t, k] * state.mode[t, k]
            moving = state.scale[t] ** 2 * (far + reply.near_gain[0] * near)
            state.compliance[t, t] += moving - state.self_compliance[t]
        elif memory is not None:
            state.compliance[t, t] += (memory.gain[0] - 1.0) * state.self_compliance[t]


@inlined
def solve_alone(state, reply):  # type: ignore[no-untyped-def]
    """0 <= lambda  perp  gap + C lambda >= 0, each tip for itself."""
    for t in range(state.passage.shape[0]):
        if state.active[t]:
            gap = state.gap[t]
            if reply is not None:
                gap -= reply.lift[t]
            state.force[t] = max(0.0, -gap / state.compliance[t, t])
    return True


@inlined
def solve_together(state, reply, several, large):  # type: ignore[no-untyped-def]
    """Projected Gauss-Seidel on 0 <= lambda  perp  gap + C lambda + h >= 0, from the last forces.

    Where the depth is bent each update is one of Newton's. Tips close to each other share forces
    that sweeps hardly change: then the sweeps start again from the exact solution.
    """
    n_tools = state.passage.shape[0]
    for sweep in range(MAX_SWEEPS):
        if several is not None and sweep < MAX_EXACT and sweep % PATIENCE == PATIENCE - 1:
            coupling.share(state, reply, several, large)
        worst = 0.0
        for t in range(n_tools):
            if not state.active[t]:
                continue
            stiff = state.compliance[t, t]
            gap = state.gap[t] + stiff * state.force[t]
            if reply is not None:
                gap -= reply.lift[t]
            if several is not None:
                for s in range(n_tools):
                    if s != t and state.active[s]:
                        gap += state.compliance[t, s] * state.force[s]
            if large is not None:
                bending.bend(state, large, t)
                gap += large.bent[t, 0]
                stiff += large.bent[t, 1] * state.self_compliance[t]
            new = max(0.0, state.force[t] - gap / stiff)
            worst = max(worst, abs(new - state.force[t]) * stiff)
            state.force[t] = new
        if worst < GAP_TOLERANCE:
            return True
    return False


@fast
def write_forces(  # type: ignore[no-untyped-def]
    model, state, out, tips, reply, several, large, friction, memory
):
    """Forces on the tools and the contacts that make them."""
    n = 0
    for t in range(state.passage.shape[0]):
        out.force[t] = 0.0
        out.torque[t] = 0.0
        force, chi = state.force[t], state.access[t]
        if force <= 0.0:
            continue
        if reply is not None:
            add_superposed_force(
                model, state, out, tips, reply, several, large, friction, memory, t
            )
        else:
            for d in range(3):
                out.force[t, d] = force * (state.slope[t, d] + 0.5 * force * state.self_slope[t, d])
        if chi < 1.0:
            fading = model.softness[0] / (chi * chi)
            square = stick_slip.squared(friction, t) if friction is not None else force * force
            for d in range(3):
                out.force[t, d] -= 0.5 * square * fading * state.access_slope[t, d]
        if large is not None:
            bending.bend(state, large, t)
            bending.add_force(state, large, out, t)
            if state.self_compliance[t] * force > large.bend[t, 2] and out.status[t] == OK:
                out.status[t] = EXTRAPOLATED
        if friction is not None:
            stick_slip.write_torque(model, state, friction, out, t)
        out.contact_tool[n] = t
        out.contact_penetration[n] = model.softness[0] * (1.0 / chi - 1.0) * force
        for d in range(3):
            out.contact_force[n, d] = out.force[t, d]
            out.contact_normal[n, d] = state.normal[t, d]
            out.contact_position[n, d] = tips[t, d] - model.tip_radius[t] * state.normal[t, d]
        n += 1
    out.n_contacts[0] = n
