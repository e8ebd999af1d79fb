"""The contact forces of all tips with friction: both parts together, tip after tip, by projection.

Sweeps hardly change the division of a load between tips that are close to each other. Then
:mod:`avatar_core.contact.friction_newton` proposes where they go on.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.contact.effects.friction import NONE, SLIPS, STICKS, near_between, tangential_force
from avatar_core.contact.effects.grasp import is_held, place_jaw, pull, stiffen_jaw
from avatar_core.contact.effects.large_deformation import bend_held
from avatar_core.contact.friction_newton import newton_steps, patch_displacement
from avatar_core.contact.tip_solver import added_depth, solve_tip
from avatar_core.tips.law import tangential_compliance

MAX_SWEEPS = 1000
PATIENCE = 8  # sweeps before Newton steps are tried,
MAX_NEWTON = 64  # and after which they are no longer tried
GAP_TOLERANCE = 1e-9  # [m]
LEAST_ACROSS = 0.05  # part of the patch's tangential compliance that a large tip leaves


@inlined
def solve_friction(model, data):  # type: ignore[no-untyped-def]
    """Stick where friction can hold the tip, slip elsewhere; return whether sweeps converged."""
    friction = data.friction
    _assemble(model, data)
    mu_s, mu_k = model.friction.coefficients[0], model.friction.coefficients[1]
    for t in range(data.passage.shape[0]):
        if not data.active[t]:
            friction.motion[t] = NONE
            friction.push[t] = 0.0
            continue
        if is_held(model, data, t):
            friction.motion[t] = NONE
            u0, u1, u2 = patch_displacement(model, data, t)
            place_jaw(data, t, u0, u1, u2)
            continue
        if data.force[t] <= 0.0:  # no contact before, or a discontinuous motion
            friction.motion[t] = NONE
            friction.push[t] = 0.0
        _set_offset(model, data, t)
        friction.limit[t] = 0.0  # a new contact starts without friction
        if friction.motion[t] == STICKS:
            friction.limit[t] = mu_s
        elif friction.motion[t] == SLIPS:
            friction.limit[t] = mu_k
    converged = _sweep(model, data)
    again = False
    for t in range(data.passage.shape[0]):
        if data.active[t] and friction.motion[t] == STICKS and not _sticks(data, t):
            friction.limit[t] = mu_k
            again = True
    if again:
        converged = _sweep(model, data)
    for t in range(data.passage.shape[0]):
        if data.active[t] and not is_held(model, data, t):
            _slide_anchor(model, data, t)
    return converged


@fast
def _assemble(model, data):  # type: ignore[no-untyped-def]
    """Assemble the 3 x 3 blocks of C between all tips in contact."""
    superposition, friction = data.superposition, data.friction
    for t in range(data.passage.shape[0]):
        for s in range(t + 1):
            if not (data.active[t] and data.active[s]):
                continue
            beside = 0.0
            if s != t:
                friction.near[t, s] = 0.0
                if model.several_tools.on and data.several_tools.near[s, t]:
                    near_between(model, data, t, s)
                if model.several_tools.on:
                    beside = superposition.near_gain[0] * data.several_tools.beside[t, s]
            for c in range(3):
                for d in range(3):
                    far = 0.0
                    one, other = friction.mode[t, c], friction.mode[s, d]
                    for k in range(superposition.gain.shape[0]):
                        far += superposition.gain[k] * one[k] * other[k]
                    value = far + superposition.near_gain[0] * friction.near[t, s, c, d]
                    friction.compliance[t, s, c, d] = value
                    if s != t:
                        value += beside if c == d else 0.0
                        friction.compliance[t, s, c, d] = value
                        friction.compliance[s, t, d, c] = value
        if data.active[t]:
            own = model.softness[0] * (1.0 / data.access[t] - 1.0)
            own += superposition.near_gain[0] * data.blurred[t]
            for d in range(3):
                friction.compliance[t, t, d, d] += own
            if is_held(model, data, t):
                stiffen_jaw(model, data, t)
            elif model.law.on:
                _press_alone(model, data, t)
                _add_tangential_dent(model, data, t)


@fast
def _press_alone(model, data, t):  # type: ignore[no-untyped-def]
    """Compute the contact radius that the tip would have without friction and other tips."""
    depth, kept = data.superposition.free_normal[t] - data.gap[t], data.force[t]
    own = data.compliance[t, t]
    solve_tip(model, data, t, depth, own)
    data.force[t] = kept


@fast
def _add_tangential_dent(model, data, t):  # type: ignore[no-untyped-def]
    """Replace the patch's tangential compliance by the tip's own at that contact radius."""
    friction = data.friction
    n, c, across = data.normal[t], friction.compliance[t, t], 0.0
    for i in range(3):
        across += 0.5 * c[i, i]
        for j in range(3):
            across -= 0.5 * n[i] * c[i, j] * n[j]
    added = max(tangential_compliance(model, data, t), (LEAST_ACROSS - 1.0) * across)
    for i in range(3):
        for j in range(3):
            c[i, j] += added * ((1.0 if i == j else 0.0) - n[i] * n[j])
    # A contact that grows adds area without stress: the force stays, the anchor follows.
    friction.stiffened[t] = max(0.0, friction.give[t] - added)
    friction.give[t] = added


@inlined
def _set_offset(model, data, t):  # type: ignore[no-untyped-def]
    """Set y = c - s_a, the anchor first moved by the tool's rotation."""
    friction = data.friction
    n, r, spin = data.normal[t], model.tip_offset[t], data.spin[t]
    if friction.motion[t] != NONE:
        a = friction.anchor[t]
        a[0] += r * (spin[1] * n[2] - spin[2] * n[1])
        a[1] += r * (spin[2] * n[0] - spin[0] * n[2])
        a[2] += r * (spin[0] * n[1] - spin[1] * n[0])
    for d in range(3):
        friction.offset[t, d] = data.tip[t, d] - r * n[d] - friction.anchor[t, d]
    if friction.stiffened[t] > 0.0 and friction.motion[t] != NONE:
        y, g = friction.offset[t], friction.push[t]
        along = g[0] * n[0] + g[1] * n[1] + g[2] * n[2]
        for d in range(3):
            moved = friction.stiffened[t] * (g[d] - along * n[d])
            friction.anchor[t, d] += moved
            y[d] -= moved


