"""The contact law of a tip: how deep it sinks into the tissue right under it.

A vademecum knows the organ's response to a smooth patch of radius R_p, whatever the size of the
tip. What the patch dents its own neighbourhood is that of a half-space; it is taken off, and what
the tip dents is put in its place. With F the normal force and d the depth of the tip,

    d = delta(F) + F [gamma - c],      c = 0.75 / (E* R_p),      E* = E / (1 - nu^2),

gamma the organ's compliance for the patch and c at most gamma. On a half-space every body of
revolution touches within a radius a where (Sneddon, Int. J. Eng. Sci. 3:47, 1965; g in
:mod:`avatar_core.geometry.tip`)

    delta = g(a),      F = 2 E* int_0^a x g'(x) dx,

and from its full radius on as a punch. What the surface around the tip does to its contact
multiplies E*, here and in what follows, but for that in c, by its shape factor
(:mod:`avatar_core.contact.shape_factor`).

The dent stores the energy E* Phi, Phi = int_0^a (delta(a) - delta(x))^2 dx, and the force on the
tip is the derivative of all energy: at constant F

    dF_tip = - Phi grad E* - F^2 / 2 grad c.

Where the scene chooses large deformation, a sphere in a neo-Hookean organ sinks by eta deeper than
delta, which may be negative (:mod:`avatar_core.contact.effects.large_dent`),

    eta(F) = R e(w),      w = (3 F / (4 E* R^2))^(2/3),      Psi = int_0^(F / E*) L d eta(L),

w being Hertz's depth over R, e fitted to our own finite elements. It depends on the force alone and
adds its Psi to Phi: the force stays the derivative of one energy.

In viscoelastic tissue F is replaced by the force on an elastic organ that is dented alike (Lee &
Radok, J. Appl. Mech. 27:438, 1960), which the tip carries along.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.common.jit import entry, fast, inlined
from avatar_core.common.splines import BRICK, add_in_bricks, cell_at, in_cell
from avatar_core.contact.effects.large_deformation import evaluate_added_depth
from avatar_core.contact.effects.large_dent import LEAST, evaluate_large_dent, large_dent_of
from avatar_core.contact.effects.tilt import TiltState, add_righting, evaluate_tilt, sample_tilt
from avatar_core.contact.effects.tip_profile import INTERVALS, STIFFNESS, TAKEN, profile_of
from avatar_core.contact.effects.viscoelasticity import held_load
from avatar_core.errors import ContactError
from avatar_core.geometry.tip import Tip

if TYPE_CHECKING:
    from avatar_core.fem.elasticity import Material

# c E* R_p: what a patch sinks on a cube of elements of a liver's size. On a half-space it is
# P(0) = 0.7665 (:mod:`avatar_core.contact.patch_on_plane`).
PATCH_ON_MESH = 0.75
# Relative errors of the force, the second per |log s|, beside what the gap's slope is off one: with
# the patch's error they cover 95 % of 186 contacts of balls resolved on LiTS-1 and LiTS-4, and are
# 2.7 times the true error in the median.
LAW_ERROR, SHAPE_ERROR = 0.009, 0.1
TUMOUR_ERROR = 0.25  # of the force, per relative change of E* by a tumour underneath
LEAST_CONTACT = 0.02  # contact radius over the tip's, where the tangent of a light touch is taken
MOST_TAKEN = 0.9  # part of a dent's least compliance, 1 / (2 E* radius), that may be taken off
MAX_STEPS = 60  # of Newton's method, with bisection where it leaves its bracket
TOLERANCE = 1e-13  # [m] of depth, or relative of the force

_EVERYWHERE = 1e3  # larger than any organ [m]

# log s of tips in bricks (:mod:`avatar_core.common.splines`) from the origin of the tip field:
# brick (bx, by, bz) int32; value (n_tips, n_bricks, BRICK, BRICK, BRICK) float32; spacing (1,) [m]
ShapeFactor = namedtuple("ShapeFactor", ["brick", "value", "spacing"])

TipLawArrays = namedtuple(
    "TipLawArrays",
    [
        "profile",  # (T, INTERVALS + 1, 6) a, da/ds, g, dg/ds, M, Phi over s in [0, 1]
        "radius",  # (T,) of the tip [m]
        "mindlin",  # (1,) tangential over normal compliance of a dent, (2 - nu) / (2 (1 - nu))
        "error_factor",  # (1,) on the law's error, of the organ
        "modulus",  # (1,) E* without a tumour [Pa]
        "large_dent",  # (T, 6) of :func:`large_dent_of`
        "local",  # (2, nx, ny, nz) E* [Pa] and c [m/N] on a grid
        "brick",  # the ShapeFactor
        "factor",
        "factor_spacing",
    ],
)
TipLawState = namedtuple(
    "TipLawState",
    [
        "profile",
        "radius",
        "mindlin",
        "error_factor",
        "modulus",
        "large_dent",
        "local",
        "brick",
        "factor",
        "factor_spacing",
        "shape",  # (T,) log s at the tip,
        "shape_gradient",  # (T, 3) and its gradient [1/m]
        "value",  # (T, 2) s E*, c at the tip
        "gradient",  # (T, 2, 3)
        "place",  # (T,) s of the contact; above 1 the tip has sunk in to its full radius
        "elastic",  # (T,) F, or the force on an elastic organ that is dented alike [N]
        "tilt",  # TiltState, None for tips that stand upright
    ],
)


def of_planes(n_tips: int) -> ShapeFactor:
    """Zero everywhere: one brick that is none."""
    value = np.zeros((n_tips, 0, BRICK, BRICK, BRICK), np.float32)
    return ShapeFactor(np.full((1, 1, 1), -1, np.int32), value, np.array([_EVERYWHERE]))


def tip_law_arrays(
    tips: Sequence[Tip],
    material: Material,
    local: np.ndarray,
    shape: ShapeFactor | None = None,
    error_factor: float = 1.0,
    neo_hookean: bool = False,
) -> TipLawArrays | None:
    """Tables of the tips; None where all are patches.

    material : of the organ
    local : ndarray float32, shape (2, nx, ny, nz), E* and c
    shape : of each tip; None for a plane
    error_factor : on the law's error
    neo_hookean : whether the dents of spheres are those of large strain

    Raises
    ------
    ContactError
        If patches and tips are mixed.
    """
    if all(tip.shape == "patch" for tip in tips):
        return None
    if any(tip.shape == "patch" for tip in tips):
        raise ContactError("a patch and a tip press together; give all tools tips, or all patches")
    nu = material.poisson_ratio
    return TipLawArrays(
        np.stack([profile_of(tip) for tip in tips]),
        np.array([tip.radius for tip in tips]),
        np.array([(2.0 - nu) / (2.0 * (1.0 - nu))]),
        np.array([error_factor]),
        np.array([material.plane_strain_modulus]),
        np.stack([large_dent_of(tip, nu, neo_hookean) for tip in tips]),
        local,
        *(shape or of_planes(len(tips))),
    )


def tip_law_state(arrays: TipLawArrays, tilt: TiltState | None = None) -> TipLawState:
    """Without any contact."""
    n = len(arrays.radius)
    return TipLawState(
        profile=arrays.profile,
        radius=arrays.radius,
        mindlin=arrays.mindlin,
        error_factor=arrays.error_factor,
        modulus=arrays.modulus,
        large_dent=arrays.large_dent,
        local=arrays.local,
        brick=arrays.brick,
        factor=arrays.factor,
        factor_spacing=arrays.factor_spacing,
        shape=np.zeros(n),
        shape_gradient=np.zeros((n, 3)),
        value=np.ones((n, 2)),
        gradient=np.zeros((n, 2, 3)),
        place=np.zeros(n),
        elastic=np.zeros(n),
        tilt=tilt,
    )


@inlined
def sample_organ(model, law, t, tip):  # type: ignore[no-untyped-def]
    """s E* and c at a tip, with their gradients."""
    if not law.on:
        return
    cell, slope = cell_at(model.origin, model.spacing[0], tip), law.shape_gradient[t]
    for k in range(2):
        law.value[t, k] = in_cell(law.local[k], cell, law.gradient[t, k])
    fine = cell_at(model.origin, law.factor_spacing[0], tip)
    slope[:] = 0.0
    law.shape[t] = add_in_bricks(law.brick, law.factor[t], fine, slope)
    factor = np.exp(law.shape[t])
    law.value[t, STIFFNESS] *= factor
    for d in range(3):
        law.gradient[t, STIFFNESS, d] *= factor
        law.gradient[t, STIFFNESS, d] += law.value[t, STIFFNESS] * slope[d]


@inlined
def edge_below(law, t, cell):  # type: ignore[no-untyped-def]
    """How deep the lowest point of a tip that leans is below the one that its pose says [m]."""
    return 0.0 if not law.on else sample_tilt(law.tilt, t, cell)


@fast
def _at_place(law, t):  # type: ignore[no-untyped-def]
    """Weights of cubic Hermite interpolation and both ends of the table's interval at ``place``,
    the place within it, and the depth beyond the tip's full radius."""
    s = law.place[t]
    i = min(int(min(s, 1.0) * INTERVALS), INTERVALS - 1)
    u = min(s, 1.0) * INTERVALS - i
    rest, h = 1.0 - u, 1.0 / INTERVALS
    weights = (
        (1.0 + 2.0 * u) * rest * rest,
        u * u * (3.0 - 2.0 * u),
        u * rest * rest * h,
        -u * u * rest * h,
    )
    return weights, law.profile[t, i], law.profile[t, i + 1], u, max(0.0, s - 1.0) * law.radius[t]


