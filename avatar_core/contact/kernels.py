"""The compiled contact step: no allocation, no exception, no I/O.

Each tool tip (a sphere of centre p and radius r; of other tips, p lies r above the lowest point)
presses at the surface point below it, along the normal n = grad phi / |grad phi|. Its force deforms
the organ as that of a patch would, but for the dent right under the tip, which
:mod:`avatar_core.contact.effects.tip_law` adds. A sphere's distance is shifted by what the surface
around it does to its contact (:mod:`avatar_core.contact.ball_shift`): phi is phi + psi from here
on. Forces lambda of patches solve the Signorini
conditions

    gap_t = phi(p_t) - r_t,   gap_t + sum_t' C_tt' lambda_t' >= 0,   lambda >= 0,  complementary,

by projected Gauss-Seidel, C as in :mod:`avatar_core.contact.tip_response`. The stored energy W is a
function of the tip positions alone, and the force on a tip is its exact derivative, F = - dW/dp.
For one tip on an organ at rest, W = lambda gamma lambda / 2,

    F = lambda [ grad phi + lambda grad gamma / 2 ]:

the normal force, and the small tangential one by which a frictionless tip slides towards softer
tissue. Without it a closed path would gain or lose energy.

``space`` holds the modes of the cloud apart from the rest of the model, so that what does not read
them is compiled once for all of their precisions. ``effects`` holds the effects of a scene
(:mod:`avatar_core.contact.effects.selection`), each None or its arrays. A stage takes those it
needs as arguments of their own and does nothing for None: numba compiles the step for every
selection of effects, without the branches on what is None.

Every iteration here is bounded; where one ends unconverged, the status of all tips in contact is
NOT_CONVERGED.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from avatar_core.common.jit import entry, fast, inlined
from avatar_core.common.splines import cell_at, value_in_cell
from avatar_core.contact.cloud_kernels import deform
from avatar_core.contact.effects.friction import (
    add_torque,
    force_squared,
    gather_friction,
    solve_friction,
)
from avatar_core.contact.effects.inertia import advance_inertia, predict_inertia
from avatar_core.contact.effects.large_deformation import add_nonlinear_force, sample_coefficients
from avatar_core.contact.effects.respiration import to_organ_frame, to_world_frame
from avatar_core.contact.effects.several_tools import (
    assemble_coupling,
    couple_near_fields,
    solve_active_set,
)
from avatar_core.contact.effects.tip_law import (
    add_tip_force,
    added_depth,
    advance_tips,
    law_error,
    predict_tips,
    solve_tip,
)
from avatar_core.contact.effects.tip_surface import sample_surface
from avatar_core.contact.effects.viscoelasticity import (
    advance_history,
    predict_history,
    predict_modes,
)
from avatar_core.contact.locate import EXTRAPOLATED, NOT_CONVERGED, OK, locate
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

MAX_TOOLS = 8
MAX_SWEEPS = 1000

PATIENCE = 8  # sweeps before the active-set solution is tried,
MAX_EXACT = 64  # and after which it is no longer tried
GAP_TOLERANCE = 1e-9  # [m] of gap change that ends Gauss-Seidel

# What the step reads; `prepare` fills it once. Shapes in avatar_core.contact.layout.Layout.
ModelArrays = namedtuple(
    "ModelArrays",
    [
        "distance",
        "access",
        "origin",
        "spacing",
        "brick",
        "shift",
        "shift_spacing",
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
        "core",
        "level",
        "block_start",
        "shown",
        "place",
        "region",
        "region_start",
        "regional_load",
        "rest",
        "tip_offset",
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
        "gap",  # (T,) phi + psi - r
        "slope",  # (T, 3) grad (phi + psi)
        "steepness",  # (T,) its length
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
        "shown",  # (1,) level of the modes that are shown
        "amplitude",  # (n_amplitudes,) of global modes that stand apart, and of all regions
        "touched",  # (n_regions,) the regions whose modes move the cloud,
        "n_touched",  # (1,) their number,
        "is_touched",  # (n_regions,) and whether a region is one
        "region_weight",  # (n_regions,) scratch
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
def contact_solve(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
    """First half of a period: forces and contacts. Returns the worst status.

    Real-time safe: allocates nothing, raises nothing, bounded iterations.
    """
    return _solve_period(model, state, out, tips, effects)


@entry
def contact_deform(model, space, state, out, effects):  # type: ignore[no-untyped-def]
    """Second half: the cloud under these forces. Real-time safe, as :func:`contact_solve`."""
    deform(model, space, state, out, effects)


@entry
def force_error(model, state, out, tips, tip_law):  # type: ignore[no-untyped-def]
    """Expected error of the forces: the relative error at the tip, times the force.

    Of a real tip, the patch's error counts with the part of the depth that is the patch's, and that
    of the law is added. Real-time safe, as :func:`contact_solve`.
    """
    for t in range(tips.shape[0]):
        force = out.force[t]
        size = np.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
        out.force_error[t] = 0.0
        if size > 0.0:
            cell = cell_at(model.origin, model.spacing[0], tips[t])
            relative = value_in_cell(model.force_error, cell)
            if tip_law is not None:
                part = state.self_compliance[t] * state.force[t] / max(-state.gap[t], 1e-6)
                relative = law_error(tip_law, state.steepness[t], t) + min(part, 1.0) * relative
            out.force_error[t] = size * relative


@inlined
def _solve_period(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
    """Locate, assemble, solve, differentiate, advance. ``tips`` may change."""
    e = effects
    to_organ_frame(e.respiration, tips)
    status = _locate_tips(
        model, state, out, tips, e.superposition, e.large_deformation, e.friction, e.tip_law
    )
    couple_near_fields(model, state, e.several_tools, e.friction)
    _predict(e.superposition, e.viscoelasticity, e.inertia, e.self_weight)
    predict_tips(e.tip_law, e.viscoelasticity)
    _assemble_incremental(model, state, e.superposition, e.viscoelasticity, e.inertia)
    converged = solve_contact(
        model,
        state,
        tips,
        e.superposition,
        e.several_tools,
        e.large_deformation,
        e.friction,
        e.tip_law,
    )
    if not converged:
        for t in range(tips.shape[0]):
            if state.active[t]:
                out.status[t] = NOT_CONVERGED
    superpose_modes(state, e.superposition, e.friction)
    write_forces(model, state, out, tips, e)
    advance_history(state, e.superposition, e.viscoelasticity, e.friction, e.self_weight)
    advance_tips(state, e.tip_law, e.viscoelasticity)
    advance_inertia(e.superposition, e.inertia)
    to_world_frame(e.respiration, out)
    for t in range(tips.shape[0]):
        status = max(status, out.status[t])
    return status


@inlined
def _locate_tips(  # type: ignore[no-untyped-def]
    model, state, out, tips, superposition, large_deformation, friction, tip_law
):
    """Gap and compliance of each tip on its own; returns the worst status."""
    status = OK
    for t in range(tips.shape[0]):
        out.status[t] = locate(model, state, t, tips[t], superposition, tip_law)
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
        sample_surface(model, tip_law, t, tips[t])
        sample_coefficients(model, state, tip_law, large_deformation, t, tips[t])
        gather_friction(model, state, friction, t)
    return status


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
    model, state, tips, superposition, several_tools, large_deformation, friction, tip_law
):
    """Forces of all tips, by the cheapest solver for the effects; whether it converged."""
    if friction is not None:
        return solve_friction(
            model, state, tips, superposition, several_tools, large_deformation, friction, tip_law
        )
    if several_tools is not None:
        assemble_coupling(state, superposition, several_tools)
    if several_tools is not None or (large_deformation is not None and tip_law is None):
        return solve_together(state, superposition, several_tools, large_deformation, tip_law)
    return solve_alone(state, superposition, large_deformation, tip_law)


@inlined
def solve_alone(state, superposition, large_deformation, tip_law):  # type: ignore[no-untyped-def]
    """0 <= lambda  perp  gap + C lambda >= 0, each tip on its own; a patch in closed form."""
    for t in range(state.passage.shape[0]):
        if state.active[t]:
            gap = state.gap[t]
            if superposition is not None:
                gap -= superposition.free_normal[t]
            own = state.compliance[t, t]
            if tip_law is not None:
                tip_law.place[t] = 0.0  # to the bit, the force knows nothing of the last pose
                state.force[t] = solve_tip(
                    state, superposition, tip_law, large_deformation, t, -gap, own
                )
            else:
                state.force[t] = max(0.0, -gap / own)
    return True


@inlined
def solve_together(  # type: ignore[no-untyped-def]
    state, superposition, several_tools, large_deformation, tip_law
):
    """Projected Gauss-Seidel on 0 <= lambda  perp  gap + C lambda + h >= 0, from the last forces.

    With large deformation each update of a patch is a Newton step. Sweeps hardly change how tips
    close to each other share their load; then they restart from the active-set solution. Returns
    whether the last sweep changed every gap by less than ``GAP_TOLERANCE``.
    """
    n_tools = state.passage.shape[0]
    for sweep in range(MAX_SWEEPS):
        if several_tools is not None and sweep < MAX_EXACT and sweep % PATIENCE == PATIENCE - 1:
            solve_active_set(state, superposition, several_tools, large_deformation, tip_law)
        worst = 0.0
        for t in range(n_tools):
            if not state.active[t]:
                continue
            compliance, before = state.compliance[t, t], state.force[t]
            gap = state.gap[t]
            if superposition is not None:
                gap -= superposition.free_normal[t]
            if several_tools is not None:
                for s in range(n_tools):
                    if s != t and state.active[s]:
                        gap += state.compliance[t, s] * state.force[s]
            if tip_law is not None:
                new = solve_tip(
                    state, superposition, tip_law, large_deformation, t, -gap, compliance
                )
            else:
                gap += compliance * before
                if large_deformation is not None:
                    added, tangent = added_depth(state, superposition, None, large_deformation, t)
                    gap += added
                    compliance += tangent
                new = max(0.0, before - gap / compliance)
            worst = max(worst, abs(new - before) * compliance)
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
            e.tip_law,
            t,
        )
        _add_fading_force(model, state, out, e.friction, t)
        if add_nonlinear_force(state, e.large_deformation, out, t) and out.status[t] == OK:
            out.status[t] = EXTRAPOLATED
        add_tip_force(state, e.tip_law, e.large_deformation, out, t)
        add_torque(model, state, e.friction, out, t)
        out.contact_tool[n] = t
        fade = model.softness[0] * (1.0 / state.access[t] - 1.0)
        out.contact_penetration[n] = fade * state.force[t]
        for d in range(3):
            out.contact_force[n, d] = out.force[t, d]
            out.contact_normal[n, d] = state.normal[t, d]
            out.contact_position[n, d] = tips[t, d] - model.tip_offset[t] * state.normal[t, d]
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
