"""The shape of the surface under a tip, as far as the tip can follow it.

kappa is lowered to that of the ellipse over which a sphere touches, and kappa and tau are limited
so that the depth grows with the contact (:mod:`avatar_core.contact.effects.tip_law`); their
gradients follow, so that the force stays the derivative of the stored energy.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.common.splines import cell_at, in_cell
from avatar_core.contact.effects.tip_profile import ANISOTROPY, KAPPA, LEAST_SLOPE, TAU
from avatar_core.geometry.local_profile import MIDDLE

# Limits set in between these, so that the force does not jump:
ANISOTROPIES = (0.6, 0.9)  # D over b^2; at the limit one curvature is 14 times the other
FLATTENINGS = (0.5, 1.5)  # of -tau, over the most that a tip with its radius can follow


@inlined
def sample_surface(model, law, t, tip):  # type: ignore[no-untyped-def]
    """kappa, tau, D, E* and c at a tip, with their gradients."""
    if not law.on:
        return
    cell = cell_at(model.origin, model.spacing[0], tip)
    for k in range(5):
        law.value[t, k] = in_cell(law.local[k], cell, law.gradient[t, k])
    felt_shape(law, t)


@fast
def felt_shape(law, t):  # type: ignore[no-untyped-def]
    """kappa and tau as a tip feels them, in the place of those of the surface."""
    if law.bluntness[t] > 0.0:
        _lower_kappa(law, t)
    _limit(law, t)


@fast
def _lower_kappa(law, t):  # type: ignore[no-untyped-def]
    """By what the contact's ellipse takes of the mean curvature: b - b (1 - D / b^2)^(2/3)."""
    value, gradient = law.value[t], law.gradient[t]
    least = LEAST_SLOPE * law.bluntness[t]
    b = law.bluntness[t] + value[KAPPA] + MIDDLE / 3.0 * value[TAU]
    above, whole = _positive(b - least, least)
    b = least + above
    ratio, part = _capped(value[ANISOTROPY] / (b * b), *ANISOTROPIES)
    root = (1.0 - ratio) ** (1.0 / 3.0)
    by_anisotropy = -2.0 / 3.0 * part / (root * b)
    by_b = root * root - 1.0 - 2.0 * by_anisotropy * value[ANISOTROPY] / b
    value[KAPPA] += b * (root * root - 1.0)
    for d in range(3):
        slope = whole * (gradient[KAPPA, d] + MIDDLE / 3.0 * gradient[TAU, d])
        gradient[KAPPA, d] += by_b * slope + by_anisotropy * gradient[ANISOTROPY, d]


@fast
def _limit(law, t):  # type: ignore[no-untyped-def]
    """kappa and tau as far down as the tip can follow, so that delta grows with the contact."""
    value, gradient, least = law.value[t], law.gradient[t], law.least_kappa[t]
    room, part = _positive(value[KAPPA] - least, -0.25 * least)
    value[KAPPA] = least + room
    for d in range(3):
        gradient[KAPPA, d] *= part
    if value[TAU] >= 0.0:
        return
    unit = -3.0 / 16.0 * np.pi * law.radius[t]
    flattening = unit * value[TAU]
    ratio = flattening / room if flattening < 2.0 * room else 2.0  # room may be zero
    kept, slope = _capped(ratio, *FLATTENINGS)
    value[TAU] = room * kept / unit
    for d in range(3):
        gradient[TAU, d] *= slope
        gradient[TAU, d] += (kept - ratio * slope) / unit * gradient[KAPPA, d]


@fast
def _positive(z, width):  # type: ignore[no-untyped-def]
    """z, but no less than 0, and its slope, which changes over ``width`` to both sides."""
    if z >= width:
        return z, 1.0
    if z <= -width:
        return 0.0, 0.0
    return (z + width) ** 2 / (4.0 * width), (z + width) / (2.0 * width)


@fast
def _capped(z, low, high):  # type: ignore[no-untyped-def]
    """z, but no more than the middle of ``low`` and ``high``, between which its slope falls."""
    if z <= low:
        return z, 1.0
    if z >= high:
        return 0.5 * (low + high), 0.0
    beyond = (z - low) / (high - low)
    return z - 0.5 * beyond * (z - low), 1.0 - beyond
