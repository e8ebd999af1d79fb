"""Superposition: the displacement by all causes at the load positions of each tip.

The organ is linear: the effects of other tips, load history, weight and inertia add up,

    u(s) = sum_k Y_k(s) q_k + near field,      q = free + gain * (Y^T f),

with f the loads of all tips and ``free`` the modes at the end of the period without any load.
``gain`` is their displacement within the period by a unit load (0 and 1 without viscoelasticity and
inertia). The near field follows the same equation; its history is a distribution of loads, and it
has no mass.

The force on a tip is the derivative of the elastic energy at fixed loads and history. Let u_j be
the displacement at load position j by all causes, U = sum_j w_j u_j the displacement of the patch,
and g the force on the tissue. Then

    F_d = - g . d(target)/dp_d + sum_j dw_j/dp_d g . u_j + g . e / 2 d(gamma - f . C f)/dp_d.

target is the displacement that contact prescribes for the patch (along n only, unless the tip
sticks). gamma - f . C f is the stencil's blur of the compliance under the tip itself
(:mod:`avatar_core.contact.organ_response`). It is a dent of this tip alone, under the force e on an
elastic organ with the same dent.
"""

from __future__ import annotations

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast
from avatar_core.common.splines import cell_at, second_derivatives
from avatar_core.contact.effects.friction import (
    add_modal_load,
    add_near_friction,
    force_on_tissue,
    force_squared,
)
from avatar_core.contact.effects.several_tools import (
    add_history_beside,
    add_near_of_others,
    derivative_beside,
)
from avatar_core.contact.effects.viscoelasticity import held_load, near_free_displacement
from avatar_core.contact.friction_solver import target_derivative
from avatar_core.contact.organ_response import modes_at_nodes

SUPERPOSITION = kind(
    "Superposition",
    free=array("K"),  # modes at the end of the period without any load
    gain=array("K", start=1.0),  # their displacement by a unit load within the period
    total=array("K"),  # modes at the end of the period
    near_gain=array("1", start=1.0),  # gain of the near field
    free_normal=array("T"),  # its component along n [m]
    free_displacement=array("T 3"),  # displacement of the patch without any load [m]
    near_free=array("T S 3"),  # near displacement at the nodes by the load history
    unit_displacement=array("S 3"),  # at the nodes by a unit normal force, at rest
    displacement=array("S 3"),  # at the nodes by all causes
    hessian=array("3 3"),  # second derivatives of phi
    normal_gradient=array("3 3"),  # dn_i / dp_d
)


@fast
def free_tip_displacement(model, data, t):  # type: ignore[no-untyped-def]
    """Compute the displacement of a tip's patch without any load in this period."""
    superposition = data.superposition
    free = superposition.free_displacement[t]
    modes_at_nodes(model, data, t, superposition.free, superposition.displacement)
    if model.viscoelasticity.on:
        near_free_displacement(model, data, t, superposition.near_free[t])
    dent = superposition.near_gain[0] * data.blurred[t] * held_load(model, data, t)
    for d in range(3):
        value = dent * data.normal[t, d]
        for i in range(data.n_nodes[t]):
            value += data.weight[t, i, 0] * superposition.displacement[i, d]
            if model.viscoelasticity.on:
                value += data.weight[t, i, 0] * superposition.near_free[t, i, d]
        free[d] = value
    add_history_beside(model, data, t)
    superposition.free_normal[t] = 0.0
    for d in range(3):
        superposition.free_normal[t] += data.normal[t, d] * free[d]


@fast
def superpose_modes(model, data):  # type: ignore[no-untyped-def]
    """Compute the modes under the forces that were found."""
    superposition = data.superposition
    if not model.superposed[0]:
        return
    total = superposition.total
    total[:] = 0.0
    for t in range(data.passage.shape[0]):
        if data.force[t] <= 0.0:
            continue
        if model.friction.on:
            add_modal_load(data, t, total)
        else:
            force = data.force[t]
            for k in range(total.shape[0]):
                total[k] -= force * data.mode[t, k]
    for k in range(total.shape[0]):
        total[k] = superposition.free[k] + superposition.gain[k] * total[k]


