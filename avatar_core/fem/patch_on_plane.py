"""The patch of a vademecum on an elastic half-space, in closed form.

Its traction is 3 F / (pi R_p^2) (1 - r^2 / R_p^2)^2, with the Hankel transform F 48 J_3(x) / x^3, x
= k R_p. In Hankel space the surface moves by 2 / (E* k) times the load (Johnson, Contact Mechanics,
1985, Sec. 3). A patch therefore moves another one at the distance rho, averaged under the other's
traction, by

    F / (E* R_p) P(rho / R_p),      P(y) = 1 / pi int_0^inf [48 J_3(x) / x^3]^2 J_0(x y) dx,

P(0) = 0.7665, and P -> 1 / (pi y) far off.

Between the load positions of an organ the response is interpolated, from both sides. The
interpolation error is local, and therefore that of a half-space. The interpolant sum_ij w_i w_j
C_ij falls short of C(s, s) by

    1 / (E* R_p) sum_ij w_i w_j [P(0) - P(|x_i - x_j| / R_p)].

For weights that spread little, the error is proportional to the Laplacian of P at 0. Between two
points at the distance y R_p it is proportional to the Laplacian at y: it fades as Q(y) = lap P(y) /
lap P(0).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss

from avatar_core.common.jit import compiled, fast

PATCH = 0.7665  # P(0)
FAR = 3.0  # patch radii, beyond which P follows from two point loads and their widths
_INTERVALS = 96  # intervals of the table of P
_WIDTHS = 0.125  # P = (1 + 1 / (8 y^2)) / (pi y) far off, the mean of r^2 / R_p^2 being 1 / 4
_FINE = 24  # nodes of the rule for the dent of one patch
_LAST, _NODES = 60.0, 1200  # limit and nodes of the integral over x: [48 J_3 / x^3]^2 falls as x^-7


def patch_dent(rho: np.ndarray) -> np.ndarray:
    """Return E* R_p / F u_patch at distances rho [R_p] on the surface of a half-space."""
    theta, weight = quarter_turn(_FINE)
    rho = np.asarray(rho, float)[..., None]
    end = np.minimum(rho, 1.0)
    x = end * np.sin(theta)
    # int_0^end (1 - x^2)^(5/2) / sqrt(rho^2 - x^2) dx, with the limit at rho = 0
    far = np.sqrt(np.maximum(rho**2 - x**2, 1e-300))
    step = np.where(rho > 1.0, np.cos(theta) / far, 1.0)
    return np.asarray(32.0 / (5.0 * np.pi**2) * ((1.0 - x**2) ** 2.5 * step) @ weight)


@cache
def quarter_turn(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and weights of Gauss's rule over theta in [0, pi/2]."""
    node, weight = leggauss(n)
    return 0.25 * np.pi * (node + 1.0), 0.25 * np.pi * weight


@cache
def meeting_table() -> np.ndarray:
    """Return P, dP/dy, Q and dQ/dy over y in [0, FAR], shape (n + 1, 4)."""
    # Here, because the contact node needs none of it.
    from scipy.special import j0, jv, roots_legendre

    node, weight = roots_legendre(_NODES)  # numpy takes half a second for so many
    x, weight = 0.5 * _LAST * (node + 1.0), 0.5 * _LAST * weight
    square = weight * (48.0 * jv(3, x) / x**3) ** 2 / np.pi
    y = np.linspace(0.0, FAR, _INTERVALS + 1)[:, None]
    even, odd, bent = j0(x * y), -jv(1, x * y), x**2 * square / (x**2 @ square)
    columns = [even @ square, odd @ (x * square), even @ bent, odd @ (x * bent)]
    return np.stack(columns, axis=1)


@fast
def meeting(table, y):  # type: ignore[no-untyped-def]
    """Return P and dP/dy at a distance of two patches [R_p]."""
    if y >= FAR:
        far = 1.0 / (np.pi * y)
        wide = _WIDTHS / (y * y)
        return far * (1.0 + wide), -far * (1.0 + 3.0 * wide) / y
    return _in_table(table, 0, y)


@fast
def shared_blur(table, y):  # type: ignore[no-untyped-def]
    """Return Q and dQ/dy at a distance of two points [R_p]; far off Q falls as lap 1 / y, y^-3."""
    if y >= FAR:
        far = table[table.shape[0] - 1, 2] * (FAR / y) ** 3
        return far, -3.0 * far / y
    return _in_table(table, 2, y)


@fast
def _in_table(table, column, y):  # type: ignore[no-untyped-def]
    """Return a function and its slope, by cubic Hermite interpolation."""
    h = FAR / _INTERVALS
    k = int(y / h)
    t = y / h - k
    p, q = table[k, column], table[k + 1, column]
    a, b = h * table[k, column + 1], h * table[k + 1, column + 1]
    c, d = 3.0 * (q - p) - 2.0 * a - b, 2.0 * (p - q) + a + b
    return p + t * (a + t * (c + t * d)), (a + t * (2.0 * c + t * 3.0 * d)) / h


def missed_between(positions: np.ndarray, carrier: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the interpolation error of C(s, s) times E* R_p, shape (n,).

    Parameters
    ----------
    positions : ndarray, shape (n_positions, 3)
        Load positions [R_p].
    carrier, weight : ndarray, shape (n, k)
        Load positions of each point, and their weights.
    """
    return np.asarray(_missed_between(meeting_table(), positions, carrier, weight))


@compiled()
def _missed_between(table, positions, carrier, weight):  # type: ignore[no-untyped-def]
    out = np.zeros(len(carrier))
    for q in range(len(carrier)):
        for i in range(carrier.shape[1]):
            for m in range(i):
                square = 0.0
                for d in range(3):
                    square += (positions[carrier[q, i], d] - positions[carrier[q, m], d]) ** 2
                shared, _ = meeting(table, np.sqrt(square))
                out[q] += 2.0 * weight[q, i] * weight[q, m] * (table[0, 0] - shared)
    return out
