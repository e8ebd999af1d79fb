"""Coulomb friction with stick and slip, coupled with the normal contact through the organ.

A tip in contact has an *anchor*, a material point s_a of the organ's surface at rest. While the tip
sticks, the anchor moves with the tip's contact point c = p - r n: the displacement of the patch is

    U = y + n (gap - n . y),    y = c - s_a,

and the force on the tissue g = C^-1 U has a normal part lambda = -n . g >= 0 and a tangential one
tau, |tau| <= mu_s lambda. Where it would exceed that, the anchor slides along tau until
|tau| = mu_k lambda, the slip of maximum dissipation (Moreau). Both parts are found together, tip
after tip, by projection (Alart & Curnier, CMAME 92:353, 1991). The force is the derivative of the
elastic energy W(p, s_a) at a fixed anchor, so that the work on a closed path is the dissipation
mu_k lambda |slip| >= 0. ``spin`` moves the contact point when the tool turns.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect
from avatar_core.contact.effects.friction_newton import newton_steps, patch_displacement
from avatar_core.contact.effects.tip_law import added_depth, solve_tip, tangential_compliance
from avatar_core.errors import SceneError
from avatar_core.reduction.near_field import find_block


@dataclass(frozen=True)
class Friction(Effect):
    """Coulomb friction with stick and slip."""

    name: ClassVar[str] = "friction"
    text: ClassVar[str] = "tips stick and slip: |F_t| <= mu F_n"

    static: float = quantity("-", 0.0, 1.0, "mu_s, friction over normal force before slip", 0.4)
    kinetic: float = quantity("-", 0.0, 1.0, "mu_k, friction over normal force in slip", 0.3)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kinetic > self.static:
            raise SceneError(
                f"friction: kinetic is {self.kinetic}, above static {self.static}; slip cannot "
                "take more force than its start"
            )


MAX_SWEEPS = 1000
PATIENCE = 8  # sweeps before Newton steps are tried,
MAX_NEWTON = 64  # and after which they are no longer tried
GAP_TOLERANCE = 1e-9  # [m]
LEAST_ACROSS = 0.05  # part of the patch's tangential compliance that a large tip leaves
NONE, STICKS, SLIPS = range(3)  # state of a tip in the last period

FrictionArrays = namedtuple("FrictionArrays", ["coefficients"])
FrictionState = namedtuple(
    "FrictionState",
    [
        "coefficients",  # (2,) mu_s, mu_k
        "spin",  # (T, 3) rotation of the tool in this period [rad]; the step resets it
        "anchor",  # (T, 3) s_a [m]
        "motion",  # (T,) NONE, STICKS, SLIPS
        "limit",  # (T,) mu in force
        "push",  # (T, 3) g, force on the tissue [N]
        "mode",  # (T, 3, k) Y^T w for forces along x, y, z
        "near",  # (T, T, 3, 3) near part of w . C w
        "compliance",  # (T, T, 3, 3) C
        "offset",  # (T, 3) c - s_a
        "slipped",  # (T,) distance that the anchor slid in this period [m]
        "matrix",  # (3T, 3T) of the Newton steps
        "rhs",  # (3T,) [N]
        "give",  # (T,) tangential compliance of the dent, less that of the patch [m/N]
        "stiffened",  # (T,) by how much it fell in this period, at least 0 [m/N]
        "best",  # (T, 3) push of the Newton step with the least residual [N]
    ],
)


def friction_arrays(effect: Friction) -> FrictionArrays:
    """Constant arrays of the effect."""
    return FrictionArrays(np.array([effect.static, effect.kinetic]))


def friction_state(arrays: FrictionArrays, n_tools: int, n_modes: int) -> FrictionState:
    """State without any contact."""
    return FrictionState(
        *arrays,
        spin=np.zeros((n_tools, 3)),
        anchor=np.zeros((n_tools, 3)),
        motion=np.zeros(n_tools, np.int64),
        limit=np.zeros(n_tools),
        push=np.zeros((n_tools, 3)),
        mode=np.zeros((n_tools, 3, n_modes), np.float32),
        near=np.zeros((n_tools, n_tools, 3, 3)),
        compliance=np.zeros((n_tools, n_tools, 3, 3)),
        offset=np.zeros((n_tools, 3)),
        slipped=np.zeros(n_tools),
        matrix=np.zeros((3 * n_tools, 3 * n_tools)),
        rhs=np.zeros(3 * n_tools),
        give=np.zeros(n_tools),
        stiffened=np.zeros(n_tools),
        best=np.zeros((n_tools, 3)),
    )


@fast
def gather_friction(model, state, friction, t):  # type: ignore[no-untyped-def]
    """Modal loads of unit forces along x, y and z, and the near part of the tip's compliance."""
    if not friction.on:
        return
    mode = friction.mode[t]
    mode[:] = np.float32(0.0)
    for i in range(state.n_nodes[t]):
        w, load = np.float32(state.weight[t, i, 0]), model.load[state.nodes[t, i]]
        for d in range(3):
            for k in range(mode.shape[1]):
                mode[d, k] += w * load[d, k]
    _near_between(model, state, friction, t, t)


