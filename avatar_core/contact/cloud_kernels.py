"""The compiled part of the contact step that deforms the cloud.

    u(x) = sum_r sum_k Z_rbk(x) sum_m C_rbkm a_rm,    x in block b of the cloud,
    a_rm = - sum_t lambda_t sum_j w_j W_m(s_j) . n_t,

over the load positions j of region r that carry a tip, with the modes Z and the core C of
:mod:`avatar_core.contact.cloud`, and for large deformation the terms of
:mod:`avatar_core.vademecum.large_deformation`. The global modes are part of every region's field;
what they move by more than the loads that are shown (vibration, weight, faded history) stands
apart, as a part of its own. That is an organ under patches; near a tip,
:mod:`avatar_core.contact.dent` shows the tip's dent.

A step reads the modes of the regions that are *touched*: those of the load positions that carry a
tip or hold a history of loads.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import entry, fast, inlined
from avatar_core.contact.cloud import BLOCK
from avatar_core.contact.display import write_cloud
from avatar_core.contact.effects.large_deformation import add_nonlinear_load, powers_of_depth
from avatar_core.contact.effects.respiration import shift_cloud
from avatar_core.contact.effects.viscoelasticity import least_shown

ALL = 1 << 30  # a level that no mode has
LEAST_WEIGHT = 0.02  # of the load positions of a region, below which its modes are left out
MAX_PAST = 4  # regions whose history of loads is shown


@fast
def deform(model, state, out, effects):  # type: ignore[no-untyped-def]
    """The cloud under the forces of a period."""
    e = effects
    _displace(model, state, out, effects)
    write_cloud(model, state, out.cloud, e.tip_law, e.dent, e.display)
    shift_cloud(e.respiration, out.cloud)


@fast
def _displace(model, state, out, effects):  # type: ignore[no-untyped-def]
    """The displacement of all points into ``state.field``."""
    superposition, large_deformation = effects.superposition, effects.large_deformation
    viscoelasticity = effects.viscoelasticity
    if not superposition.on and out.n_contacts[0] == 0:
        state.field[:] = np.float32(0.0)
        return
    _release_regions(state)
    if viscoelasticity.on:
        _load_past(model, state, large_deformation, viscoelasticity)
    for t in range(state.passage.shape[0]):
        if state.force[t] > 0.0:
            _load_regions(model, state, effects, t)
    _move_globals(model, state, superposition)
    _sum_modes(model, state, large_deformation)


@fast
def _move_globals(model, state, superposition):  # type: ignore[no-untyped-def]
    """Amplitudes that the effects give to the global modes, less those of the touched regions."""
    if not superposition.on:
        return
    for k in range(model.region_start[0]):
        moved = superposition.total[k]
        for q in range(state.n_touched[0]):
            moved -= state.amplitude[model.region_start[state.touched[q]] + k]
        state.amplitude[k] = np.float32(moved)


@fast
def _release_regions(state):  # type: ignore[no-untyped-def]
    for i in range(state.n_touched[0]):
        state.is_touched[state.touched[i]] = False
    state.n_touched[0] = 0


@inlined
def _touch(model, state, large_deformation, r):  # type: ignore[no-untyped-def]
    """Clear the amplitudes of a region that was not touched before."""
    if state.is_touched[r]:
        return
    state.is_touched[r] = True
    state.touched[state.n_touched[0]] = r
    state.n_touched[0] += 1
    state.amplitude[model.region_start[r] : model.region_start[r + 1]] = np.float32(0.0)
    if large_deformation.on:
        start = large_deformation.start
        state.amplitude[start[r] : start[r + 1]] = np.float32(0.0)


@fast
def _add_load(model, state, j, x, y, z):  # type: ignore[no-untyped-def]
    """Amplitudes of a region by a force at one of its load positions."""
    first, end = model.region_start[model.region[j]], model.region_start[model.region[j] + 1]
    amplitude, load = state.amplitude[first:end], model.regional_load[j]
    f0, f1, f2 = np.float32(x), np.float32(y), np.float32(z)
    for k in range(amplitude.shape[0]):
        amplitude[k] += load[0, k] * f0 + load[1, k] * f1 + load[2, k] * f2


@fast
def _load_regions(model, state, effects, t):  # type: ignore[no-untyped-def]
    """The force of a tip on the regions of the load positions that carry it.

    A region fades out before the tip leaves it, so that few are read; the others take its part.
    """
    large_deformation, friction = effects.large_deformation, effects.friction
    viscoelasticity = effects.viscoelasticity
    region_weight, kept = state.region_weight, 0.0
    for i in range(state.n_nodes[t]):
        region_weight[model.region[state.nodes[t, i]]] = 0.0
    for i in range(state.n_nodes[t]):
        region_weight[model.region[state.nodes[t, i]]] += state.weight[t, i, 0]
    for i in range(state.n_nodes[t]):
        kept += _kept_weight(model, state, t, i)
    n = state.normal[t]
    f0, f1, f2 = -state.force[t] * n[0], -state.force[t] * n[1], -state.force[t] * n[2]
    if friction.on:
        f0, f1, f2 = friction.push[t, 0], friction.push[t, 1], friction.push[t, 2]
    second = third = 0.0
    if large_deformation.on:
        second, third = powers_of_depth(state, large_deformation, t)
    for i in range(state.n_nodes[t]):
        j, w = state.nodes[t, i], _kept_weight(model, state, t, i)
        if w != 0.0:
            r = model.region[j]
            _touch(model, state, large_deformation, r)
            if not viscoelasticity.on:
                part = w / kept
                _add_load(model, state, j, part * f0, part * f1, part * f2)
            if large_deformation.on:
                add_nonlinear_load(state, large_deformation, r, j, w / kept, second, third)


@inlined
def _kept_weight(model, state, t, i):  # type: ignore[no-untyped-def]
    """Weight of a load position, less what its region as a whole has faded."""
    whole = state.region_weight[model.region[state.nodes[t, i]]]
    return state.weight[t, i, 0] * soft_threshold(whole) / whole if whole != 0.0 else 0.0


@inlined
def soft_threshold(w):  # type: ignore[no-untyped-def]
    """Soft thresholding, so that the modes of a region vanish continuously."""
    if w > 0.0:
        return max(w - LEAST_WEIGHT, 0.0)
    return min(w + LEAST_WEIGHT, 0.0)


@fast
def _load_past(model, state, large_deformation, viscoelasticity):  # type: ignore[no-untyped-def]
    """The load history on its regions; the weakest loads fade out, and so do weak regions."""
    least = least_shown(viscoelasticity)
    for m in range(viscoelasticity.count[0]):
        e, j = viscoelasticity.near_elastic[m], viscoelasticity.position[m]
        size = np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
        if size > least:
            part = (size - least) / size
            _touch(model, state, large_deformation, model.region[j])
            _add_load(model, state, j, part * e[0], part * e[1], part * e[2])
    if state.n_touched[0] > MAX_PAST:
        _fade_regions(model, state)


@fast
def _fade_regions(model, state):  # type: ignore[no-untyped-def]
    """Keep the ``MAX_PAST`` regions whose own modes move most, less what the next one moves."""
    norm, n, n_global = state.region_weight, state.n_touched[0], model.region_start[0]
    for i in range(n):
        r = state.touched[i]
        norm[r] = 0.0
        for k in range(model.region_start[r] + n_global, model.region_start[r + 1]):
            norm[r] += np.float64(state.amplitude[k]) ** 2  # of modes with a peak of 1
        norm[r] = np.sqrt(norm[r])
    bound = np.inf  # in the end the norm of the region after the last that is kept
    for _ in range(MAX_PAST + 1):
        largest = 0.0
        for i in range(n):
            if norm[state.touched[i]] < bound:
                largest = max(largest, norm[state.touched[i]])
        bound = largest
    kept = 0
    for i in range(n):
        r = state.touched[i]
        if norm[r] > bound:
            factor = np.float32((norm[r] - bound) / norm[r])
            for k in range(model.region_start[r], model.region_start[r + 1]):
                state.amplitude[k] *= factor
            state.touched[kept] = r
            kept += 1
        else:
            state.is_touched[r] = False
    state.n_touched[0] = kept


@fast
def _sum_modes(model, state, large_deformation):  # type: ignore[no-untyped-def]
    """The displacement of every block: of global modes that stand apart, and of touched regions."""
    amplitude, start, shown = state.amplitude, model.region_start, state.shown[0]
    space, core, level, rows = model.space, model.core, model.level, model.block_start
    n_global, n_regions = start[0], start.shape[0] - 1
    for b in range(rows.shape[1] - 1):
        u = state.field[b * BLOCK : (b + 1) * BLOCK]
        for i in range(BLOCK):
            u[i] = np.float32(0.0)
        add_part(space, core, level, rows[0], amplitude[:n_global], ALL, b, u)
        for q in range(state.n_touched[0]):
            r = state.touched[q]
            own = amplitude[start[r] : start[r + 1]]
            add_part(space, core, level, rows[1 + r], own, shown, b, u)
            if large_deformation.on:
                first, end = large_deformation.start[r], large_deformation.start[r + 1]
                bent = rows[1 + n_regions + r]
                add_part(space, core, level, bent, amplitude[first:end], ALL, b, u)


@fast
def add_part(space, core, level, rows, amplitude, shown, b, u):  # type: ignore[no-untyped-def]
    """Add what a part of the modes, up to a level, moves in a block; four modes at a time."""
    first, end = rows[b], rows[b + 1]
    while end > first and level[end - 1] > shown:
        end -= 1
    whole = end - (end - first) % 4
    for k in range(first, whole, 4):
        a0 = a1 = a2 = a3 = np.float32(0.0)
        for m in range(amplitude.shape[0]):
            a = amplitude[m]
            a0 += core[k, m] * a
            a1 += core[k + 1, m] * a
            a2 += core[k + 2, m] * a
            a3 += core[k + 3, m] * a
        z0, z1, z2, z3 = space[k], space[k + 1], space[k + 2], space[k + 3]
        for i in range(BLOCK):
            u[i] += z0[i] * a0 + z1[i] * a1 + z2[i] * a2 + z3[i] * a3
    for k in range(whole, end):
        a0 = np.float32(0.0)
        for m in range(amplitude.shape[0]):
            a0 += core[k, m] * amplitude[m]
        z0 = space[k]
        for i in range(BLOCK):
            u[i] += z0[i] * a0


@entry
def add_to_field(space, core, level, rows, amplitude, shown, field):  # type: ignore[no-untyped-def]
    """What a part of the modes moves in all blocks, for who measures the errors of a step."""
    for b in range(rows.shape[0] - 1):
        u = field[b * BLOCK : (b + 1) * BLOCK]
        add_part(space, core, level, rows, amplitude, shown, b, u)