@fast
def _displacement_at_nodes(model, data, t):  # type: ignore[no-untyped-def]
    """Compute displacement at a tip's nodes by all causes, and by its unit normal force at rest."""
    superposition = data.superposition
    displacement, unit = superposition.displacement, superposition.unit_displacement
    modes_at_nodes(model, data, t, data.mode[t], unit)
    modes_at_nodes(model, data, t, superposition.total, displacement)
    for i in range(data.n_nodes[t]):
        for d in range(3):
            unit[i, d] += data.column[t, i, d]
    if model.friction.on:
        add_near_friction(model, data, t)
    else:
        near = -data.force[t] * superposition.near_gain[0]
        for i in range(data.n_nodes[t]):
            for d in range(3):
                displacement[i, d] += near * data.column[t, i, d]
        if model.several_tools.on:
            add_near_of_others(data, t)
    if model.viscoelasticity.on:
        for i in range(data.n_nodes[t]):
            for d in range(3):
                displacement[i, d] += superposition.near_free[t, i, d]


@fast
def write_superposed_force(model, data, tip, t):  # type: ignore[no-untyped-def]
    """Write F of the module's docstring, without large deformation and fading access."""
    superposition = data.superposition
    if not model.superposed[0]:
        return
    n, count, square = data.normal[t], data.n_nodes[t], data.force[t] ** 2
    displacement, unit = superposition.displacement, superposition.unit_displacement
    gradient = superposition.normal_gradient
    _normal_gradient(model, data, t, tip)
    _displacement_at_nodes(model, data, t)
    g0, g1, g2 = force_on_tissue(model, data, t)
    if model.friction.on:
        square = force_squared(data, t)
    held, gain = held_load(model, data, t), superposition.near_gain[0]
    u0 = u1 = u2 = v0 = v1 = v2 = 0.0
    for i in range(count):
        w, u, v = data.weight[t, i, 0], displacement[i], unit[i]
        u0 += w * u[0]
        u1 += w * u[1]
        u2 += w * u[2]
        v0 += w * v[0]
        v1 += w * v[1]
        v2 += w * v[2]
    for d in range(3):
        turn0, turn1, turn2 = gradient[0, d], gradient[1, d], gradient[2, d]
        slope = turn0 * v0 + turn1 * v1 + turn2 * v2
        joint = 0.0
        for i in range(count):
            dw, u, v = data.weight[t, i, 1 + d], displacement[i], unit[i]
            slope += dw * (n[0] * v[0] + n[1] * v[1] + n[2] * v[2])
            joint += dw * (g0 * u[0] + g1 * u[1] + g2 * u[2])
        sharper = 0.5 * data.self_slope[t, d] - slope  # half the derivative of gamma - f . C f
        value = joint + gain * (square - held * data.force[t]) * sharper
        if model.friction.on:
            value += gain * data.blurred[t] * held * (g0 * turn0 + g1 * turn1 + g2 * turn2)
            value -= target_derivative(model, data, t, d)
        else:
            turned = turn0 * u0 + turn1 * u1 + turn2 * u2
            value += data.force[t] * (data.slope[t, d] - turned)
        value += derivative_beside(model, data, t, tip, d, sharper)
        data.out.force[t, d] = value


@fast
def _normal_gradient(model, data, t, p):  # type: ignore[no-untyped-def]
    """Return dn/dp = (I - n n^T) grad g / |g|, g = grad phi."""
    n, hessian = data.normal[t], data.superposition.hessian
    cell = cell_at(model.origin, model.spacing[0], p)
    second_derivatives(model.distance, cell, model.spacing[0], hessian)
    for d in range(3):
        along = n[0] * hessian[0, d] + n[1] * hessian[1, d] + n[2] * hessian[2, d]
        for i in range(3):
            data.superposition.normal_gradient[i, d] = (
                hessian[i, d] - n[i] * along
            ) / data.steepness[t]
