"""The contact forces of all tips without friction: Gauss-Seidel, helped by an active set.

    0 <= lambda_t   perp   gap_t + sum_t' C_tt' lambda_t' + h_t >= 0

The Newton steps of friction find the same forces at mu = 0, to 2e-6 N. They cost 1.3 times the
whole step of two tools and 1.4 times the step of three.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import inlined
from avatar_core.contact.effects.large_deformation import evaluate_added_depth
from avatar_core.contact.effects.several_tools import assemble_coupling
from avatar_core.contact.friction_solver import solve_friction
from avatar_core.contact.tip_solver import added_depth, solve_tip

MAX_SWEEPS = 1000
PATIENCE = 8  # sweeps before the active-set solution is tried,
MAX_EXACT = 64  # and after which it is no longer tried
GAP_TOLERANCE = 1e-9  # [m] of gap change that ends Gauss-Seidel
MAX_EXCHANGES = 4  # exchanges of the active set, for each tool
INSIDE = 1e-9  # [m] of penetration that makes a tip active
LEAST_PIVOT = 1e-8  # fraction of a tip's own compliance


@inlined
def solve_contact(model, data):  # type: ignore[no-untyped-def]
    """Find all tips' forces by the cheapest solver for the effects; return convergence."""
    if model.friction.on:
        return solve_friction(model, data)
    if model.several_tools.on:
        assemble_coupling(data)
    return _sweep(model, data)


@inlined
def _sweep(model, data):  # type: ignore[no-untyped-def]
    """Solve 0 <= lambda  perp  gap + C lambda + h >= 0 by Gauss-Seidel, from the last forces.

    With large deformation each update of a patch is a Newton step. Sweeps hardly change the
    division of a load between close tips; then they restart from the active-set solution. Returns
    whether the last sweep changed every gap by less than ``GAP_TOLERANCE``.
    """
    n_tools = data.passage.shape[0]
    if not model.several_tools.on:  # to the bit, the force knows nothing of the last pose
        data.force[:] = 0.0
        if model.law.on:
            data.law.place[:] = 0.0
    for sweep in range(MAX_SWEEPS):
        if model.several_tools.on and sweep < MAX_EXACT and sweep % PATIENCE == PATIENCE - 1:
            _solve_active_set(model, data)
        worst = 0.0
        for t in range(n_tools):
            if not data.active[t]:
                continue
            compliance, before = data.compliance[t, t], data.force[t]
            gap = data.gap[t]
            if model.superposed[0]:
                gap -= data.superposition.free_normal[t]
            if model.several_tools.on:
                for s in range(n_tools):
                    if s != t and data.active[s]:
                        gap += data.compliance[t, s] * data.force[s]
            if model.law.on:
                new = solve_tip(model, data, t, -gap, compliance)
            else:
                gap += compliance * before
                if model.large_deformation.on:
                    evaluate_added_depth(data, t)
                    gap += data.large_deformation.added_depth[t, 0]
                    compliance += data.large_deformation.added_depth[t, 1] * data.self_compliance[t]
                new = max(0.0, before - gap / compliance)
            worst = max(worst, abs(new - before) * compliance)
            data.force[t] = new
        if worst < GAP_TOLERANCE:
            return True
    return False


@inlined
def _solve_active_set(model, data):  # type: ignore[no-untyped-def]
    """Find contact forces by the active-set method, as a start for the sweeps that follow.

    The method is nonnegative least squares in energy (Lawson & Hanson, Solving Least Squares
    Problems, Sec. 23.3). Solve for the active tips. If a force would become negative, go only as
    far as it vanishes and release that tip; else activate the tip that penetrates deepest. Forces
    stay >= 0 and the energy decreases, however close the tips are. With large deformation this is
    one Newton step. It may end after its last exchange without the solution: the sweeps decide on
    convergence.
    """
    several = data.several_tools
    _linearise(model, data)
    n_tools, force, trial = data.passage.shape[0], data.force, several.trial
    active = several.active_set
    for _ in range(MAX_EXCHANGES * n_tools):
        _close_gaps(data)
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
            if data.active[t] and not active[t]:
                gap = several.free_gap[t]
                for s in range(n_tools):
                    if active[s]:
                        gap += several.matrix[t, s] * force[s]
                if gap < least:
                    least, deepest = gap, t
        if deepest < 0:
            return
        active[deepest] = True


@inlined
def _linearise(model, data):  # type: ignore[no-untyped-def]
    """Compute gaps without forces, and compliance, at the present forces.

    Tips with a force are active.
    """
    several = data.several_tools
    for t in range(data.passage.shape[0]):
        several.active_set[t] = False
        if not data.active[t]:
            continue
        several.active_set[t] = data.force[t] > 0.0
        for s in range(data.passage.shape[0]):
            several.matrix[t, s] = data.compliance[t, s]
        several.free_gap[t] = data.gap[t] - data.superposition.free_normal[t]
        if model.large_deformation.on or model.law.on:
            added, tangent = added_depth(model, data, t)
            several.matrix[t, t] += tangent
            several.free_gap[t] += added - tangent * data.force[t]


@inlined
def _close_gaps(data):  # type: ignore[no-untyped-def]
    """Solve matrix trial = - free_gap within the active set, by Cholesky.

    If two tips coincide, the pivot of the second vanishes and is replaced by a small one: the
    deeper tip takes the load.
    """
    several = data.several_tools
    active, x = several.active_set, several.trial
    c, root = several.matrix, several.factor
    for t in range(active.shape[0]):
        if not active[t]:
            continue
        x[t] = -several.free_gap[t]
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
