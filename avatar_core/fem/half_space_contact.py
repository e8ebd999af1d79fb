"""A tip pressed on an elastic half-space whose surface is not plane: boundary elements on rings.

The surface lies H(r, theta) below the plane across the tip's axis. The tip's lowest point lies d
below that plane; the tip's own height above its lowest point is f(r). The pressure p >= 0 is
constant on each sector of a few rings,

    u + H + f - d >= 0,   p >= 0,   p (u + H + f - d) = 0,      u = 1 / (pi E*) int p / |x - x'| dA

(Boussinesq; Johnson, Contact Mechanics, 1985, Sec. 3.2). The solution p minimises p A p / 2 + b p
over p >= 0. Accelerated projected gradients find it (Beck & Teboulle, SIAM J. Imaging Sci. 2:183,
2009, restarted after O'Donoghue & Candes, 2015). The heights are small and smooth at the scale of
the contact, so that the half-space's u holds.

For a plane surface the result is within 1 % of Sneddon's exact sphere.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss

from avatar_core.common.jit import compiled

RINGS, SECTORS = 8, 8
ITERATIONS = 25  # at most, until a step moves less than
SETTLED = np.float32(3e-4)  # tolerance of the solution: loads are then within 0.1 %
_PARTS, _ORDER = 4, 6  # parts of a close sector in both directions, and order of its quadrature
_RAYS = 720  # from the middle of a sector over itself
_HALVINGS = 50  # to find where a ray leaves the sector


def ring_radii() -> np.ndarray:
    """Return the radius of each ring's middle over the outermost ring's, shape (RINGS,)."""
    return (np.arange(RINGS) + 0.5) / RINGS


def sector_angles() -> np.ndarray:
    """Return the angles of the middle of each sector, shape (SECTORS,)."""
    return 2.0 * np.pi * np.arange(SECTORS) / SECTORS


def loads_on_heights(under: np.ndarray, window: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return F / E* on tips, shape (n,) [m^2].

    Parameters
    ----------
    under : ndarray, shape (n, RINGS)
        f - d at the middles of the rings [m].
    window : ndarray, shape (n,)
        Outer radius of the rings, inside which the tip touches [m].
    height : ndarray, shape (n, RINGS, SECTORS)
        H at the middles of the sectors [m].
    """
    gap = (under[:, :, None] + height).reshape(len(under), RINGS * SECTORS) / window[:, None]
    step, weight, largest = _problem()
    load = np.empty(len(under))
    _solve((gap * (weight / largest)).astype(np.float32), step, weight, load)
    return load * window**2


@cache
def _problem() -> tuple[np.ndarray, np.ndarray, float]:
    """Return I - A / L, area over scale, and L, the largest eigenvalue of A.

    A is the energy matrix of pressures, each divided by its scale so that its energy is one.
    Lengths are in units of the window's radius and E* = 1.
    """
    area = np.repeat(((np.arange(RINGS) + 0.5) / RINGS**2) * 2.0 * np.pi / SECTORS, SECTORS)
    energy = _influence() * area[:, None]
    energy = 0.5 * (energy + energy.T)
    scale = np.sqrt(np.diag(energy))
    unit = energy / np.outer(scale, scale)
    largest = float(np.linalg.eigvalsh(unit)[-1])
    return (np.eye(len(area)) - unit / largest).astype(np.float32), area / scale, largest


@compiled(fastmath=True)
def _solve(start, step, weight, load):  # type: ignore[no-untyped-def]
    """Return q of least energy for each row b / L of ``start``, (n, m), and q . ``weight``."""
    m = step.shape[0]
    q, y, new = np.empty(m, np.float32), np.empty(m, np.float32), np.empty(m, np.float32)
    for row in range(start.shape[0]):
        b, t = start[row], np.float32(1.0)
        q[:] = 0.0
        y[:] = 0.0
        for _ in range(ITERATIONS):
            for i in range(m):
                new[i] = -b[i]
            for j in range(m):
                if y[j] != 0.0:
                    for i in range(m):
                        new[i] += step[j, i] * y[j]
            against, moved, size = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for i in range(m):
                new[i] = max(new[i], np.float32(0.0))
                against += (y[i] - new[i]) * (new[i] - q[i])
                moved += (y[i] - new[i]) ** 2
                size += new[i] ** 2
            following = np.float32(0.5) * (
                np.float32(1.0) + np.sqrt(np.float32(1.0) + np.float32(4.0) * t * t)
            )
            ahead = np.float32(0.0) if against > 0.0 else (t - np.float32(1.0)) / following
            t = following
            for i in range(m):
                y[i] = new[i] + ahead * (new[i] - q[i])
                q[i] = new[i]
            if moved <= SETTLED * SETTLED * size:
                break
        total = 0.0
        for i in range(m):
            total += q[i] * weight[i]
        load[row] = total


def _influence() -> np.ndarray:
    """Return u at the middles of all sectors under a unit pressure on each, (m, m).

    The outer radius is 1.
    """
    out = np.zeros((RINGS, SECTORS, RINGS, SECTORS))
    angle = sector_angles()
    for i, r in enumerate(ring_radii()):
        for j in range(RINGS):
            row = [_over_sector(j, theta, r) / np.pi for theta in angle]
            for k in range(SECTORS):
                out[i, k, j] = np.roll(row, k)
    return out.reshape(RINGS * SECTORS, RINGS * SECTORS)


def _over_sector(ring: int, middle: float, at: float) -> float:
    """Return int dA / |x - x'| over a sector, x' at (at, 0)."""
    inner, outer, half = ring / RINGS, (ring + 1) / RINGS, np.pi / SECTORS
    centre = 0.5 * (inner + outer)
    away = np.hypot(centre * np.cos(middle) - at, centre * np.sin(middle))
    if away < 1e-9:
        return _over_own(inner, outer, half, at)
    parts = _PARTS if away < 2.5 * max(outer - inner, 2.0 * half * outer) else 1
    node, weight = leggauss(_ORDER)
    place = ((np.arange(parts)[:, None] + 0.5 * (node + 1.0)) / parts).ravel()
    weight = np.tile(weight, parts) / (2.0 * parts)
    r = (inner + (outer - inner) * place)[:, None]
    theta = middle - half + 2.0 * half * place
    distance = np.hypot(r * np.cos(theta) - at, r * np.sin(theta))
    return float((outer - inner) * 2.0 * half * (weight[:, None] * weight * r / distance).sum())


def _over_own(inner: float, outer: float, half: float, at: float) -> float:
    """Return the same integral over the sector around x': its length along all rays from there."""
    ray = 2.0 * np.pi * (np.arange(_RAYS) + 0.5) / _RAYS
    low, high = np.zeros(_RAYS), np.full(_RAYS, 2.0 * outer)
    for _ in range(_HALVINGS):
        length = 0.5 * (low + high)
        x, y = at + length * np.cos(ray), length * np.sin(ray)
        r = np.hypot(x, y)
        inside = (r >= inner) & (r <= outer) & (np.abs(np.arctan2(y, x)) <= half)
        low, high = np.where(inside, length, low), np.where(inside, high, length)
    return float(low.mean() * 2.0 * np.pi)