@fast
def _near_between(model, state, friction, t, s):  # type: ignore[no-untyped-def]
    """sum_ij w_i B_ij w_j: displacement of tip t's patch by unit forces of tip s."""
    near = friction.near[t, s]
    near[:] = 0.0
    for i in range(state.n_nodes[s]):
        j, w = state.nodes[s, i], state.weight[s, i, 0]
        for q in range(state.n_nodes[t]):
            e = find_block(model.contact_start, model.contact_slot, j, state.nodes[t, q])
            if e >= 0:
                factor, b = w * state.weight[t, q, 0], model.contact_block[e]
                for c in range(3):
                    for d in range(3):
                        near[c, d] += factor * b[c, d]


@fast
def _assemble(model, state, effects):  # type: ignore[no-untyped-def]
    """The 3 x 3 blocks of C between all tips in contact."""
    superposition, several_tools = effects.superposition, effects.several_tools
    friction, tip_law = effects.friction, effects.tip_law
    for t in range(state.passage.shape[0]):
        for s in range(t + 1):
            if not (state.active[t] and state.active[s]):
                continue
            beside = 0.0
            if s != t:
                friction.near[t, s] = 0.0
                if several_tools.on and several_tools.near[s, t]:
                    _near_between(model, state, friction, t, s)
                if several_tools.on:
                    beside = superposition.near_gain[0] * several_tools.beside[t, s]
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
        if state.active[t]:
            own = model.softness[0] * (1.0 / state.access[t] - 1.0)
            own += superposition.near_gain[0] * state.blurred[t]
            for d in range(3):
                friction.compliance[t, t, d, d] += own
            if tip_law.on:
                _press_alone(state, effects, t)
                _add_tangential_dent(state, friction, tip_law, t)


@fast
def _press_alone(state, effects, t):  # type: ignore[no-untyped-def]
    """The contact radius that the tip would have without friction and other tips."""
    superposition = effects.superposition
    depth, kept = superposition.free_normal[t] - state.gap[t], state.force[t]
    own = state.compliance[t, t]
    solve_tip(state, effects, t, depth, own)
    state.force[t] = kept


@fast
def _add_tangential_dent(state, friction, tip_law, t):  # type: ignore[no-untyped-def]
    """The tip's own tangential compliance in place of the patch's, at that contact radius."""
    n, c, across = state.normal[t], friction.compliance[t, t], 0.0
    for i in range(3):
        across += 0.5 * c[i, i]
        for j in range(3):
            across -= 0.5 * n[i] * c[i, j] * n[j]
    added = max(tangential_compliance(tip_law, t), (LEAST_ACROSS - 1.0) * across)
    for i in range(3):
        for j in range(3):
            c[i, j] += added * ((1.0 if i == j else 0.0) - n[i] * n[j])
    # A contact that grows adds area without stress: the force stays, the anchor follows.
    friction.stiffened[t] = max(0.0, friction.give[t] - added)
    friction.give[t] = added


@inlined
def solve_friction(model, state, tips, effects):  # type: ignore[no-untyped-def]
    """Stick where friction can hold the tip, slip elsewhere; whether the last sweeps converged."""
    friction = effects.friction
    _assemble(model, state, effects)
    mu_s, mu_k = friction.coefficients[0], friction.coefficients[1]
    for t in range(state.passage.shape[0]):
        if not state.active[t]:
            friction.motion[t] = NONE
            friction.push[t] = 0.0
            continue
        if state.force[t] <= 0.0:  # no contact before, or a discontinuous motion
            friction.motion[t] = NONE
            friction.push[t] = 0.0
        _set_offset(model, state, friction, tips, t)
        friction.limit[t] = 0.0  # a new contact starts without friction
        if friction.motion[t] == STICKS:
            friction.limit[t] = mu_s
        elif friction.motion[t] == SLIPS:
            friction.limit[t] = mu_k
    converged = _sweep(state, effects)
    again = False
    for t in range(state.passage.shape[0]):
        if state.active[t] and friction.motion[t] == STICKS and not _sticks(state, friction, t):
            friction.limit[t] = mu_k
            again = True
    if again:
        converged = _sweep(state, effects)
    for t in range(state.passage.shape[0]):
        if state.active[t]:
            _slide_anchor(state, effects, t)
    return converged