@inlined
def _sweep(model, data):  # type: ignore[no-untyped-def]
    """Sweep over the tips, normal then tangential force (Gauss-Seidel); return convergence."""
    for sweep in range(MAX_SWEEPS):
        if model.several_tools.on and sweep < MAX_NEWTON and sweep % PATIENCE == PATIENCE - 1:
            start = (sweep // PATIENCE) % (data.passage.shape[0] + 1)
            newton_steps(model, data, start)
        worst = 0.0
        for t in range(data.passage.shape[0]):
            if is_held(model, data, t):
                bend_held(model, data, t)
                u0, u1, u2 = patch_displacement(model, data, t)
                change = pull(data, t, u0, u1, u2)
                worst = max(worst, change)
            elif data.active[t]:
                change = _update_normal(model, data, t)
                worst = max(worst, change)
                change = _update_tangential(model, data, t)
                worst = max(worst, change)
        if worst < GAP_TOLERANCE:
            return True
    return False


@fast
def _update_normal(model, data, t):  # type: ignore[no-untyped-def]
    """Update lambda by 0 <= lambda  perp  gap - n . U + h >= 0."""
    n, c = data.normal[t], data.friction.compliance[t, t]
    u0, u1, u2 = patch_displacement(model, data, t)
    gap = data.gap[t] - (n[0] * u0 + n[1] * u1 + n[2] * u2)
    stiff = 0.0
    for i in range(3):
        for j in range(3):
            stiff += n[i] * c[i, j] * n[j]
    g = data.friction.push[t]
    force = -(g[0] * n[0] + g[1] * n[1] + g[2] * n[2])
    if model.law.on:
        depth = stiff * force - gap
        change = solve_tip(model, data, t, depth, stiff) - force
    else:
        data.force[t] = max(0.0, force)
        added, tangent = added_depth(model, data, t)
        stiff += tangent
        change = max(0.0, force - (gap + added) / stiff) - force
    for d in range(3):
        g[d] -= n[d] * change
    data.force[t] = force + change
    return abs(change) * stiff


@fast
def _update_tangential(model, data, t):  # type: ignore[no-untyped-def]
    """Update tau <- tau + (y - U)_t / c_t, projected to |tau| <= mu lambda."""
    friction = data.friction
    n, c, g, y = (data.normal[t], friction.compliance[t, t], friction.push[t], friction.offset[t])
    u0, u1, u2 = patch_displacement(model, data, t)
    x0, x1, x2 = y[0] - u0, y[1] - u1, y[2] - u2
    along = x0 * n[0] + x1 * n[1] + x2 * n[2]
    across = c[0, 0] + c[1, 1] + c[2, 2]
    for i in range(3):
        for j in range(3):
            across -= n[i] * c[i, j] * n[j]
    across *= 0.5
    normal = g[0] * n[0] + g[1] * n[1] + g[2] * n[2]
    t0 = g[0] - normal * n[0] + (x0 - along * n[0]) / across
    t1 = g[1] - normal * n[1] + (x1 - along * n[1]) / across
    t2 = g[2] - normal * n[2] + (x2 - along * n[2]) / across
    size, bound = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2), friction.limit[t] * data.force[t]
    if size > bound:
        part = bound / size
        t0, t1, t2 = part * t0, part * t1, part * t2
    change = abs(t0 + normal * n[0] - g[0])
    change = max(change, abs(t1 + normal * n[1] - g[1]), abs(t2 + normal * n[2] - g[2]))
    g[0], g[1], g[2] = t0 + normal * n[0], t1 + normal * n[1], t2 + normal * n[2]
    return change * across