@fast
def _hermite(weights, p, q, p_slope, q_slope):  # type: ignore[no-untyped-def]
    """Between two ends p and q, by their slopes."""
    return weights[0] * p + weights[1] * q + weights[2] * p_slope + weights[3] * q_slope


@fast
def dent(law, t):  # type: ignore[no-untyped-def]
    """delta [m], its slope by s, F / E* [m^2] and the contact radius a [m] at ``place``."""
    w, p, q, u, wall = _at_place(law, t)
    a = _hermite(w, p[0], q[0], p[1], q[1])
    g = _hermite(w, p[2], q[2], p[3], q[3])
    load = 2.0 * (_hermite(w, p[4], q[4], p[0] * p[3], q[0] * q[3]) + a * wall)
    slope = law.radius[t] if law.place[t] > 1.0 else (1.0 - u) * p[3] + u * q[3]
    return g + wall, slope, load, a


@fast
def _find_place(state, law, large_deformation, t, of_depth, of_load, target):  # type: ignore[no-untyped-def]
    """The place where of_depth [delta + eta + h] + of_load F / E* is ``target``.

    Safeguarded Newton; eta is added by large strain at the tip, h by large deformation.
    """
    s = law.place[t] if law.place[t] > 0.0 else 0.3
    low, high = 0.0, 0.0  # not bounded from above yet
    tolerance = TOLERANCE if of_depth > 0.0 else TOLERANCE * target
    for _ in range(MAX_STEPS):
        law.place[t] = s
        delta, slope, load, a = dent(law, t)
        leaning, bent, _ = evaluate_tilt(law.tilt, t, load)
        value = of_depth * (delta + leaning) + of_load * load - target
        rise = slope * (of_depth * (1.0 + 2.0 * a * bent) + 2.0 * a * of_load)
        # None, as without a step, is known when it compiles
        if large_deformation is not None and large_deformation.on and of_depth > 0.0:
            state.force[t] = law.value[t, STIFFNESS] * load
            evaluate_added_depth(state, large_deformation, t)
            added, bend = large_deformation.added_depth[t, 0], large_deformation.added_depth[t, 1]
            deeper, tangent, _ = evaluate_large_dent(law, t, load)
            value += added + deeper
            tangent += law.value[t, STIFFNESS] * bend * state.self_compliance[t]
            rise += 2.0 * a * slope * tangent
        if abs(value) <= tolerance:
            return
        if value > 0.0:
            high = s
        else:
            low = s
        new = s - value / rise if rise > 0.0 else -1.0
        if not (low < new and (high == 0.0 or new < high)):
            new = 0.5 * (low + high) if high > 0.0 else max(2.0 * s, 1.0 + 1e-9)
        if abs(new - s) <= 1e-15 * s:
            return
        s = new


