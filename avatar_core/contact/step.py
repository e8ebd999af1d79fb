"""The compiled contact step: no allocation, no exception, no I/O.

Each tool tip is a sphere of centre p and radius r; for other tips, p lies r above the lowest point.
It presses at the surface point below it, along the normal n = grad phi / |grad phi|. Its force
deforms the organ like the force of a patch, except for the dent right under the tip, which
:mod:`avatar_core.tips.law` adds. Forces lambda of patches solve the Signorini conditions

    gap_t = phi(p_t) - r_t,   gap_t + sum_t' C_tt' lambda_t' >= 0,   lambda >= 0,  complementary,

by projected Gauss-Seidel, C as in :mod:`avatar_core.contact.organ_response`. The stored energy W is
a function of the tip positions alone, and the force on a tip is its exact derivative, F = - dW/dp.
For one tip on an organ at rest, W = lambda gamma lambda / 2,

    F = lambda [ grad phi + lambda grad gamma / 2 ]:

the normal force, and the small tangential force by which a frictionless tip slides towards softer
tissue. Without the tangential force a closed path would gain or lose energy.

``model`` holds the constants (:mod:`avatar_core.contact.layout`). ``data`` holds a loop's state and
results (:mod:`avatar_core.contact.data`). Both have a table for each effect. A stage does nothing
for an effect that is not ``on``: all scenes use one compiled step, and an absent effect costs a
branch.

Every iteration here is bounded. If one ends unconverged, the status of all tips in contact is
NOT_CONVERGED.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import entry, fast, inlined
from avatar_core.common.splines import cell_at, value_in_cell
from avatar_core.contact.cloud_kernels import deform
from avatar_core.contact.effects.friction import add_torque, force_squared, gather_friction
from avatar_core.contact.effects.grasp import (
    held_error,
    hold_or_slip,
    is_held,
    let_go,
    work_jaw,
    write_held_force,
)
from avatar_core.contact.effects.inertia import advance_inertia, predict_inertia
from avatar_core.contact.effects.large_deformation import (
    add_nonlinear_force,
    is_held_too_far,
    sample_coefficients,
)
from avatar_core.contact.effects.respiration import to_organ_frame, to_world_frame
from avatar_core.contact.effects.several_tools import couple_near_fields
from avatar_core.contact.effects.viscoelasticity import (
    advance_history,
    predict_history,
    predict_modes,
)
from avatar_core.contact.locate import EXTRAPOLATED, NOT_CONVERGED, OK, locate
from avatar_core.contact.organ_response import (
    assemble_own,
    modal_load,
    near_along_normal,
    near_column,
    near_gram,
)
from avatar_core.contact.orientation import turn_tools
from avatar_core.contact.solvers import solve_contact
from avatar_core.contact.superposition import (
    free_tip_displacement,
    superpose_modes,
    write_superposed_force,
)
from avatar_core.contact.tip_solver import add_tip_force
from avatar_core.tips.law import law_error, sample_law


@entry
def contact_solve(model, data):  # type: ignore[no-untyped-def]
    """Compute forces and contacts, the first half of a period; return the worst status.

    Real-time safe: allocates nothing, raises nothing, bounded iterations.
    """
    return _solve_period(model, data)


@entry
def contact_deform(model, data):  # type: ignore[no-untyped-def]
    """Compute the cloud under these forces, the second half of a period. Real-time safe."""
    deform(model, data)


@entry
def force_error(model, data):  # type: ignore[no-untyped-def]
    """Compute the expected error of the forces: the relative error at the tip, times the force.

    For a real tip, the patch's error counts by the patch's part of the depth, and the law's error
    is added. Real-time safe, like :func:`contact_solve`.
    """
    out = data.out
    for t in range(data.tip.shape[0]):
        force = out.force[t]
        size = np.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
        out.force_error[t] = 0.0
        if size > 0.0 and is_held(model, data, t):
            out.force_error[t] = size * held_error(model, data, t)
        elif size > 0.0:
            cell = cell_at(model.origin, model.spacing[0], data.tip[t])
            relative = value_in_cell(model.force_error, cell)
            if model.law.on:
                part = data.self_compliance[t] * data.force[t] / max(-data.gap[t], 1e-6)
                relative *= min(part, 1.0)
                relative += law_error(model, data, t)
            out.force_error[t] = size * relative


@inlined
def _solve_period(model, data):  # type: ignore[no-untyped-def]
    """Locate, assemble, solve, differentiate, advance."""
    turn_tools(model, data)
    to_organ_frame(model, data)
    status = _locate_tips(model, data)
    couple_near_fields(model, data)
    _predict(model, data)
    _assemble_incremental(model, data)
    converged = solve_contact(model, data)
    while hold_or_slip(model, data):  # once for each jaw at most; then without what it pulled
        converged = solve_contact(model, data)
    if not converged:
        for t in range(data.tip.shape[0]):
            if data.active[t]:
                data.out.status[t] = NOT_CONVERGED
    superpose_modes(model, data)
    write_forces(model, data)
    advance_history(model, data)
    advance_inertia(model, data)
    to_world_frame(model, data)
    for t in range(data.tip.shape[0]):
        status = max(status, data.out.status[t])
    return status


@inlined
def _locate_tips(model, data):  # type: ignore[no-untyped-def]
    """Compute gap and compliance of each tip on its own; return the worst status."""
    status = OK
    for t in range(data.tip.shape[0]):
        if work_jaw(model, data, t):  # nothing of its place has changed
            status = max(status, data.out.status[t])
            continue
        tip = data.grasp.place[t] if is_held(model, data, t) else data.tip[t]
        data.out.status[t] = locate(model, data, t, tip)
        status = max(status, data.out.status[t])
        if not data.active[t]:
            data.force[t] = 0.0
            if is_held(model, data, t):
                let_go(data, t)
            continue
        modal_load(model, data, t)
        if model.superposed[0]:
            near_column(model, data, t)
            near = near_along_normal(data, t, data.column[t])
        else:
            near = near_gram(model, data, t)
        assemble_own(model, data, t, near)
        sample_law(model, data, t, tip)
        sample_coefficients(model, data, t, tip)
        gather_friction(model, data, t)
    return status


@inlined
def _predict(model, data):  # type: ignore[no-untyped-def]
    """Predict modes at the end of the period without load, and their gain by a unit load."""
    superposition = data.superposition
    if model.viscoelasticity.on:
        predict_history(model, data)
        superposition.near_gain[0] = model.viscoelasticity.gain[0]
    if model.inertia.on:
        predict_inertia(model, data)
    elif model.viscoelasticity.on:
        predict_modes(model, data)
    elif model.self_weight.on:
        for k in range(superposition.free.shape[0]):
            superposition.free[k] = model.self_weight.amplitude[k]


@fast
def _assemble_incremental(model, data):  # type: ignore[no-untyped-def]
    """Compute displacement without load at each tip, and its compliance within the period."""
    if not model.superposed[0]:
        return
    for t in range(data.passage.shape[0]):
        if not data.active[t]:
            continue
        free_tip_displacement(model, data, t)
        if model.inertia.on:
            far, near = 0.0, near_along_normal(data, t, data.column[t])
            for k in range(data.mode.shape[1]):
                far += data.superposition.gain[k] * data.mode[t, k] * data.mode[t, k]
            incremental = far + data.superposition.near_gain[0] * (near + data.blurred[t])
            data.compliance[t, t] += incremental - data.self_compliance[t]
        elif model.viscoelasticity.on:
            softened = model.viscoelasticity.gain[0] - 1.0
            data.compliance[t, t] += softened * data.self_compliance[t]


@fast
def write_forces(model, data):  # type: ignore[no-untyped-def]
    """Write the forces on the tools and the contacts that cause them."""
    out = data.out
    n = 0
    for t in range(data.passage.shape[0]):
        out.force[t] = 0.0
        out.torque[t] = 0.0
        if is_held(model, data, t):
            out.contact_tool[n] = t
            write_held_force(model, data, t, n)
            if is_held_too_far(model, data, t) and out.status[t] == OK:
                out.status[t] = EXTRAPOLATED
            n += 1
            continue
        if data.force[t] <= 0.0:
            continue
        _write_force_at_rest(data, t)
        write_superposed_force(model, data, data.tip[t], t)
        _add_fading_force(model, data, t)
        if add_nonlinear_force(model, data, t) and out.status[t] == OK:
            out.status[t] = EXTRAPOLATED
        add_tip_force(model, data, t)
        add_torque(model, data, t)
        out.contact_tool[n] = t
        fade = model.softness[0] * (1.0 / data.access[t] - 1.0)
        out.contact_penetration[n] = fade * data.force[t]
        for d in range(3):
            out.contact_force[n, d] = out.force[t, d]
            out.contact_normal[n, d] = data.normal[t, d]
            out.contact_position[n, d] = data.tip[t, d] - model.tip_offset[t] * data.normal[t, d]
        n += 1
    out.n_contacts[0] = n


@fast
def _write_force_at_rest(data, t):  # type: ignore[no-untyped-def]
    """Write F = lambda [grad phi + lambda grad gamma / 2], of one tip on an organ at rest."""
    force = data.force[t]
    for d in range(3):
        data.out.force[t, d] = force * (data.slope[t, d] + 0.5 * force * data.self_slope[t, d])


@fast
def _add_fading_force(model, data, t):  # type: ignore[no-untyped-def]
    """Add the derivative of the compliance that grows where access fades."""
    chi = data.access[t]
    if chi < 1.0:
        fading = model.softness[0] / (chi * chi)
        square = data.force[t] * data.force[t]
        if model.friction.on:
            square = force_squared(data, t)
        for d in range(3):
            data.out.force[t, d] -= 0.5 * square * fading * data.access_slope[t, d]