@inlined
def _set_offset(model, state, friction, tips, t):  # type: ignore[no-untyped-def]
    """y = c - s_a, the anchor first moved by the tool's rotation."""
    n, r, spin = state.normal[t], model.tip_offset[t], friction.spin[t]
    if friction.motion[t] != NONE:
        a = friction.anchor[t]
        a[0] += r * (spin[1] * n[2] - spin[2] * n[1])
        a[1] += r * (spin[2] * n[0] - spin[0] * n[2])
        a[2] += r * (spin[0] * n[1] - spin[1] * n[0])
    for d in range(3):
        spin[d] = 0.0
        friction.offset[t, d] = tips[t, d] - r * n[d] - friction.anchor[t, d]
    if friction.stiffened[t] > 0.0 and friction.motion[t] != NONE:
        y, g = friction.offset[t], friction.push[t]
        along = g[0] * n[0] + g[1] * n[1] + g[2] * n[2]
        for d in range(3):
            moved = friction.stiffened[t] * (g[d] - along * n[d])
            friction.anchor[t, d] += moved
            y[d] -= moved


@inlined
def _sweep(state, effects):  # type: ignore[no-untyped-def]
    """Gauss-Seidel over the tips, normal then tangential force of each; whether it converged."""
    several_tools = effects.several_tools
    for sweep in range(MAX_SWEEPS):
        if several_tools.on and sweep < MAX_NEWTON and sweep % PATIENCE == PATIENCE - 1:
            start = (sweep // PATIENCE) % (state.passage.shape[0] + 1)
            newton_steps(state, effects, start)
        worst = 0.0
        for t in range(state.passage.shape[0]):
            if state.active[t]:
                change = _update_normal(state, effects, t)
                worst = max(worst, change)
                change = _update_tangential(state, effects, t)
                worst = max(worst, change)
        if worst < GAP_TOLERANCE:
            return True
    return False


@fast
def _update_normal(state, effects, t):  # type: ignore[no-untyped-def]
    """0 <= lambda  perp  gap - n . U + h >= 0."""
    friction, tip_law = effects.friction, effects.tip_law
    n, c = state.normal[t], friction.compliance[t, t]
    u0, u1, u2 = patch_displacement(state, effects, t)
    gap = state.gap[t] - (n[0] * u0 + n[1] * u1 + n[2] * u2)
    stiff = 0.0
    for i in range(3):
        for j in range(3):
            stiff += n[i] * c[i, j] * n[j]
    g = friction.push[t]
    force = -(g[0] * n[0] + g[1] * n[1] + g[2] * n[2])
    if tip_law.on:
        depth = stiff * force - gap
        change = solve_tip(state, effects, t, depth, stiff) - force
    else:
        state.force[t] = max(0.0, force)
        added, tangent = added_depth(state, effects, t)
        stiff += tangent
        change = max(0.0, force - (gap + added) / stiff) - force
    for d in range(3):
        g[d] -= n[d] * change
    state.force[t] = force + change
    return abs(change) * stiff


@fast
def _update_tangential(state, effects, t):  # type: ignore[no-untyped-def]
    """tau <- tau + (y - U)_t / c_t, projected to |tau| <= mu lambda."""
    friction = effects.friction
    n, c, g, y = state.normal[t], friction.compliance[t, t], friction.push[t], friction.offset[t]
    u0, u1, u2 = patch_displacement(state, effects, t)
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
    size, bound = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2), friction.limit[t] * state.force[t]
    if size > bound:
        part = bound / size
        t0, t1, t2 = part * t0, part * t1, part * t2
    change = abs(t0 + normal * n[0] - g[0])
    change = max(change, abs(t1 + normal * n[1] - g[1]), abs(t2 + normal * n[2] - g[2]))
    g[0], g[1], g[2] = t0 + normal * n[0], t1 + normal * n[1], t2 + normal * n[2]
    return change * across


