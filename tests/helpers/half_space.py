"""Forces of rigid tips on an elastic half-space, in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from avatar_core.geometry.tip import Tip


def flat(r: float) -> float:
    """Return the slope 0 of a plane surface."""
    return 0.0


def sneddon(tip: Tip, depth: float, modulus: float, fall: Callable[[float], float] = flat) -> float:
    """Return the force of a tip at a depth, by Abel's integrals over its slope (Sneddon 1965) [N].

    modulus : E / (1 - nu^2) of the half-space [Pa]
    fall : slope with which the surface falls away at a distance [m] from the tip's axis
    """
    if tip.shape == "flat":
        return 2.0 * modulus * tip.radius * depth

    def integral(a: float, power: int) -> float:
        """Integrate int_0^a r^power f'(r) / sqrt(a^2 - r^2) dr."""

        def inner(angle: float) -> float:
            r = a * np.sin(angle)
            return float(r**power * (slope(tip, r) + fall(r)))

        return float(quad(inner, 0.0, 0.5 * np.pi, limit=400)[0])

    a = brentq(lambda a: a * integral(a, 0) - depth, 0.0, (1.0 - 1e-9) * tip.radius)
    return 2.0 * modulus * integral(a, 2)


def slope(tip: Tip, r: float) -> float:
    """Return the slope f'(r) of a sphere or a cone, rounded or not."""
    ball, cotangent = tip.radius, np.inf
    if tip.half_angle is not None:
        ball, cotangent = tip.rounding or 0.0, 1.0 / np.tan(np.radians(tip.half_angle))
    steepness = r / np.sqrt(ball**2 - r**2) if r < ball else np.inf
    return float(min(steepness, cotangent))


def on_soft_base(force_at: Callable[[float], float], depth: float, base: float) -> float:
    """Return the force on a half-space that rests on a spring of compliance ``base`` [m/N]."""
    dent = brentq(lambda d: d + base * force_at(d) - depth, 0.0, depth, xtol=1e-15)
    return float(force_at(dent))