@inlined
def solve_tip(state, effects, t, depth, compliance):  # type: ignore[no-untyped-def]
    """The force of a tip at a depth [m], the organ's own compliance in this period being known.

    For viscoelastic tissue the force is e / gain + held, e that on an elastic organ. Of modes with
    mass hardly any compliance is left in a period: it may be less than c, but the depth still grows
    with the force.
    """
    superposition, law = effects.superposition, effects.tip_law
    large_deformation, held = effects.large_deformation, held_load(effects.viscoelasticity, t)
    target = depth - compliance * held
    if target <= 0.0:
        law.elastic[t], law.place[t] = 0.0, 0.0
        return max(0.0, held)
    gain = superposition.near_gain[0] if superposition.on else 1.0
    stiffness = law.value[t, STIFFNESS]
    most = 0.5 * MOST_TAKEN / (stiffness * law.radius[t]) * law.large_dent[t, LEAST]
    own = max(-most, compliance / gain - law.value[t, TAKEN])
    _find_place(state, law, large_deformation, t, 1.0, stiffness * own, target)
    _, _, load, _ = dent(law, t)
    law.elastic[t] = stiffness * load
    return max(0.0, law.elastic[t] / gain + held)


@fast
def evaluate_tip(state, effects, t):  # type: ignore[no-untyped-def]
    """delta + eta - c e at the present force, and its derivative by the force."""
    superposition, law = effects.superposition, effects.tip_law
    large_deformation = effects.large_deformation
    gain = superposition.near_gain[0] if superposition.on else 1.0
    elastic = gain * (state.force[t] - held_load(effects.viscoelasticity, t))
    taken = law.value[t, TAKEN]
    law.elastic[t] = max(0.0, elastic)
    delta, a = 0.0, 0.0
    load = law.elastic[t] / law.value[t, STIFFNESS]
    if elastic > 0.0:
        _find_place(state, law, None, t, 0.0, 1.0, load)
        delta, _, _, a = dent(law, t)
    a = max(a, LEAST_CONTACT * law.radius[t])
    tangent = 1.0 / (2.0 * law.value[t, STIFFNESS] * a) - taken
    if large_deformation.on:
        deeper, slope, _ = evaluate_large_dent(law, t, load)
        delta += deeper
        tangent += slope / law.value[t, STIFFNESS]
    leaning, slope, _ = evaluate_tilt(law.tilt, t, load)
    delta += leaning
    tangent += slope / law.value[t, STIFFNESS]
    return delta - taken * law.elastic[t], gain * tangent


