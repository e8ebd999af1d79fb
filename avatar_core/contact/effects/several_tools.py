"""Several tools in contact at once, coupled through the compliance of the organ.

    gap_t + sum_t' C_tt' lambda_t' >= 0,    C_tt' = f_t . C f_t' + D_tt' n_t . n_t'

with the far field between all tips and the near field between tips that are close. What the
stencils blur of C, b_t = gamma - f_t . C f_t under each tip, they blur between both too: at the
distance rho of their contacts

    D = sqrt(b_t b_t') Q(rho / R_p),

Q of :mod:`avatar_core.contact.patch_on_plane`. C is that of patches; what a real tip does to the
surface beside it is not. As under the tip itself (:mod:`avatar_core.contact.effects.tip_law`), what
a patch does to another on a half-space is taken off, and what a tip does is put in its place,

    D += [1 / (pi sqrt(rho^2 + w_t^2 + w_t'^2)) - P(rho / R_p) / R_p] / E*,

w a part of the tip's radius, so that tips in one place keep C positive definite. Beside a contact
that is 1 / (pi rho), within 5 % where two balls touch each other. Action equals reaction because C
is symmetric.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.contact.effects.base import Effect
from avatar_core.contact.effects.tip_law import added_depth
from avatar_core.contact.effects.viscoelasticity import held_load
from avatar_core.contact.patch_on_plane import meeting, meeting_table, shared_blur
from avatar_core.reduction.near_field import find_block

MAX_EXCHANGES = 4  # of the active set, for each tool
INSIDE = 1e-9  # [m] of penetration that makes a tip active
LEAST_PIVOT = 1e-8  # of a tip's own compliance
WIDTH = 0.36  # w over a tip's radius: two in one place give way less than a contact of 0.8 of it


@dataclass(frozen=True)
class SeveralTools(Effect):
    """More than one tool touches at once, coupled through the organ."""

    name: ClassVar[str] = "several_tools"
    text: ClassVar[str] = "tools feel each other through the organ"


SeveralToolsArrays = namedtuple("SeveralToolsArrays", ["reach", "patch_radius", "meeting"])
SeveralToolsState = namedtuple(
    "SeveralToolsState",
    [
        "reach",  # (1,) of the near field [m]
        "patch_radius",  # (1,) [m]
        "meeting",  # (n + 1, 4) of meeting_table
        "column",  # (T, T, MAX_STENCIL, 3) near displacement at the nodes of the second tip by a
        # unit normal force of the first
        "near",  # (T, T) whether near fields overlap
        "extent",  # (T,) radius of a tip's nodes [m]
        "matrix",  # (T, T) C, with the tangent of large deformation
        "factor",  # (T, T) its Cholesky factor
        "free_gap",  # (T,) gap without any force [m]
        "trial",  # (T,) forces that close the gaps of the active set [N]
        "active_set",  # (T,) tips whose gap is closed
        "apart",  # (T, T) distance of the contacts [m],
        "beside",  # (T, T) D [m/N]
        "beside_slope",  # (T, T) and dD/drho [1/N],
        "blurred",  # (T, T) and sqrt(b_t b_t') Q [m/N]
    ],
)


def several_tools_state(
    arrays: SeveralToolsArrays, n_tools: int, n_nodes: int
) -> SeveralToolsState:
    """The constant arrays, with scratch for the pairs of tools."""
    return SeveralToolsState(
        *arrays,
        np.zeros((n_tools, n_tools, n_nodes, 3), np.float32),
        np.zeros((n_tools, n_tools), np.bool_),
        np.zeros(n_tools),
        np.zeros((n_tools, n_tools)),
        np.zeros((n_tools, n_tools)),
        np.zeros(n_tools),
        np.zeros(n_tools),
        np.zeros(n_tools, np.bool_),
        np.zeros((n_tools, n_tools)),
        np.zeros((n_tools, n_tools)),
        np.zeros((n_tools, n_tools)),
        np.zeros((n_tools, n_tools)),
    )


def several_tools_arrays(reach: float, patch_radius: float) -> SeveralToolsArrays:
    """Constant arrays; lengths in m."""
    return SeveralToolsArrays(np.array([reach]), np.array([patch_radius]), meeting_table())


@inlined
def couple_near_fields(model, state, several_tools, friction, tip_law):  # type: ignore[no-untyped-def]
    """Near fields between all pairs of tips in contact; with friction, whether they overlap."""
    if not several_tools.on:
        return
    n_tools = state.passage.shape[0]
    for t in range(n_tools):
        if state.active[t]:
            _measure_extent(model, state, several_tools, t)
    for t in range(n_tools):
        for s in range(t):
            several_tools.near[t, s] = several_tools.near[s, t] = False
            if state.active[t] and state.active[s]:
                near = _are_near(state, several_tools, t, s)
                several_tools.near[t, s] = several_tools.near[s, t] = near
                if not friction.on and near:
                    _couple_pair(model, state, several_tools, t, s)
                place_beside(state, several_tools, tip_law, t, s)


@fast
def place_beside(state, several_tools, law, t, s):  # type: ignore[no-untyped-def]
    """D of two tips in contact, and its slope."""
    square = 0.0
    for d in range(3):
        square += (state.point[t, d] - state.point[s, d]) ** 2
    rho, radius = np.sqrt(square), several_tools.patch_radius[0]
    blurred = np.sqrt(max(0.0, state.blurred[t]) * max(0.0, state.blurred[s]))
    part, fall = shared_blur(several_tools.meeting, rho / radius)
    value, slope = blurred * part, blurred * fall / radius
    several_tools.blurred[t, s] = several_tools.blurred[s, t] = value
    if law.on:
        wide = square + WIDTH**2 * (law.radius[t] ** 2 + law.radius[s] ** 2)
        met, rise = meeting(several_tools.meeting, rho / radius)
        point = 1.0 / (np.pi * np.sqrt(wide))
        value += (point - met / radius) / law.modulus[0]
        slope += (-point * rho / wide - rise / radius**2) / law.modulus[0]
    several_tools.apart[t, s] = several_tools.apart[s, t] = rho
    several_tools.beside[t, s] = several_tools.beside[s, t] = value
    several_tools.beside_slope[t, s] = several_tools.beside_slope[s, t] = slope


@fast
def add_history_beside(state, effects, t):  # type: ignore[no-untyped-def]
    """Add to a tip's displacement without load what the others' dents remember, at the tip [m]."""
    superposition, several_tools = effects.superposition, effects.several_tools
    if not several_tools.on:
        return
    for s in range(state.passage.shape[0]):
        if s != t and state.active[s]:
            held = held_load(effects.viscoelasticity, s)
            dent = superposition.near_gain[0] * several_tools.beside[t, s] * held
            for d in range(3):
                superposition.free_displacement[t, d] += dent * state.normal[s, d]


@fast
def derivative_beside(state, effects, t, p, d, sharper):  # type: ignore[no-untyped-def]
    """The derivative of what tips do to each other by D, along one axis, at constant forces.

    The contact of a tip is at p - phi n; ``sharper`` is half the derivative of b_t.
    """
    superposition, several_tools = effects.superposition, effects.several_tools
    friction, total = effects.friction, 0.0
    if not several_tools.on:
        return total
    n, turn, phi = state.normal[t], superposition.normal_gradient, 0.0
    for i in range(3):
        phi += (p[i] - state.point[t, i]) * n[i]
    for s in range(state.passage.shape[0]):
        if s == t or state.force[s] <= 0.0:
            continue
        held = held_load(effects.viscoelasticity, s)
        along = shared = turned = 0.0
        for i in range(3):
            moved = (1.0 if i == d else 0.0) - n[i] * state.slope[t, d] - phi * turn[i, d]
            along += (state.point[t, i] - state.point[s, i]) * moved
            if friction.on:
                g = friction.push[s, i] + held * state.normal[s, i]
                shared += friction.push[t, i] * g
            else:
                g = state.force[t] * (state.force[s] - held) * state.normal[s, i]
                shared += n[i] * g
                turned += turn[i, d] * g
        slope = several_tools.beside_slope[t, s] * along / max(several_tools.apart[t, s], 1e-12)
        if state.blurred[t] > 0.0:
            slope += several_tools.blurred[t, s] * sharper / state.blurred[t]
        total += slope * shared + several_tools.beside[t, s] * turned
    return superposition.near_gain[0] * total


@fast
def _measure_extent(model, state, several_tools, t):  # type: ignore[no-untyped-def]
    farthest = 0.0
    for i in range(state.n_nodes[t]):
        j, square = state.nodes[t, i], 0.0
        for d in range(3):
            square += (model.position[j, d] - state.point[t, d]) ** 2
        farthest = max(farthest, square)
    several_tools.extent[t] = np.sqrt(farthest)


@fast
def _are_near(state, several_tools, t, s):  # type: ignore[no-untyped-def]
    apart = 0.0
    for d in range(3):
        apart += (state.point[s, d] - state.point[t, d]) ** 2
    extent = several_tools.extent
    return np.sqrt(apart) < several_tools.reach[0] + extent[t] + extent[s]


@fast
def _couple_pair(model, state, several_tools, t, s):  # type: ignore[no-untyped-def]
    """By Maxwell and Betti the block from m to j is the transpose of that from j to m."""
    there, back = several_tools.column[t, s], several_tools.column[s, t]
    there[: state.n_nodes[s]] = np.float32(0.0)
    back[: state.n_nodes[t]] = np.float32(0.0)
    n, m, zero = state.normal[t], state.normal[s], np.float32(0.0)
    for i in range(state.n_nodes[t]):
        j, w = state.nodes[t, i], state.weight[t, i, 0]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        u0 = u1 = u2 = zero
        for q in range(state.n_nodes[s]):
            e = find_block(model.contact_start, model.contact_slot, j, state.nodes[s, q])
            if e < 0:
                continue
            b = model.contact_block[e]
            there[q, 0] += b[0, 0] * w0 + b[0, 1] * w1 + b[0, 2] * w2
            there[q, 1] += b[1, 0] * w0 + b[1, 1] * w1 + b[1, 2] * w2
            there[q, 2] += b[2, 0] * w0 + b[2, 1] * w1 + b[2, 2] * w2
            w = state.weight[s, q, 0]
            v0, v1, v2 = np.float32(w * m[0]), np.float32(w * m[1]), np.float32(w * m[2])
            u0 += b[0, 0] * v0 + b[1, 0] * v1 + b[2, 0] * v2
            u1 += b[0, 1] * v0 + b[1, 1] * v1 + b[2, 1] * v2
            u2 += b[0, 2] * v0 + b[1, 2] * v1 + b[2, 2] * v2
        back[i, 0] += u0
        back[i, 1] += u1
        back[i, 2] += u2


@fast
def assemble_coupling(state, effects):  # type: ignore[no-untyped-def]
    """Compliance between the tips."""
    superposition, several_tools = effects.superposition, effects.several_tools
    for t in range(state.passage.shape[0]):
        for s in range(t):
            if not (state.active[t] and state.active[s]):
                continue
            value = 0.0
            for k in range(state.mode.shape[1]):
                value += superposition.gain[k] * state.mode[t, k] * state.mode[s, k]
            if several_tools.near[s, t]:
                n = state.normal[t]
                near = 0.0
                for i in range(state.n_nodes[t]):
                    u = several_tools.column[s, t, i]
                    near += state.weight[t, i, 0] * (n[0] * u[0] + n[1] * u[1] + n[2] * u[2])
                value += superposition.near_gain[0] * near
            facing = 0.0
            for d in range(3):
                facing += state.normal[t, d] * state.normal[s, d]
            local, blurred = several_tools.beside[t, s], several_tools.blurred[t, s]
            value += superposition.near_gain[0] * blurred * facing
            # of patches in one place, single precision may make more than one patch has
            value = min(value, np.sqrt(state.compliance[t, t] * state.compliance[s, s]))
            value += superposition.near_gain[0] * (local - blurred) * facing
            state.compliance[t, s] = state.compliance[s, t] = value


@inlined
def solve_active_set(state, effects):  # type: ignore[no-untyped-def]
    """Contact forces by the active-set method, as a start for the sweeps that follow.

    Nonnegative least squares in energy (Lawson & Hanson, Solving Least Squares Problems, Sec.
    23.3): solve for the active tips; if a force would become negative, go only as far as it
    vanishes and release that tip; else activate the tip that penetrates deepest. Forces stay >= 0
    and the energy decreases, however close the tips are. With large deformation this is one Newton
    step. It may end after its last exchange without the solution: the sweeps decide on convergence.
    """
    several_tools = effects.several_tools
    _linearise(state, effects)
    n_tools, force, trial = state.passage.shape[0], state.force, several_tools.trial
    active = several_tools.active_set
    for _ in range(MAX_EXCHANGES * n_tools):
        _close_gaps(several_tools)
        part, pulled = 1.0, -1
        for t in range(n_tools):
            if active[t] and trial[t] < 0.0 and force[t] <= part * (force[t] - trial[t]):
                part, pulled = force[t] / (force[t] - trial[t]), t
        for t in range(n_tools):
            if active[t]:
                force[t] += part * (trial[t] - force[t])
        if pulled >= 0:
            force[pulled], active[pulled] = 0.0, False
            continue
        least, deepest = -INSIDE, -1
        for t in range(n_tools):
            if state.active[t] and not active[t]:
                gap = several_tools.free_gap[t]
                for s in range(n_tools):
                    if active[s]:
                        gap += several_tools.matrix[t, s] * force[s]
                if gap < least:
                    least, deepest = gap, t
        if deepest < 0:
            return
        active[deepest] = True


@inlined
def _linearise(state, effects):  # type: ignore[no-untyped-def]
    """Gap without forces and compliance at the present forces; tips with a force are active."""
    superposition, several_tools = effects.superposition, effects.several_tools
    large_deformation, tip_law = effects.large_deformation, effects.tip_law
    for t in range(state.passage.shape[0]):
        several_tools.active_set[t] = False
        if not state.active[t]:
            continue
        several_tools.active_set[t] = state.force[t] > 0.0
        for s in range(state.passage.shape[0]):
            several_tools.matrix[t, s] = state.compliance[t, s]
        several_tools.free_gap[t] = state.gap[t] - superposition.free_normal[t]
        if large_deformation.on or tip_law.on:
            added, tangent = added_depth(state, effects, t)
            several_tools.matrix[t, t] += tangent
            several_tools.free_gap[t] += added - tangent * state.force[t]


@inlined
def _close_gaps(several_tools):  # type: ignore[no-untyped-def]
    """Solve matrix trial = - free_gap within the active set, by Cholesky.

    If two tips coincide, the pivot of the second vanishes and is replaced by a small one: the
    deeper tip takes the load.
    """
    active, x = several_tools.active_set, several_tools.trial
    c, root = several_tools.matrix, several_tools.factor
    for t in range(active.shape[0]):
        if not active[t]:
            continue
        x[t] = -several_tools.free_gap[t]
        for s in range(t + 1):
            if not active[s]:
                continue
            value = c[t, s]
            for k in range(s):
                if active[k]:
                    value -= root[t, k] * root[s, k]
            if s < t:
                root[t, s] = value / root[s, s]
                x[t] -= root[t, s] * x[s]
            else:
                root[t, t] = np.sqrt(max(value, LEAST_PIVOT * c[t, t]))
        x[t] /= root[t, t]
    for t in range(active.shape[0] - 1, -1, -1):
        if active[t]:
            for k in range(t + 1, active.shape[0]):
                if active[k]:
                    x[t] -= root[k, t] * x[k]
            x[t] /= root[t, t]


@fast
def add_near_of_others(state, superposition, several_tools, t):  # type: ignore[no-untyped-def]
    """Add the near displacement at the nodes of a tip by the others' normal forces."""
    for s in range(state.passage.shape[0]):
        if s == t or state.force[s] <= 0.0 or not several_tools.near[s, t]:
            continue
        force = -state.force[s] * superposition.near_gain[0]
        for i in range(state.n_nodes[t]):
            for d in range(3):
                superposition.displacement[i, d] += force * several_tools.column[s, t, i, d]
