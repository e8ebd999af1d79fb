"""The compiled contact step: no allocation, no exception, no I/O.

Each tool tip (sphere, centre p, radius r) presses through one patch, at the surface point below
it, along the normal n = grad phi / |grad phi|. Forces lambda solve the Signorini conditions

    gap_t = phi(p_t) - r_t,   gap_t + sum_t' C_tt' lambda_t' >= 0,   lambda >= 0,  complementary,

by projected Gauss-Seidel, C as in :mod:`avatar_core.contact.tip_response`. The stored energy W is a
function of the tip positions alone, and the force on a tip is its exact derivative, F = - dW/dp.
For one tip on an organ at rest, W = lambda gamma lambda / 2,

    F = lambda [ grad phi + lambda grad gamma / 2 ]:

the normal force, and the small tangential one by which a frictionless tip slides towards softer
tissue. Without it a closed path would gain or lose energy.

``effects`` holds the effects of a scene (:mod:`avatar_core.contact.effects.selection`), each None
or its arrays. A stage takes those it needs as arguments of their own and does nothing for None:
numba compiles the step for every selection of effects, without the branches on what is None.

Every iteration here is bounded; where one ends unconverged, the status of all tips in contact is
NOT_CONVERGED.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from avatar_core.common.jit import entry, fast, inlined
from avatar_core.common.splines import cell_at, in_cell, on_grid, value_in_cell
from avatar_core.contact.cloud_kernels import deform
from avatar_core.contact.effects.friction import (
    force_squared,
    gather_friction,
    solve_friction,
    write_torque,
)
from avatar_core.contact.effects.inertia import advance_inertia, predict_inertia
from avatar_core.contact.effects.large_deformation import (
    add_nonlinear_force,
    evaluate_added_depth,
    sample_coefficients,
)
from avatar_core.contact.effects.respiration import to_organ_frame, to_world_frame
from avatar_core.contact.effects.several_tools import (
    assemble_coupling,
    couple_near_fields,
    solve_active_set,
)
from avatar_core.contact.effects.viscoelasticity import (
    advance_history,
    predict_history,
    predict_modes,
)
from avatar_core.contact.superposition import (
    free_tip_displacement,
    superpose_modes,
    write_superposed_force,
)
from avatar_core.contact.tip_compliance import (
    assemble_own,
    modal_load,
    near_along_normal,
    near_column,
    near_gram,
)
from avatar_core.contact.tip_response import gather

MAX_TOOLS = 8
MAX_SWEEPS = 1000

OK, NO_MODEL, NO_POSE, STALE_POSE, INVALID_POSE, NOT_CONVERGED, TOO_MANY, OUT_OF_RANGE = range(8)
UNKNOWN_FRAME, EXTRAPOLATED = 8, 9

# A tip that did not enter through the surface is barred until it is outside again: a contact that
# began at depth would release energy that no tool has put in.
OUTSIDE, ENTERED, BARRED = range(3)

PATIENCE = 8  # sweeps before the active-set solution is tried,
MAX_EXACT = 64  # and after which it is no longer tried
GAP_TOLERANCE = 1e-9  # [m] of gap change that ends Gauss-Seidel
ENTRY_DEPTH = 5e-3  # [m] a centre deeper than this did not enter through the surface
LEAP = 50e-3  # [m] in a period; a tip that is farther from its last pose makes a new contact
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
        "carrier_weight",
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
        "passage",  # (T,) whether the tip entered through the surface: OUTSIDE, ENTERED, BARRED
        "seen",  # (T, 3) last valid position of the tip in contact [m]
        "force",  # (T,) lambda
        "active",  # (T,) the tip is closer than its radius to a surface that it may touch
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
        "shown",  # (1,) number of far-field modes in the cloud
        "amplitude",  # (rank,) of the far-field modes, those of large deformation last
        "field",  # (n_blocks BLOCK,) displacement of the cloud, three components a point
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
def contact_step(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
    """One period: forces, then the deformed cloud. Returns the worst status.

    Real-time safe: allocates nothing, raises nothing, bounded iterations.
    """
    status = _solve_period(model, state, out, tips, effects)
    deform(model, state, out, effects)
    return status


@entry
def contact_solve(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
    """First half of a period: forces and contacts. Real-time safe, as :func:`contact_step`."""
    return _solve_period(model, state, out, tips, effects)


@entry
def contact_deform(model, state, out, effects):  # type: ignore[no-untyped-def]
    """Second half: the cloud under these forces. Real-time safe, as :func:`contact_step`."""
    deform(model, state, out, effects)


@entry
def force_error(model, out, tips):  # type: ignore[no-untyped-def]
    """Expected error of the forces: the relative error at the tip, times the force.

    Real-time safe, as :func:`contact_step`.
    """
    for t in range(tips.shape[0]):
        force = out.force[t]
        size = np.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
        out.force_error[t] = 0.0
        if size > 0.0:
            cell = cell_at(model.origin, model.spacing[0], tips[t])
            out.force_error[t] = size * value_in_cell(model.force_error, cell)


@inlined
def _solve_period(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
    """Locate, assemble, solve, differentiate, advance. ``tips`` may change."""
    e = effects
    to_organ_frame(e.respiration, tips)
    status = _locate_tips(model, state, out, tips, e.superposition, e.large_deformation, e.friction)
    couple_near_fields(model, state, e.several_tools, e.friction)
    _predict(e.superposition, e.viscoelasticity, e.inertia, e.self_weight)
    _assemble_incremental(model, state, e.superposition, e.viscoelasticity, e.inertia)
    converged = solve_contact(
        model, state, tips, e.superposition, e.several_tools, e.large_deformation, e.friction
    )
    if not converged:
        for t in range(tips.shape[0]):
            if state.active[t]:
                out.status[t] = NOT_CONVERGED
    superpose_modes(state, e.superposition, e.friction)
    write_forces(model, state, out, tips, e)
    advance_history(state, e.superposition, e.viscoelasticity, e.friction, e.self_weight)
    advance_inertia(e.superposition, e.inertia)
    to_world_frame(e.respiration, out)
    for t in range(tips.shape[0]):
        status = max(status, out.status[t])
    return status


@inlined
def _locate_tips(  # type: ignore[no-untyped-def]
    model, state, out, tips, superposition, large_deformation, friction
):
    """Gap and compliance of each tip on its own; returns the worst status."""
    status = OK
    for t in range(tips.shape[0]):
        out.status[t] = locate(model, state, t, tips[t], superposition)
        status = max(status, out.status[t])
        if not state.active[t]:
            state.force[t] = 0.0
            continue
        modal_load(model, state, t)
        if superposition is not None:
            near_column(model, state, t)
            near = near_along_normal(state, t, state.column[t])
        else:
            near = near_gram(model, state, t)
        assemble_own(model, state, t, near)
        sample_coefficients(model, large_deformation, t, tips[t])
        gather_friction(model, state, friction, t)
    return status


@inlined
def locate(model, state, t, tip, superposition):  # type: ignore[no-untyped-def]
    """Gap, normal, access, compliance, surface point and load positions of a tip in contact."""
    before, continuous = state.passage[t], _is_continuous(state, t, tip)
    state.active[t] = False
    state.access[t] = 1.0
    if not np.isfinite(tip[0] + tip[1] + tip[2]):
        return INVALID_POSE  # keeps its passage: the tip may still be where it was
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
    deepest = MAX_DEPTH if before == ENTERED and continuous else ENTRY_DEPTH
    if before == BARRED or phi < -deepest:
        state.passage[t] = BARRED
        return OUT_OF_RANGE
    state.passage[t] = ENTERED
    state.active[t] = True
    for d in range(3):
        state.seen[t, d] = tip[d]
    if not continuous:
        state.force[t] = 0.0
    _set_normal(state, t, tip, phi)
    state.self_compliance[t] = in_cell(model.self_compliance, cell, state.self_slope[t])
    gather(model, state, t, cell, superposition)
    return OK if access >= FULL_ACCESS else OUT_OF_RANGE


@inlined
def _is_continuous(state, t, tip):  # type: ignore[no-untyped-def]
    """Whether the tip can have moved here from its last contact.

    After invalid poses its motion is unknown; then no more than ``ENTRY_DEPTH`` is believed.
    """
    square = 0.0
    for d in range(3):
        square += (tip[d] - state.seen[t, d]) ** 2
    farthest = LEAP if state.active[t] else ENTRY_DEPTH
    return square < farthest * farthest


@inlined
def _set_normal(state, t, p, phi):  # type: ignore[no-untyped-def]
    """n = g / |g| with g = grad phi, and s = p - phi n."""
    g = state.slope[t]
    state.steepness[t] = max(np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2), 1e-3)
    for d in range(3):
        state.normal[t, d] = g[d] / state.steepness[t]
        state.point[t, d] = p[d] - phi * state.normal[t, d]


@inlined
def _predict(superposition, viscoelasticity, inertia, self_weight):  # type: ignore[no-untyped-def]
    """Modes at the end of the period without any load, and their gain by a unit load."""
    if viscoelasticity is not None:
        predict_history(viscoelasticity)
        superposition.near_gain[0] = viscoelasticity.gain[0]
    if inertia is not None:
        predict_inertia(superposition, inertia, viscoelasticity, self_weight)
    elif viscoelasticity is not None:
        predict_modes(superposition, viscoelasticity, self_weight)
    elif self_weight is not None:
        for k in range(superposition.free.shape[0]):
            superposition.free[k] = self_weight.amplitude[k]


@fast
def _assemble_incremental(  # type: ignore[no-untyped-def]
    model, state, superposition, viscoelasticity, inertia
):
    """Displacement without load at each tip, and its compliance within the period."""
    if superposition is None:
        return
    for t in range(state.passage.shape[0]):
        if not state.active[t]:
            continue
        free_tip_displacement(model, state, superposition, viscoelasticity, t)
        if inertia is not None:
            far, near = 0.0, near_along_normal(state, t, state.column[t])
            for k in range(state.mode.shape[1]):
                far += superposition.gain[k] * state.mode[t, k] * state.mode[t, k]
            incremental = state.scale[t] ** 2 * (far + superposition.near_gain[0] * near)
            state.compliance[t, t] += incremental - state.self_compliance[t]
        elif viscoelasticity is not None:
            softened = viscoelasticity.gain[0] - 1.0
            state.compliance[t, t] += softened * state.self_compliance[t]


@inlined
def solve_contact(  # type: ignore[no-untyped-def]
    model, state, tips, superposition, several_tools, large_deformation, friction
):
    """Forces of all tips, by the cheapest solver for the effects; whether it converged."""
    if friction is not None:
        return solve_friction(
            model, state, tips, superposition, several_tools, large_deformation, friction
        )
    if several_tools is not None:
        assemble_coupling(state, superposition, several_tools)
    if several_tools is not None or large_deformation is not None:
        return solve_together(state, superposition, several_tools, large_deformation)
    return solve_alone(state, superposition)


@inlined
def solve_alone(state, superposition):  # type: ignore[no-untyped-def]
    """0 <= lambda  perp  gap + C lambda >= 0, each tip on its own, in closed form."""
    for t in range(state.passage.shape[0]):
        if state.active[t]:
            gap = state.gap[t]
            if superposition is not None:
                gap -= superposition.free_normal[t]
            state.force[t] = max(0.0, -gap / state.compliance[t, t])
    return True


@inlined
def solve_together(  # type: ignore[no-untyped-def]
    state, superposition, several_tools, large_deformation
):
    """Projected Gauss-Seidel on 0 <= lambda  perp  gap + C lambda + h >= 0, from the last forces.

    With large deformation each update is a Newton step. Sweeps hardly change how tips close to
    each other share their load; then they restart from the active-set solution. Returns whether
    the last sweep changed every gap by less than ``GAP_TOLERANCE``.
    """
    n_tools = state.passage.shape[0]
    for sweep in range(MAX_SWEEPS):
        if several_tools is not None and sweep < MAX_EXACT and sweep % PATIENCE == PATIENCE - 1:
            solve_active_set(state, superposition, several_tools, large_deformation)
        worst = 0.0
        for t in range(n_tools):
            if not state.active[t]:
                continue
            compliance = state.compliance[t, t]
            gap = state.gap[t] + compliance * state.force[t]
            if superposition is not None:
                gap -= superposition.free_normal[t]
            if several_tools is not None:
                for s in range(n_tools):
                    if s != t and state.active[s]:
                        gap += state.compliance[t, s] * state.force[s]
            if large_deformation is not None:
                evaluate_added_depth(state, large_deformation, t)
                gap += large_deformation.added_depth[t, 0]
                compliance += large_deformation.added_depth[t, 1] * state.self_compliance[t]
            new = max(0.0, state.force[t] - gap / compliance)
            worst = max(worst, abs(new - state.force[t]) * compliance)
            state.force[t] = new
        if worst < GAP_TOLERANCE:
            return True
    return False


@fast
def write_forces(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
    """Forces on the tools and the contacts that cause them."""
    e, n = effects, 0
    for t in range(state.passage.shape[0]):
        out.force[t] = 0.0
        out.torque[t] = 0.0
        if state.force[t] <= 0.0:
            continue
        _write_force_at_rest(state, out, t)
        write_superposed_force(
            model,
            state,
            out,
            tips[t],
            e.superposition,
            e.several_tools,
            e.large_deformation,
            e.friction,
            e.viscoelasticity,
            t,
        )
        _add_fading_force(model, state, out, e.friction, t)
        if add_nonlinear_force(state, e.large_deformation, out, t) and out.status[t] == OK:
            out.status[t] = EXTRAPOLATED
        write_torque(model, state, e.friction, out, t)
        out.contact_tool[n] = t
        fade = model.softness[0] * (1.0 / state.access[t] - 1.0)
        out.contact_penetration[n] = fade * state.force[t]
        for d in range(3):
            out.contact_force[n, d] = out.force[t, d]
            out.contact_normal[n, d] = state.normal[t, d]
            out.contact_position[n, d] = tips[t, d] - model.tip_radius[t] * state.normal[t, d]
        n += 1
    out.n_contacts[0] = n


@fast
def _write_force_at_rest(state, out, t):  # type: ignore[no-untyped-def]
    """F = lambda [grad phi + lambda grad gamma / 2], of a single tip on an organ at rest."""
    force = state.force[t]
    for d in range(3):
        out.force[t, d] = force * (state.slope[t, d] + 0.5 * force * state.self_slope[t, d])


@fast
def _add_fading_force(model, state, out, friction, t):  # type: ignore[no-untyped-def]
    """Derivative of the compliance that is added where access fades."""
    chi = state.access[t]
    if chi < 1.0:
        fading = model.softness[0] / (chi * chi)
        square = state.force[t] * state.force[t]
        if friction is not None:
            square = force_squared(friction, t)
        for d in range(3):
            out.force[t, d] -= 0.5 * square * fading * state.access_slope[t, d]
