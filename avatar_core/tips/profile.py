"""Table of a tip's profile: depth, load and energy of its dent over the contact radius.

On a flat half-space, in the notation of :mod:`avatar_core.tips.law`,

    M(a) = int_0^a x g'(x) dx,      Phi(a) = int_0^a (g(a) - g(x))^2 dx.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import leggauss

from avatar_core.geometry.tip import Tip

INTERVALS = 256  # intervals of the table
STIFFNESS, TAKEN = range(2)  # columns that a tip's law reads at its place
LAST = 3.0  # atanh of the last contact radius over the sphere's radius


def _contact_radius(tip: Tip, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a(s) and da/ds: dense where a sphere's sides become steep."""
    if tip.shape == "sphere":
        a = tip.radius * np.tanh(LAST * s)
        return a, LAST * (tip.radius - a**2 / tip.radius)
    return tip.radius * s, np.full_like(s, tip.radius)


def profile_of(tip: Tip) -> np.ndarray:
    """Return the table of one tip, shape (INTERVALS + 1, 6).

    The columns are those of :class:`avatar_core.tips.law.TipLawArrays`.
    """
    s = np.linspace(0.0, 1.0, INTERVALS + 1)
    node, weight = leggauss(8)
    inner = s[:-1, None] + (node + 1.0) / (2.0 * INTERVALS)
    (a, a_slope), (x, x_slope) = _contact_radius(tip, s), _contact_radius(tip, inner)
    width = x_slope * weight / (2.0 * INTERVALS)
    rise = tip.depth_slope(x) * width
    g = tip.depth(a)
    first, second = (_running(tip.depth(x) ** n * width) for n in (1, 2))
    stored = g**2 * a - 2.0 * g * first + second
    return np.stack(
        [a, a_slope, g, tip.depth_slope(a) * a_slope, _running(x * rise), stored], axis=1
    )


def _running(parts: np.ndarray) -> np.ndarray:
    """Return the integrals from 0 to each knot."""
    return np.concatenate([[0.0], np.cumsum(parts.sum(axis=1))])