@fast
def tangential_force(state, friction, t):  # type: ignore[no-untyped-def]
    """|tau|."""
    n, g = state.normal[t], friction.push[t]
    along = g[0] * n[0] + g[1] * n[1] + g[2] * n[2]
    return np.sqrt(max(0.0, g[0] * g[0] + g[1] * g[1] + g[2] * g[2] - along * along))


@inlined
def _sticks(state, friction, t):  # type: ignore[no-untyped-def]
    """Whether friction is below its limit."""
    return tangential_force(state, friction, t) < (1.0 - 1e-9) * friction.limit[t] * state.force[t]


@fast
def _slide_anchor(state, effects, t):  # type: ignore[no-untyped-def]
    """Move the anchor of a slipping tip with it, and set the state of the tip."""
    friction = effects.friction
    friction.slipped[t] = 0.0
    if state.force[t] <= 0.0:
        friction.motion[t] = NONE
        friction.push[t] = 0.0
        return
    if friction.motion[t] != NONE and _sticks(state, friction, t):
        friction.motion[t] = STICKS
        return
    n, y = state.normal[t], friction.offset[t]
    u0, u1, u2 = patch_displacement(state, effects, t)
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
def add_modal_load(state, friction, t, total):  # type: ignore[no-untyped-def]
    """Add Y^T of the loads of a tip."""
    g, mode = friction.push[t], friction.mode[t]
    for k in range(total.shape[0]):
        total[k] += g[0] * mode[0, k] + g[1] * mode[1, k] + g[2] * mode[2, k]


@fast
def add_near_friction(model, state, effects, t):  # type: ignore[no-untyped-def]
    """Add the near displacement at the nodes of a tip by the pushes of all tips."""
    superposition, several_tools = effects.superposition, effects.several_tools
    friction = effects.friction
    for s in range(state.passage.shape[0]):
        if state.force[s] <= 0.0:
            continue
        if s != t and (not several_tools.on or not several_tools.near[s, t]):
            continue
        factor, g = superposition.near_gain[0], friction.push[s]
        for i in range(state.n_nodes[s]):
            w = factor * state.weight[s, i, 0]
            w0, w1, w2 = np.float32(w * g[0]), np.float32(w * g[1]), np.float32(w * g[2])
            for q in range(state.n_nodes[t]):
                e = find_block(
                    model.contact_start, model.contact_slot, state.nodes[s, i], state.nodes[t, q]
                )
                if e < 0:
                    continue
                b = model.contact_block[e]
                for d in range(3):
                    superposition.displacement[q, d] += b[d, 0] * w0 + b[d, 1] * w1 + b[d, 2] * w2


@fast
def target_derivative(model, state, effects, t, d):  # type: ignore[no-untyped-def]
    """g . d(target)/dp_d of U = y + n (gap - n . y), y = p - r n - s_a.

    The dent's own tangential displacement, give tau, turns with n: - give lambda tau . dn/dp_d.
    """
    superposition, friction = effects.superposition, effects.friction
    n, g, y, r = state.normal[t], friction.push[t], friction.offset[t], model.tip_offset[t]
    added, _ = added_depth(state, effects, t)
    gap = state.gap[t] + added
    gap -= n[0] * y[0] + n[1] * y[1] + n[2] * y[2]
    slope = state.slope[t, d]
    value = pulled = 0.0
    for i in range(3):
        turn = superposition.normal_gradient[i, d]
        step = (1.0 if i == d else 0.0) - r * turn  # dy_i / dp_d
        value += g[i] * (step + turn * (gap - friction.give[t] * state.force[t]))
        slope -= turn * y[i] + n[i] * step
        pulled += g[i] * n[i]
    return value + pulled * slope


@fast
def force_squared(friction, t):  # type: ignore[no-untyped-def]
    """|g|^2."""
    g = friction.push[t]
    return g[0] * g[0] + g[1] * g[1] + g[2] * g[2]


@fast
def add_torque(model, state, friction, out, t):  # type: ignore[no-untyped-def]
    """Moment about the tip's centre of the force at its contact point, -r n x F."""
    if not friction.on:
        return
    n, r, f = state.normal[t], model.tip_offset[t], out.force[t]
    out.torque[t, 0] -= r * (n[1] * f[2] - n[2] * f[1])
    out.torque[t, 1] -= r * (n[2] * f[0] - n[0] * f[2])
    out.torque[t, 2] -= r * (n[0] * f[1] - n[1] * f[0])
