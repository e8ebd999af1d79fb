"""Several tools in contact at once, coupled through the compliance of the organ.

    gap_t + sum_t' C_tt' lambda_t' >= 0,    C_tt' = f_t . C f_t' + D_tt' n_t . n_t'

with the far field between all tips and the near field between tips that are close. The stencils
blur C under each tip by b_t = gamma - f_t . C f_t. Between two tips they blur it too: at the
distance rho of their contacts

    D = sqrt(b_t b_t') Q(rho / R_p),

Q of :mod:`avatar_core.fem.patch_on_plane`. C is the compliance of patches; a real tip moves the
surface beside it differently. Like under the tip itself (:mod:`avatar_core.tips.law`), the effect
of one patch on another on a half-space is replaced by the effect of a tip,

    D += [1 / (pi sqrt(rho^2 + w_t^2 + w_t'^2)) - P(rho / R_p) / R_p] / E*,

w a part of the tip's radius, so that tips in one place keep C positive definite. Beside a contact
that is 1 / (pi rho), within 5 % where two balls touch each other. Action equals reaction because C
is symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast, inlined
from avatar_core.contact.effects.base import Effect, Ground
from avatar_core.contact.effects.viscoelasticity import held_load
from avatar_core.fem.patch_on_plane import meeting, meeting_table, shared_blur
from avatar_core.reduction.near_field import find_block

WIDTH = 0.36  # w over a tip's radius: two in one place give way less than a contact of 0.8 of it


@dataclass(frozen=True)
class SeveralTools(Effect):
    """More than one tool touches at once, coupled through the organ.

    Examples
    --------
    >>> tools = av.Tool("left"), av.Tool("right")
    >>> len(av.Scene(tools=tools, effects=(av.effects.SeveralTools(),)).tools)
    2
    """

    name: ClassVar[str] = "several_tools"
    text: ClassVar[str] = "tools are coupled through the organ"
    Constants: ClassVar[Any] = kind(
        "SeveralTools",
        reach=array("1"),  # reach of the near field [m]
        patch_radius=array("1"),  # [m]
        meeting=array("i 4"),  # see meeting_table
    )
    State: ClassVar[Any] = kind(
        "SeveralToolsState",
        # near displacement at the nodes of the second tip by a unit normal force of the first
        column=array("T T S 3", np.float32),
        near=array("T T", np.bool_),  # whether near fields overlap
        extent=array("T"),  # radius of a tip's nodes [m]
        matrix=array("T T"),  # C, with the tangent of large deformation
        factor=array("T T"),  # its Cholesky factor
        free_gap=array("T"),  # gap without any force [m]
        trial=array("T"),  # forces that close the gaps of the active set [N]
        active_set=array("T", np.bool_),  # tips whose gap is closed
        apart=array("T T"),  # distance of the contacts [m],
        beside=array("T T"),  # D [m/N]
        beside_slope=array("T T"),  # and dD/drho [1/N],
        blurred=array("T T"),  # and sqrt(b_t b_t') Q [m/N]
    )
    superposed: ClassVar[bool] = True

    def lay_out(self, ground: Ground) -> Any:
        """Return the arrays that couple the tools."""
        radius = np.array([ground.vademecum.surface.patch_radius])
        return self.Constants(np.array([ground.reach]), radius, meeting_table())


@inlined
def couple_near_fields(model, data):  # type: ignore[no-untyped-def]
    """Couple near fields between all pairs of tips in contact; with friction, note overlaps."""
    several = data.several_tools
    if not model.several_tools.on:
        return
    n_tools = data.passage.shape[0]
    for t in range(n_tools):
        if data.active[t]:
            _measure_extent(model, data, t)
    for t in range(n_tools):
        for s in range(t):
            several.near[t, s] = several.near[s, t] = False
            if data.active[t] and data.active[s]:
                near = _are_near(model, data, t, s)
                several.near[t, s] = several.near[s, t] = near
                if not model.friction.on and near:
                    _couple_pair(model, data, t, s)
                place_beside(model, data, t, s)


@fast
def place_beside(model, data, t, s):  # type: ignore[no-untyped-def]
    """Compute D of two tips in contact, and its slope."""
    several, table = data.several_tools, model.law
    square = 0.0
    for d in range(3):
        square += (data.point[t, d] - data.point[s, d]) ** 2
    rho, radius = np.sqrt(square), model.several_tools.patch_radius[0]
    blurred = np.sqrt(max(0.0, data.blurred[t]) * max(0.0, data.blurred[s]))
    part, fall = shared_blur(model.several_tools.meeting, rho / radius)
    value, slope = blurred * part, blurred * fall / radius
    several.blurred[t, s] = several.blurred[s, t] = value
    if model.law.on:
        wide = square + WIDTH**2 * (table.radius[t] ** 2 + table.radius[s] ** 2)
        met, rise = meeting(model.several_tools.meeting, rho / radius)
        point = 1.0 / (np.pi * np.sqrt(wide))
        value += (point - met / radius) / table.modulus[0]
        slope += (-point * rho / wide - rise / radius**2) / table.modulus[0]
    several.apart[t, s] = several.apart[s, t] = rho
    several.beside[t, s] = several.beside[s, t] = value
    several.beside_slope[t, s] = several.beside_slope[s, t] = slope


@fast
def add_history_beside(model, data, t):  # type: ignore[no-untyped-def]
    """Add the others' remembered dents to a tip's displacement without load [m]."""
    if not model.several_tools.on:
        return
    for s in range(data.passage.shape[0]):
        if s != t and data.active[s]:
            held = held_load(model, data, s)
            dent = data.superposition.near_gain[0] * data.several_tools.beside[t, s] * held
            for d in range(3):
                data.superposition.free_displacement[t, d] += dent * data.normal[s, d]


@fast
def derivative_beside(model, data, t, p, d, sharper):  # type: ignore[no-untyped-def]
    """Return the derivative of the tips' coupling by D, along one axis, at constant forces.

    The contact of a tip is at p - phi n; ``sharper`` is half the derivative of b_t.
    """
    several = data.several_tools
    total = 0.0
    if not model.several_tools.on:
        return total
    n, turn, phi = data.normal[t], data.superposition.normal_gradient, 0.0
    for i in range(3):
        phi += (p[i] - data.point[t, i]) * n[i]
    for s in range(data.passage.shape[0]):
        if s == t or data.force[s] <= 0.0:
            continue
        held = held_load(model, data, s)
        along = shared = turned = 0.0
        for i in range(3):
            moved = (1.0 if i == d else 0.0) - n[i] * data.slope[t, d] - phi * turn[i, d]
            along += (data.point[t, i] - data.point[s, i]) * moved
            if model.friction.on:
                g = data.friction.push[s, i] + held * data.normal[s, i]
                shared += data.friction.push[t, i] * g
            else:
                g = data.force[t] * (data.force[s] - held) * data.normal[s, i]
                shared += n[i] * g
                turned += turn[i, d] * g
        slope = several.beside_slope[t, s] * along / max(several.apart[t, s], 1e-12)
        if data.blurred[t] > 0.0:
            slope += several.blurred[t, s] * sharper / data.blurred[t]
        total += slope * shared + several.beside[t, s] * turned
    return data.superposition.near_gain[0] * total


@fast
def _measure_extent(model, data, t):  # type: ignore[no-untyped-def]
    farthest = 0.0
    for i in range(data.n_nodes[t]):
        j, square = data.nodes[t, i], 0.0
        for d in range(3):
            square += (model.position[j, d] - data.point[t, d]) ** 2
        farthest = max(farthest, square)
    data.several_tools.extent[t] = np.sqrt(farthest)


@fast
def _are_near(model, data, t, s):  # type: ignore[no-untyped-def]
    apart = 0.0
    for d in range(3):
        apart += (data.point[s, d] - data.point[t, d]) ** 2
    extent = data.several_tools.extent
    return np.sqrt(apart) < model.several_tools.reach[0] + extent[t] + extent[s]


@fast
def _couple_pair(model, data, t, s):  # type: ignore[no-untyped-def]
    """Couple the near fields of two tips.

    By Maxwell and Betti the block from m to j is the transpose of the block from j to m.
    """
    there, back = data.several_tools.column[t, s], data.several_tools.column[s, t]
    there[: data.n_nodes[s]] = np.float32(0.0)
    back[: data.n_nodes[t]] = np.float32(0.0)
    n, m, zero = data.normal[t], data.normal[s], np.float32(0.0)
    for i in range(data.n_nodes[t]):
        j, w = data.nodes[t, i], data.weight[t, i, 0]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        u0 = u1 = u2 = zero
        for q in range(data.n_nodes[s]):
            e = find_block(model.contact_start, model.contact_slot, j, data.nodes[s, q])
            if e < 0:
                continue
            b = model.contact_block[e]
            there[q, 0] += b[0, 0] * w0 + b[0, 1] * w1 + b[0, 2] * w2
            there[q, 1] += b[1, 0] * w0 + b[1, 1] * w1 + b[1, 2] * w2
            there[q, 2] += b[2, 0] * w0 + b[2, 1] * w1 + b[2, 2] * w2
            w = data.weight[s, q, 0]
            v0, v1, v2 = np.float32(w * m[0]), np.float32(w * m[1]), np.float32(w * m[2])
            u0 += b[0, 0] * v0 + b[1, 0] * v1 + b[2, 0] * v2
            u1 += b[0, 1] * v0 + b[1, 1] * v1 + b[2, 1] * v2
            u2 += b[0, 2] * v0 + b[1, 2] * v1 + b[2, 2] * v2
        back[i, 0] += u0
        back[i, 1] += u1
        back[i, 2] += u2


@fast
def assemble_coupling(data):  # type: ignore[no-untyped-def]
    """Assemble the compliance between the tips."""
    superposition, several = data.superposition, data.several_tools
    for t in range(data.passage.shape[0]):
        for s in range(t):
            if not (data.active[t] and data.active[s]):
                continue
            value = 0.0
            for k in range(data.mode.shape[1]):
                value += superposition.gain[k] * data.mode[t, k] * data.mode[s, k]
            if several.near[s, t]:
                n = data.normal[t]
                near = 0.0
                for i in range(data.n_nodes[t]):
                    u = several.column[s, t, i]
                    near += data.weight[t, i, 0] * (n[0] * u[0] + n[1] * u[1] + n[2] * u[2])
                value += superposition.near_gain[0] * near
            facing = 0.0
            for d in range(3):
                facing += data.normal[t, d] * data.normal[s, d]
            local, blurred = several.beside[t, s], several.blurred[t, s]
            value += superposition.near_gain[0] * blurred * facing
            # of patches in one place, single precision may make more than one patch has
            value = min(value, np.sqrt(data.compliance[t, t] * data.compliance[s, s]))
            value += superposition.near_gain[0] * (local - blurred) * facing
            data.compliance[t, s] = data.compliance[s, t] = value


@fast
def add_near_of_others(data, t):  # type: ignore[no-untyped-def]
    """Add the near displacement at the nodes of a tip by the others' normal forces."""
    for s in range(data.passage.shape[0]):
        if s == t or data.force[s] <= 0.0 or not data.several_tools.near[s, t]:
            continue
        force = -data.force[s] * data.superposition.near_gain[0]
        for i in range(data.n_nodes[t]):
            for d in range(3):
                data.superposition.displacement[i, d] += (
                    force * data.several_tools.column[s, t, i, d]
                )
