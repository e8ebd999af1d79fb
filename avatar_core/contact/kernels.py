"""The compiled contact step: no allocation, no exception, no I/O.

Each tool tip (a sphere of centre p and radius r; of other tips, p lies r above the lowest point)
presses at the surface point below it, along the normal n = grad phi / |grad phi|. Its force deforms
the organ as that of a patch would, but for the dent right under the tip, which
:mod:`avatar_core.contact.effects.tip_law` adds. Forces lambda of patches solve the Signorini
conditions

    gap_t = phi(p_t) - r_t,   gap_t + sum_t' C_tt' lambda_t' >= 0,   lambda >= 0,  complementary,

by projected Gauss-Seidel, C as in :mod:`avatar_core.contact.tip_response`. The stored energy W is a
function of the tip positions alone, and the force on a tip is its exact derivative, F = - dW/dp.
For one tip on an organ at rest, W = lambda gamma lambda / 2,

    F = lambda [ grad phi + lambda grad gamma / 2 ]:

the normal force, and the small tangential one by which a frictionless tip slides towards softer
tissue. Without it a closed path would gain or lose energy.

``effects`` holds the effects of a scene (:mod:`avatar_core.contact.effects.selection`). A stage
takes those that it needs and does nothing for one that is not ``on``: all scenes share one compiled
step, and a scene costs a branch for what it leaves out.

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
from avatar_core.contact.effects.tip_law import add_tip_force, law_error, sample_organ, solve_tip
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
        "gap",  # (T,) phi - r
        "slope",  # (T, 3) grad phi
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
        "blurred",  # (T,) gamma - f . C f [m/N]
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
def contact_deform(model, state, out, effects):  # type: ignore[no-untyped-def]
    """Second half: the cloud under these forces. Real-time safe, as :func:`contact_solve`."""
    deform(model, state, out, effects)


@entry
def force_error(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
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
            if effects.tip_law.on:
                part = state.self_compliance[t] * state.force[t] / max(-state.gap[t], 1e-6)
                relative *= min(part, 1.0)
                relative += law_error(effects.tip_law, state.steepness[t], t)
            out.force_error[t] = size * relative


@inlined
def _solve_period(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
    """Locate, assemble, solve, differentiate, advance. ``tips`` may change."""
    e = effects
    to_organ_frame(e.respiration, tips)
    status = _locate_tips(model, state, out, tips, effects)
    couple_near_fields(model, state, e.several_tools, e.friction, e.tip_law)
    _predict(effects)
    _assemble_incremental(model, state, effects)
    converged = solve_contact(model, state, tips, effects)
    if not converged:
        for t in range(tips.shape[0]):
            if state.active[t]:
                out.status[t] = NOT_CONVERGED
    superpose_modes(state, e.superposition, e.friction)
    write_forces(model, state, out, tips, e)
    advance_history(state, effects)
    advance_inertia(e.superposition, e.inertia)
    to_world_frame(e.respiration, out)
    for t in range(tips.shape[0]):
        status = max(status, out.status[t])
    return status


@inlined
def _locate_tips(model, state, out, tips, effects):  # type: ignore[no-untyped-def]
    """Gap and compliance of each tip on its own; returns the worst status."""
    superposition, large_deformation = effects.superposition, effects.large_deformation
    friction, tip_law = effects.friction, effects.tip_law
    status = OK
    for t in range(tips.shape[0]):
        out.status[t] = locate(model, state, t, tips[t], superposition, tip_law)
        status = max(status, out.status[t])
        if not state.active[t]:
            state.force[t] = 0.0
            continue
        modal_load(model, state, t)
        if superposition.on:
            near_column(model, state, t)
            near = near_along_normal(state, t, state.column[t])
        else:
            near = near_gram(model, state, t)
        assemble_own(model, state, t, near)
        sample_organ(model, tip_law, t, tips[t])
        sample_coefficients(model, state, tip_law, large_deformation, t, tips[t])
        gather_friction(model, state, friction, t)
    return status


@inlined
def _predict(effects):  # type: ignore[no-untyped-def]
    """Modes at the end of the period without any load, and their gain by a unit load."""
    superposition, viscoelasticity = effects.superposition, effects.viscoelasticity
    inertia, self_weight = effects.inertia, effects.self_weight
    if viscoelasticity.on:
        predict_history(viscoelasticity)
        superposition.near_gain[0] = viscoelasticity.gain[0]
    if inertia.on:
        predict_inertia(effects)
    elif viscoelasticity.on:
        predict_modes(effects)
    elif self_weight.on:
        for k in range(superposition.free.shape[0]):
            superposition.free[k] = self_weight.amplitude[k]


@fast
def _assemble_incremental(model, state, effects):  # type: ignore[no-untyped-def]
    """Displacement without load at each tip, and its compliance within the period."""
    superposition, viscoelasticity = effects.superposition, effects.viscoelasticity
    inertia = effects.inertia
    if not superposition.on:
        return
    for t in range(state.passage.shape[0]):
        if not state.active[t]:
            continue
        free_tip_displacement(model, state, effects, t)
        if inertia.on:
            far, near = 0.0, near_along_normal(state, t, state.column[t])
            for k in range(state.mode.shape[1]):
                far += superposition.gain[k] * state.mode[t, k] * state.mode[t, k]
            incremental = far + superposition.near_gain[0] * (near + state.blurred[t])
            state.compliance[t, t] += incremental - state.self_compliance[t]
        elif viscoelasticity.on:
            softened = viscoelasticity.gain[0] - 1.0
            state.compliance[t, t] += softened * state.self_compliance[t]


@inlined
def solve_contact(model, state, tips, effects):  # type: ignore[no-untyped-def]
    """Forces of all tips, by the cheapest solver for the effects; whether it converged."""
    several_tools, large_deformation = effects.several_tools, effects.large_deformation
    friction, tip_law = effects.friction, effects.tip_law
    if friction.on:
        return solve_friction(model, state, tips, effects)
    if several_tools.on:
        assemble_coupling(state, effects)
    if several_tools.on or (large_deformation.on and not tip_law.on):
        return solve_together(state, effects)
    return solve_alone(state, effects)


@inlined
def solve_alone(state, effects):  # type: ignore[no-untyped-def]
    """0 <= lambda  perp  gap + C lambda >= 0, each tip on its own; a patch in closed form."""
    superposition, tip_law = effects.superposition, effects.tip_law
    for t in range(state.passage.shape[0]):
        if state.active[t]:
            gap = state.gap[t]
            if superposition.on:
                gap -= superposition.free_normal[t]
            own = state.compliance[t, t]
            if tip_law.on:
                tip_law.place[t] = 0.0  # to the bit, the force knows nothing of the last pose
                state.force[t] = solve_tip(state, effects, t, -gap, own)
            else:
                state.force[t] = max(0.0, -gap / own)
    return True


@inlined
def solve_together(state, effects):  # type: ignore[no-untyped-def]
    """Projected Gauss-Seidel on 0 <= lambda  perp  gap + C lambda + h >= 0, from the last forces.

    With large deformation each update of a patch is a Newton step. Sweeps hardly change how tips
    close to each other share their load; then they restart from the active-set solution. Returns
    whether the last sweep changed every gap by less than ``GAP_TOLERANCE``.
    """
    superposition, several_tools = effects.superposition, effects.several_tools
    large_deformation, tip_law = effects.large_deformation, effects.tip_law
    n_tools = state.passage.shape[0]
    for sweep in range(MAX_SWEEPS):
        if several_tools.on and sweep < MAX_EXACT and sweep % PATIENCE == PATIENCE - 1:
            solve_active_set(state, effects)
        worst = 0.0
        for t in range(n_tools):
            if not state.active[t]:
                continue
            compliance, before = state.compliance[t, t], state.force[t]
            gap = state.gap[t]
            if superposition.on:
                gap -= superposition.free_normal[t]
            if several_tools.on:
                for s in range(n_tools):
                    if s != t and state.active[s]:
                        gap += state.compliance[t, s] * state.force[s]
            if tip_law.on:
                new = solve_tip(state, effects, t, -gap, compliance)
            else:
                gap += compliance * before
                if large_deformation.on:
                    evaluate_added_depth(state, large_deformation, t)
                    gap += large_deformation.added_depth[t, 0]
                    compliance += large_deformation.added_depth[t, 1] * state.self_compliance[t]
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
        write_superposed_force(model, state, out, tips[t], effects, t)
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
        if friction.on:
            square = force_squared(friction, t)
        for d in range(3):
            out.force[t, d] -= 0.5 * square * fading * state.access_slope[t, d]
