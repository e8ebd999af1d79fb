"""Extra depth of a sphere's dent by large strain in a neo-Hookean organ.

At the force F a sphere of radius R sinks into a neo-Hookean half-space deeper than Sneddon's
solution for small strain, by

    eta(F) = R e(s),    s^3 = 3 F / (4 E* R^2),    e = s^3 (c_0 + c_1 s + c_2 s^2 + c_3 s^3),

s^2 being Hertz's depth over R. Second-order theory adds a term of the order a / R to Hertz's depth
a^2 / R, a being the contact radius (Giannakopoulos & Triantafyllou, J. Mech. Phys. Solids 55:1196,
2007). The series in s therefore begins with s^3. The coefficients are fitted to our own finite
elements (:mod:`avatar_core.fem.sphere_indentation`) up to 1.5 R. Each Poisson's ratio has one row,
with cubic splines between rows. ``avatar study indentation`` computes and fits them anew and prints
their error. Beyond 1.5 R eta continues as its tangent. Nearly incompressible tissue gives way more
than at small strain. At nu of 0.3 or less it gives way less, and eta is negative.

eta is a function of F / E* alone, because the dent of small strain is a function of F / E* and the
surface's shape. Beside E* Phi the dent stores E* Psi, Psi = int L d eta(L) with L = F / E*. Its
force on the tip is - Psi grad E* at constant F.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import fast
from avatar_core.geometry.tip import Tip

# nu, c_0 ... c_3, and s^3 at 1.5 R, by ``avatar study indentation``. Halved elements change the
# force by 0.1 % at most from 0.25 R on, and the fit misses the elements by 0.3 %.
COEFFICIENTS = np.array(
    [
        [0.00, -0.16145, 0.07511, -0.05957, 0.01529, 1.915],
        [0.20, -0.10373, 0.06451, -0.07300, 0.03567, 1.731],
        [0.30, -0.06447, 0.06860, -0.10388, 0.06284, 1.619],
        [0.40, -0.02193, 0.09111, -0.16212, 0.10820, 1.495],
        [0.45, -0.00044, 0.11347, -0.20987, 0.14406, 1.429],
        [0.48, 0.00509, 0.15817, -0.27999, 0.18518, 1.389],
        [0.49, 0.00314, 0.18811, -0.32325, 0.20777, 1.375],
    ]
)
END, LEAST = 4, 5  # places in a tip's six numbers, after c_0 ... c_3
NONE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])  # small strain


def large_dent_of(tip: Tip, poisson_ratio: float, neo_hookean: bool) -> np.ndarray:
    """Return c_0 ... c_3, the s^3 where the tangent begins, and the dent's least compliance, (6,).

    The last is a fraction of 1 / (2 E* R), the least compliance at small strain. For another
    material, or a tip that is no sphere, the law is unknown: the dent is that of small strain.
    """
    if not neo_hookean or tip.shape != "sphere":
        return NONE
    return with_least(interpolated(COEFFICIENTS, poisson_ratio))


def interpolated(table: np.ndarray, poisson_ratio: float) -> np.ndarray:
    """Return c_0 ... c_3 and the largest s^3 between rows like ``COEFFICIENTS``, shape (5,)."""
    # Here, because the contact node needs none of it.
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(table[:, 0], table[:, 1:])(poisson_ratio))


def with_least(law: np.ndarray) -> np.ndarray:
    """Return the law with the fraction of the least compliance appended, shape (6,)."""
    s = np.linspace(0.0, law[4] ** (1.0 / 3.0), 200)
    slope = s[:, None] ** np.arange(4) @ (law[:4] * (1.0, 4.0 / 3.0, 5.0 / 3.0, 2.0))
    return np.append(law, 1.0 + 1.5 * min(0.0, slope.min()))


@fast
def evaluate_large_dent(model, t, load):  # type: ignore[no-untyped-def]
    """Return eta [m], its derivative by the load F / E* [1/m] and Psi [m^3]."""
    c, radius = model.law.large_dent[t], model.law.radius[t]
    cube = 0.75 * load / (radius * radius)
    inside = min(cube, c[END])
    s = inside ** (1.0 / 3.0)
    depth = inside * (c[0] + s * (c[1] + s * (c[2] + s * c[3])))
    # by s^3; Psi over 4/3 R^3 is the integral of s^3 by e
    slope = c[0] + s * (4.0 * c[1] + s * (5.0 * c[2] + 6.0 * s * c[3])) / 3.0
    stored = 0.5 * c[0] + s * (4.0 / 7.0 * c[1] + s * (0.625 * c[2] + 2.0 / 3.0 * s * c[3]))
    stored = inside * inside * stored + 0.5 * slope * (cube * cube - inside * inside)
    depth += slope * (cube - inside)
    return radius * depth, 0.75 * slope / radius, 4.0 / 3.0 * radius**3 * stored
