"""How far the force on a tip is not known, place by place on the surface."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.contact.error_map import is_reached
from avatar_core.contact.tip_response import closest_weights
from avatar_core.geometry.tip import Tip
from avatar_core.uncertainty.distributions import Distribution
from avatar_core.uncertainty.force_ratios import DEPTHS, log_edges
from avatar_core.vademecum.model import Vademecum

DEPTH = float(DEPTHS[1])  # of the tip, for which the spread is found [m]


def force_spread_at(
    vademecum: Vademecum, tip: Tip, known: Mapping[str, Distribution], points: np.ndarray
) -> FloatArray:
    """Half of the band that holds 90 % of the force, over its middle, shape (n,).

        (F_95 - F_5) / (F_95 + F_5)

    of a tip ``DEPTH`` deep, with the edges of :mod:`avatar_core.uncertainty.force_ratios`; NaN off
    the accessible surface.

    Parameters
    ----------
    known : of all parameters of the vademecum, by :func:`avatar_core.uncertainty.known.known_of`
    points : ndarray, shape (n, 3), of the surface at rest [m]
    """
    edges = log_edges(vademecum, (tip,), known)[0, :, 1]
    positions, weights = closest_weights(vademecum.surface, np.ascontiguousarray(points, float))
    width = np.sum(weights * np.ptp(edges, axis=1)[positions], axis=1)
    return np.where(is_reached(vademecum, points), np.tanh(0.5 * width), np.nan)