@fast
def added_depth(state, effects, t):  # type: ignore[no-untyped-def]
    """Depth beside C lambda at the present force: of the dent and of large deformation.

    Returns it [m] and its derivative by the force [m/N].
    """
    law, large_deformation = effects.tip_law, effects.large_deformation
    depth = tangent = 0.0
    if law.on:
        depth, tangent = evaluate_tip(state, effects, t)
    if large_deformation.on:
        evaluate_added_depth(state, large_deformation, t)
        depth += large_deformation.added_depth[t, 0]
        tangent += large_deformation.added_depth[t, 1] * state.self_compliance[t]
    return depth, tangent


@fast
def tangential_compliance(law, t):  # type: ignore[no-untyped-def]
    """Of the dent for a tangential force, less that of the patch [m/N].

    rho / (2 E* a) with rho = (2 - nu) / (2 (1 - nu)), 1 / (8 G a) of Mindlin (J. Appl. Mech.
    16:259, 1949) for a contact that sticks everywhere; the patch's is rho c.
    """
    _, _, _, a = dent(law, t)
    a = max(a, LEAST_CONTACT * law.radius[t])
    return law.mindlin[0] * (0.5 / (law.value[t, STIFFNESS] * a) - law.value[t, TAKEN])


@fast
def add_tip_force(state, law, large_deformation, out, t):  # type: ignore[no-untyped-def]
    """The derivative of the dent's energy at constant force, relaxed as the force has."""
    if not law.on:
        return
    e = law.elastic[t]
    if e <= 0.0:
        return
    stored = _stored(law, t)
    stiffness, gradient = law.value[t, STIFFNESS], law.gradient[t]
    if large_deformation.on:
        stored += evaluate_large_dent(law, t, e / stiffness)[2]
    stored += evaluate_tilt(law.tilt, t, e / stiffness)[2]
    relaxed = state.force[t] / e
    for d in range(3):
        change = stored * gradient[STIFFNESS, d] + 0.5 * e * e * gradient[TAKEN, d]
        out.force[t, d] -= change * relaxed
    add_righting(law.tilt, out, t, stiffness, e, relaxed)


@inlined
def law_error(law, steepness, t):  # type: ignore[no-untyped-def]
    """Relative error of the force by the law alone, larger over tumours, where the surface is no
    plane, and where the gap grows by another length than the tip moves: by as much, the force is
    not that of its load."""
    plain = law.value[t, STIFFNESS] * np.exp(-law.shape[t])
    more = TUMOUR_ERROR * abs(plain / law.modulus[0] - 1.0) + SHAPE_ERROR * abs(law.shape[t])
    more += abs(steepness - 1.0)
    return law.error_factor[0] * (LAW_ERROR + more)


@fast
def _stored(law, t):  # type: ignore[no-untyped-def]
    """Phi [m^3] at ``place``."""
    w, p, q, _, wall = _at_place(law, t)
    a = _hermite(w, p[0], q[0], p[1], q[1])
    first = _hermite(w, p[4], q[4], p[0] * p[3], q[0] * q[3])
    phi = _hermite(w, p[5], q[5], 2.0 * p[4] * p[3], 2.0 * q[4] * q[3])
    return phi + (2.0 * first + a * wall) * wall


@entry
def loads_at_depths(law, softness, depth, load):  # type: ignore[no-untyped-def]
    """F / E* [m^2] of the first tip at depths [m], over an organ that gives way by ``softness``
    F / E* beside the dent, E* (gamma - c) [1/m]; all (n,), the last is written."""
    for i in range(len(load)):
        law.place[0] = 0.0
        _find_place(None, law, None, 0, 1.0, softness[i], depth[i])
        load[i] = dent(law, 0)[2]
