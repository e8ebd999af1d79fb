"""The force of a tip at a depth, or its depth at a force, with all terms of its dent.

    d = delta + eta + F (gamma - c) + k h        (:mod:`avatar_core.tips.law`)

eta is added by large strain under the tip, h by large deformation of the organ; a punch that leans
touches with its edge first. All are functions of one place s on the tip's profile, which a
safeguarded Newton's method finds.
"""

from __future__ import annotations

from avatar_core.common.jit import entry, fast, inlined
from avatar_core.contact.effects.large_deformation import evaluate_added_depth
from avatar_core.contact.effects.tilt import add_righting, evaluate_tilt
from avatar_core.contact.effects.viscoelasticity import held_load
from avatar_core.tips.large_strain import LEAST, evaluate_large_dent
from avatar_core.tips.law import LEAST_CONTACT, dent, stored_energy
from avatar_core.tips.profile import STIFFNESS, TAKEN

MOST_TAKEN = 0.9  # part of a dent's least compliance, 1 / (2 E* radius), that may be taken off
MAX_STEPS = 60  # steps of Newton's method, with bisection where it leaves its bracket
TOLERANCE = 1e-13  # [m] of depth, or relative of the force


@fast
def _find_place(model, data, t, of_depth, of_load, target):  # type: ignore[no-untyped-def]
    """Find the place where of_depth [delta + eta + h] + of_load F / E* is ``target``.

    Safeguarded Newton; eta is added by large strain at the tip, h by large deformation.
    """
    law = data.law
    s = law.place[t] if law.place[t] > 0.0 else 0.3
    low, high = 0.0, 0.0  # not bounded from above yet
    tolerance = TOLERANCE if of_depth > 0.0 else TOLERANCE * target
    for _ in range(MAX_STEPS):
        law.place[t] = s
        delta, slope, load, a = dent(model, data, t)
        leaning, bent, _ = evaluate_tilt(model, data, t, load)
        value = of_depth * (delta + leaning) + of_load * load - target
        rise = slope * (of_depth * (1.0 + 2.0 * a * bent) + 2.0 * a * of_load)
        if model.large_deformation.on and of_depth > 0.0:
            data.force[t] = law.value[t, STIFFNESS] * load
            evaluate_added_depth(data, t)
            added, bend = (
                data.large_deformation.added_depth[t, 0],
                data.large_deformation.added_depth[t, 1],
            )
            deeper, tangent, _ = evaluate_large_dent(model, t, load)
            value += added + deeper
            tangent += law.value[t, STIFFNESS] * bend * data.self_compliance[t]
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
def solve_tip(model, data, t, depth, compliance):  # type: ignore[no-untyped-def]
    """Return the force of a tip at a depth [m], for the organ's own compliance in this period.

    In viscoelastic tissue the force is e / gain + held, with e the force on an elastic organ. Modes
    with mass have hardly any compliance left in a period. It may be less than c, but the depth
    still grows with the force.
    """
    law = data.law
    held = held_load(model, data, t)
    target = depth - compliance * held
    if target <= 0.0:
        law.elastic[t], law.place[t] = 0.0, 0.0
        return max(0.0, held)
    gain = data.superposition.near_gain[0] if model.superposed[0] else 1.0
    stiffness = law.value[t, STIFFNESS]
    most = 0.5 * MOST_TAKEN / (stiffness * model.law.radius[t]) * model.law.large_dent[t, LEAST]
    own = max(-most, compliance / gain - law.value[t, TAKEN])
    _find_place(model, data, t, 1.0, stiffness * own, target)
    _, _, load, _ = dent(model, data, t)
    law.elastic[t] = stiffness * load
    return max(0.0, law.elastic[t] / gain + held)


@fast
def evaluate_tip(model, data, t):  # type: ignore[no-untyped-def]
    """Return delta + eta - c e at the present force, and its derivative by the force."""
    law = data.law
    gain = data.superposition.near_gain[0] if model.superposed[0] else 1.0
    elastic = gain * (data.force[t] - held_load(model, data, t))
    taken = law.value[t, TAKEN]
    law.elastic[t] = max(0.0, elastic)
    delta, a = 0.0, 0.0
    load = law.elastic[t] / law.value[t, STIFFNESS]
    if elastic > 0.0:
        _find_place(model, data, t, 0.0, 1.0, load)
        delta, _, _, a = dent(model, data, t)
    a = max(a, LEAST_CONTACT * model.law.radius[t])
    tangent = 1.0 / (2.0 * law.value[t, STIFFNESS] * a) - taken
    if model.large_deformation.on:
        deeper, slope, _ = evaluate_large_dent(model, t, load)
        delta += deeper
        tangent += slope / law.value[t, STIFFNESS]
    leaning, slope, _ = evaluate_tilt(model, data, t, load)
    delta += leaning
    tangent += slope / law.value[t, STIFFNESS]
    return delta - taken * law.elastic[t], gain * tangent


@fast
def added_depth(model, data, t):  # type: ignore[no-untyped-def]
    """Return the depth beside C lambda at the present force [m], and its derivative [m/N].

    It comes from the dent and from large deformation.
    """
    depth = tangent = 0.0
    if model.law.on:
        depth, tangent = evaluate_tip(model, data, t)
    if model.large_deformation.on:
        evaluate_added_depth(data, t)
        depth += data.large_deformation.added_depth[t, 0]
        tangent += data.large_deformation.added_depth[t, 1] * data.self_compliance[t]
    return depth, tangent


@fast
def add_tip_force(model, data, t):  # type: ignore[no-untyped-def]
    """Add the derivative of the dent's energy at constant force, relaxed like the force."""
    law = data.law
    if not model.law.on:
        return
    e = law.elastic[t]
    if e <= 0.0:
        return
    stored = stored_energy(model, data, t)
    stiffness, gradient = law.value[t, STIFFNESS], law.gradient[t]
    if model.large_deformation.on:
        stored += evaluate_large_dent(model, t, e / stiffness)[2]
    stored += evaluate_tilt(model, data, t, e / stiffness)[2]
    relaxed = data.force[t] / e
    for d in range(3):
        change = stored * gradient[STIFFNESS, d] + 0.5 * e * e * gradient[TAKEN, d]
        data.out.force[t, d] -= change * relaxed
    add_righting(model, data, t, stiffness, e, relaxed)


@entry
def loads_at_depths(model, data, softness, depth, load):  # type: ignore[no-untyped-def]
    """Write F / E* [m^2] of the first tip at depths [m], all (n,), to ``load``.

    The organ gives way by ``softness`` F / E* beside the dent, softness = E* (gamma - c) [1/m].
    """
    for i in range(len(load)):
        data.law.place[0] = 0.0
        _find_place(model, data, 0, 1.0, softness[i], depth[i])
        load[i] = dent(model, data, 0)[2]
