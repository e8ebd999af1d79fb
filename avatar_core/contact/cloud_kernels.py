"""Compiled kernels of the contact step that deform the cloud.

    u(x) = sum_r sum_k Z_rbk(x) sum_m C_rbkm a_rm,    x in block b of the cloud,
    a_rm = - sum_t lambda_t sum_j w_j W_m(s_j) . n_t,

over the load positions j of region r that carry a tip. The modes Z and the core C are those of
:mod:`avatar_core.reduction.block_field`; large deformation adds the terms of
:mod:`avatar_core.vademecum.large_deformation`. The global modes are part of every region's field.
Their motion beyond the displayed loads (vibration, weight, faded history) is a part of its own.
This is the organ under patches; near a tip, :mod:`avatar_core.tips.dent` displays the tip's dent.

A step reads the modes of the *touched* regions: those whose load positions carry a tip or hold a
history of loads.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import entry, fast, inlined
from avatar_core.contact.display import write_cloud
from avatar_core.contact.effects.friction import force_on_tissue
from avatar_core.contact.effects.large_deformation import add_nonlinear_load, powers_of_depth
from avatar_core.contact.effects.respiration import shift_cloud
from avatar_core.contact.effects.viscoelasticity import least_shown
from avatar_core.reduction.block_field import BLOCK

ALL = 1 << 30  # a level that no mode has
LEAST_WEIGHT = 0.02  # weight of a region's load positions below which its modes are left out
MAX_PAST = 4  # regions whose history of loads is shown


@fast
def deform(model, data):  # type: ignore[no-untyped-def]
    """Deform the cloud by the forces of a period."""
    _displace(model, data)
    write_cloud(model, data)
    shift_cloud(model, data)


@fast
def _displace(model, data):  # type: ignore[no-untyped-def]
    """Write the displacement of all points to ``data.field``."""
    if not model.moving[0] and data.out.n_contacts[0] == 0:
        data.field[:] = np.float32(0.0)
        return
    _release_regions(data)
    if model.viscoelasticity.on:
        _load_past(model, data)
    for t in range(data.passage.shape[0]):
        if data.force[t] > 0.0:
            _load_regions(model, data, t)
    _move_globals(model, data)
    _sum_modes(model, data)


@fast
def _move_globals(model, data):  # type: ignore[no-untyped-def]
    """Set the amplitudes that effects give the global modes, less those of the touched regions."""
    if not model.moving[0]:
        return
    for k in range(model.region_start[0]):
        moved = data.superposition.total[k]
        for q in range(data.n_touched[0]):
            moved -= data.amplitude[model.region_start[data.touched[q]] + k]
        data.amplitude[k] = np.float32(moved)


@fast
def _release_regions(data):  # type: ignore[no-untyped-def]
    for i in range(data.n_touched[0]):
        data.is_touched[data.touched[i]] = False
    data.n_touched[0] = 0


@inlined
def _touch(model, data, r):  # type: ignore[no-untyped-def]
    """Clear the amplitudes of a region that was not touched before."""
    if data.is_touched[r]:
        return
    data.is_touched[r] = True
    data.touched[data.n_touched[0]] = r
    data.n_touched[0] += 1
    data.amplitude[model.region_start[r] : model.region_start[r + 1]] = np.float32(0.0)
    if model.large_deformation.on:
        start = model.large_deformation.start
        data.amplitude[start[r] : start[r + 1]] = np.float32(0.0)


@fast
def _add_load(model, data, j, x, y, z):  # type: ignore[no-untyped-def]
    """Add the amplitudes of a region by a force at one of its load positions."""
    first, end = model.region_start[model.region[j]], model.region_start[model.region[j] + 1]
    amplitude, load = data.amplitude[first:end], model.regional_load[j]
    f0, f1, f2 = np.float32(x), np.float32(y), np.float32(z)
    for k in range(amplitude.shape[0]):
        amplitude[k] += load[0, k] * f0 + load[1, k] * f1 + load[2, k] * f2


@fast
def _load_regions(model, data, t):  # type: ignore[no-untyped-def]
    """Add the force of a tip to the regions of the load positions that carry it.

    A region fades out before the tip leaves it, so that few regions are read; the others take over
    its part of the force.
    """
    region_weight, kept = data.region_weight, 0.0
    for i in range(data.n_nodes[t]):
        region_weight[model.region[data.nodes[t, i]]] = 0.0
    for i in range(data.n_nodes[t]):
        region_weight[model.region[data.nodes[t, i]]] += data.weight[t, i, 0]
    for i in range(data.n_nodes[t]):
        kept += _kept_weight(model, data, t, i)
    f0, f1, f2 = force_on_tissue(model, data, t)
    powers = (0.0, 0.0, 0)
    if model.large_deformation.on:
        powers = powers_of_depth(model, data, t)
    for i in range(data.n_nodes[t]):
        j, w = data.nodes[t, i], _kept_weight(model, data, t, i)
        if w != 0.0:
            r = model.region[j]
            _touch(model, data, r)
            if not model.viscoelasticity.on:
                part = w / kept
                _add_load(model, data, j, part * f0, part * f1, part * f2)
            if powers[0] != 0.0:
                add_nonlinear_load(model, data, r, j, w / kept, powers)


@inlined
def _kept_weight(model, data, t, i):  # type: ignore[no-untyped-def]
    """Return the weight of a load position, reduced as its region fades."""
    whole = data.region_weight[model.region[data.nodes[t, i]]]
    return data.weight[t, i, 0] * soft_threshold(whole) / whole if whole != 0.0 else 0.0


@inlined
def soft_threshold(w):  # type: ignore[no-untyped-def]
    """Return a weight after soft thresholding, so that modes of a region vanish continuously."""
    if w > 0.0:
        return max(w - LEAST_WEIGHT, 0.0)
    return min(w + LEAST_WEIGHT, 0.0)


@fast
def _load_past(model, data):  # type: ignore[no-untyped-def]
    """Add the load history to its regions; the weakest loads fade out, and so do weak regions."""
    past = data.viscoelasticity
    least = least_shown(data)
    for m in range(past.count[0]):
        e, j = past.near_elastic[m], past.position[m]
        size = np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
        if size > least:
            part = (size - least) / size
            _touch(model, data, model.region[j])
            _add_load(model, data, j, part * e[0], part * e[1], part * e[2])
    if data.n_touched[0] > MAX_PAST:
        _fade_regions(model, data)


@fast
def _fade_regions(model, data):  # type: ignore[no-untyped-def]
    """Keep the ``MAX_PAST`` regions whose own modes move most; subtract the next one's motion."""
    norm, n, n_global = data.region_weight, data.n_touched[0], model.region_start[0]
    for i in range(n):
        r = data.touched[i]
        norm[r] = 0.0
        for k in range(model.region_start[r] + n_global, model.region_start[r + 1]):
            norm[r] += np.float64(data.amplitude[k]) ** 2  # modes have a peak of 1
        norm[r] = np.sqrt(norm[r])
    bound = np.inf  # in the end the norm of the region after the last that is kept
    for _ in range(MAX_PAST + 1):
        largest = 0.0
        for i in range(n):
            if norm[data.touched[i]] < bound:
                largest = max(largest, norm[data.touched[i]])
        bound = largest
    kept = 0
    for i in range(n):
        r = data.touched[i]
        if norm[r] > bound:
            factor = np.float32((norm[r] - bound) / norm[r])
            for k in range(model.region_start[r], model.region_start[r + 1]):
                data.amplitude[k] *= factor
            data.touched[kept] = r
            kept += 1
        else:
            data.is_touched[r] = False
    data.n_touched[0] = kept


