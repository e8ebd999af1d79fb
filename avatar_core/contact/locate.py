"""Location of a tip: its gap to the organ, the normal, its access and the load positions.

A tip that came in through the surface is in contact until it is outside again. Its motion since its
last pose, and its depth, are bounded.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import inlined
from avatar_core.common.splines import cell_at, in_cell, on_grid
from avatar_core.contact.effects.tilt import sample_tilt
from avatar_core.contact.organ_response import gather
from avatar_core.contact.status import BARRED as BARRED
from avatar_core.contact.status import ENTERED as ENTERED
from avatar_core.contact.status import OUTSIDE as OUTSIDE
from avatar_core.contact.status import Status
from avatar_core.geometry.tip import MAX_DEPTH

OK, INVALID_POSE = int(Status.OK), int(Status.INVALID_POSE)  # numba takes plain numbers
NOT_CONVERGED, OUT_OF_RANGE = int(Status.NOT_CONVERGED), int(Status.OUT_OF_RANGE)
EXTRAPOLATED = int(Status.EXTRAPOLATED)

ENTRY_DEPTH = 5e-3  # [m] a centre deeper than this did not enter through the surface
LEAP = 50e-3  # [m] in a period; a tip that is farther from its last pose makes a new contact
MIN_ACCESS = 1e-2  # below, the tip is off the accessible surface
FULL_ACCESS = 0.99  # below, the force fades


@inlined
def locate(model, data, t, tip):  # type: ignore[no-untyped-def]
    """Compute gap, normal, access, compliance, surface point and load positions of a tip."""
    before, continuous = data.passage[t], _is_continuous(data, t, tip)
    data.active[t] = False
    data.access[t] = 1.0
    if not np.isfinite(tip[0] + tip[1] + tip[2]):
        return INVALID_POSE  # keeps its passage: the tip may still be where it was
    data.passage[t] = OUTSIDE
    if not on_grid(model.distance.shape, model.origin, model.spacing[0], tip):
        return OK
    cell = cell_at(model.origin, model.spacing[0], tip)
    phi = in_cell(model.distance, cell, data.slope[t])
    data.gap[t] = phi - model.tip_offset[t] - sample_tilt(model, data, t, cell)
    if data.gap[t] >= 0.0:
        return OK
    access = in_cell(model.access, cell, data.access_slope[t])
    data.access[t] = min(access, 1.0)
    if access < MIN_ACCESS:
        return OUT_OF_RANGE
    deepest = MAX_DEPTH if before == ENTERED and continuous else ENTRY_DEPTH
    if before == BARRED or phi < -deepest:
        data.passage[t] = BARRED
        return OUT_OF_RANGE
    data.passage[t] = ENTERED
    data.active[t] = True
    for d in range(3):
        data.seen[t, d] = tip[d]
    if not continuous:
        data.force[t] = 0.0
    _set_normal(data, t, tip, phi)
    data.self_compliance[t] = in_cell(model.self_compliance, cell, data.self_slope[t])
    gather(model, data, t, cell)
    return OK if access >= FULL_ACCESS else OUT_OF_RANGE


@inlined
def _is_continuous(data, t, tip):  # type: ignore[no-untyped-def]
    """Return whether the tip can have moved here from its last contact.

    After invalid poses its motion is unknown; then no more than ``ENTRY_DEPTH`` is accepted.
    """
    square = 0.0
    for d in range(3):
        square += (tip[d] - data.seen[t, d]) ** 2
    farthest = LEAP if data.active[t] else ENTRY_DEPTH
    return square < farthest * farthest


@inlined
def _set_normal(data, t, p, phi):  # type: ignore[no-untyped-def]
    """Set n = g / |g| with g = grad phi, and s = p - phi n."""
    g = data.slope[t]
    data.steepness[t] = max(np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2), 1e-3)
    for d in range(3):
        data.normal[t, d] = g[d] / data.steepness[t]
        data.point[t, d] = p[d] - phi * data.normal[t, d]
