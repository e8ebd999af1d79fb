"""Where a tip is: its gap to the organ, the normal there, its access and the load positions.

A tip that came in through the surface is in contact until it is outside again; how far it may have
moved since its last pose, and how deep it may be, is bounded.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import inlined
from avatar_core.common.splines import cell_at, in_cell, on_grid
from avatar_core.contact.effects.tip_law import edge_below
from avatar_core.contact.status import Status
from avatar_core.contact.tip_response import gather

OK, INVALID_POSE = int(Status.OK), int(Status.INVALID_POSE)  # numba takes plain numbers
NOT_CONVERGED, OUT_OF_RANGE = int(Status.NOT_CONVERGED), int(Status.OUT_OF_RANGE)
EXTRAPOLATED = int(Status.EXTRAPOLATED)

# A tip that did not enter through the surface is barred until it is outside again: a contact that
# began at depth would release energy that no tool has put in.
OUTSIDE, ENTERED, BARRED = range(3)

ENTRY_DEPTH = 5e-3  # [m] a centre deeper than this did not enter through the surface
LEAP = 50e-3  # [m] in a period; a tip that is farther from its last pose makes a new contact
MAX_DEPTH = 25e-3  # [m] of the centre below the surface at rest
MIN_ACCESS = 1e-2  # below, the tip is off the accessible surface
FULL_ACCESS = 0.99  # below, the force fades


@inlined
def locate(model, state, t, tip, superposition, tip_law):  # type: ignore[no-untyped-def]
    """Gap, normal, access, compliance, surface point and load positions of a tip in contact."""
    before, continuous = state.passage[t], _is_continuous(state, t, tip)
    state.active[t] = False
    state.access[t] = 1.0
    if not np.isfinite(tip[0] + tip[1] + tip[2]):
        return INVALID_POSE  # keeps its passage: the tip may still be where it was
    state.passage[t] = OUTSIDE
    if not on_grid(model.distance.shape, model.origin, model.spacing[0], tip):
        return OK
    cell = cell_at(model.origin, model.spacing[0], tip)
    phi = in_cell(model.distance, cell, state.slope[t])
    state.gap[t] = phi - model.tip_offset[t] - edge_below(tip_law, t, cell)
    if state.gap[t] >= 0.0:
        return OK
    access = in_cell(model.access, cell, state.access_slope[t])
    state.access[t] = min(access, 1.0)
    if access < MIN_ACCESS:
        return OUT_OF_RANGE
    deepest = MAX_DEPTH if before == ENTERED and continuous else ENTRY_DEPTH
    if before == BARRED or phi < -deepest:
        state.passage[t] = BARRED
        return OUT_OF_RANGE
    state.passage[t] = ENTERED
    state.active[t] = True
    for d in range(3):
        state.seen[t, d] = tip[d]
    if not continuous:
        state.force[t] = 0.0
    _set_normal(state, t, tip, phi)
    state.self_compliance[t] = in_cell(model.self_compliance, cell, state.self_slope[t])
    gather(model, state, t, cell, superposition)
    return OK if access >= FULL_ACCESS else OUT_OF_RANGE


@inlined
def _is_continuous(state, t, tip):  # type: ignore[no-untyped-def]
    """Whether the tip can have moved here from its last contact.

    After invalid poses its motion is unknown; then no more than ``ENTRY_DEPTH`` is believed.
    """
    square = 0.0
    for d in range(3):
        square += (tip[d] - state.seen[t, d]) ** 2
    farthest = LEAP if state.active[t] else ENTRY_DEPTH
    return square < farthest * farthest


@inlined
def _set_normal(state, t, p, phi):  # type: ignore[no-untyped-def]
    """n = g / |g| with g = grad phi, and s = p - phi n."""
    g = state.slope[t]
    state.steepness[t] = max(np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2), 1e-3)
    for d in range(3):
        state.normal[t, d] = g[d] / state.steepness[t]
        state.point[t, d] = p[d] - phi * state.normal[t, d]