@fast
def _sum_modes(model, data):  # type: ignore[no-untyped-def]
    """Sum the displacement of every block: global modes apart, and touched regions."""
    amplitude, start, shown = data.amplitude, model.region_start, data.shown[0]
    space, core, level, rows = model.space, model.core, model.level, model.block_start
    n_global, n_regions = start[0], start.shape[0] - 1
    for b in range(rows.shape[1] - 1):
        u = data.field[b * BLOCK : (b + 1) * BLOCK]
        for i in range(BLOCK):
            u[i] = np.float32(0.0)
        if model.moving[0]:
            add_part(space, core, level, rows[0], amplitude[:n_global], ALL, b, u)
        for q in range(data.n_touched[0]):
            r = data.touched[q]
            own = amplitude[start[r] : start[r + 1]]
            add_part(space, core, level, rows[1 + r], own, shown, b, u)
            if model.large_deformation.on:
                first, end = model.large_deformation.start[r], model.large_deformation.start[r + 1]
                bent = rows[1 + n_regions + r]
                add_part(space, core, level, bent, amplitude[first:end], ALL, b, u)


@fast
def add_part(space, core, level, rows, amplitude, shown, b, u):  # type: ignore[no-untyped-def]
    """Add the displacement of a block by a part's modes, up to a level; four modes at a time."""
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
    """Add the displacement of all blocks by a part's modes, to measure a step's errors."""
    for b in range(rows.shape[0] - 1):
        u = field[b * BLOCK : (b + 1) * BLOCK]
        add_part(space, core, level, rows, amplitude, shown, b, u)