@inlined
def _sticks(data, t):  # type: ignore[no-untyped-def]
    """Return whether friction is below its limit."""
    return tangential_force(data, t) < (1.0 - 1e-9) * data.friction.limit[t] * data.force[t]


@fast
def _slide_anchor(model, data, t):  # type: ignore[no-untyped-def]
    """Move the anchor of a slipping tip with it, and set the state of the tip."""
    friction = data.friction
    friction.slipped[t] = 0.0
    if data.force[t] <= 0.0:
        friction.motion[t] = NONE
        friction.push[t] = 0.0
        return
    if friction.motion[t] != NONE and _sticks(data, t):
        friction.motion[t] = STICKS
        return
    n, y = data.normal[t], friction.offset[t]
    u0, u1, u2 = patch_displacement(model, data, t)
    x0, x1, x2 = y[0] - u0, y[1] - u1, y[2] - u2
    if friction.motion[t] != NONE:
        along = x0 * n[0] + x1 * n[1] + x2 * n[2]
        x0, x1, x2 = x0 - along * n[0], x1 - along * n[1], x2 - along * n[2]
    a = friction.anchor[t]
    a[0], a[1], a[2] = a[0] + x0, a[1] + x1, a[2] + x2
    y[0], y[1], y[2] = y[0] - x0, y[1] - x1, y[2] - x2
    if friction.motion[t] == NONE:
        friction.motion[t] = STICKS
    else:
        friction.motion[t] = SLIPS
        friction.slipped[t] = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2)


@fast
def target_derivative(model, data, t, d):  # type: ignore[no-untyped-def]
    """Return g . d(target)/dp_d of U = y + n (gap - n . y), y = p - r n - s_a.

    The dent's own tangential displacement, give tau, turns with n: - give lambda tau . dn/dp_d.
    """
    friction = data.friction
    n, g, y, r = data.normal[t], friction.push[t], friction.offset[t], model.tip_offset[t]
    added, _ = added_depth(model, data, t)
    gap = data.gap[t] + added
    gap -= n[0] * y[0] + n[1] * y[1] + n[2] * y[2]
    slope = data.slope[t, d]
    value = pulled = 0.0
    for i in range(3):
        turn = data.superposition.normal_gradient[i, d]
        step = (1.0 if i == d else 0.0) - r * turn  # dy_i / dp_d
        value += g[i] * (step + turn * (gap - friction.give[t] * data.force[t]))
        slope -= turn * y[i] + n[i] * step
        pulled += g[i] * n[i]
    return value + pulled * slope
