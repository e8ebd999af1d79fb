"""How a surface falls away around a point: what decides where a blunt tip first touches.

At radius r around a point of the surface, with n its outward normal, the height of the tangent
plane over the surface is h(r, theta). Its mean over the circle is about

    h(r) = kappa r^2 / 2 + tau r^3 / 6,

kappa the mean curvature [1/m], positive where convex, and tau its change with the radius [1/m^2]:
negative on a ridge, which is sharp at its crest and flat beside it. From the variance of h over the
circle comes

    D = 8 Var h / r^4,

the square of half the difference of the principal curvatures where the surface has them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from avatar_core.geometry.offsets import Offsets

RADII = 1e-3 * np.array([1.5, 3.0, 4.5, 6.0])  # of the circles [m]
DIRECTIONS = 7  # odd: on a ridge, as good as twice as many
STEEPEST = 0.5  # squared cosine of a side's angle, 45 degrees: no tip follows a steeper one
OUTER = slice(2, 4)  # circles of which the variance counts
MIDDLE = float(RADII[OUTER].mean())  # their mean radius [m]


class LocalProfile(NamedTuple):
    """The shape of a surface around n points, each of shape (n,).

    curvature : kappa [1/m]
    growth : tau [1/m^2]
    anisotropy : D [1/m^2]
    """

    curvature: np.ndarray
    growth: np.ndarray
    anisotropy: np.ndarray


def local_profile(offsets: Offsets, points: np.ndarray, normals: np.ndarray) -> LocalProfile:
    """kappa and tau around points of a surface, by least squares of h(r) / r up to 6 mm, and D.

    Parameters
    ----------
    offsets : from the surface, exact or of a grid
    points : ndarray, shape (n, 3), on the surface [m]
    normals : ndarray, shape (n, 3), unit vectors, outward
    """
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    height = heights_around(offsets, points, normals, RADII, angle, STEEPEST)
    height = np.clip(height, -RADII[:, None], RADII[:, None])
    terms = np.stack([RADII / 2.0, RADII**2 / 6.0], axis=1)
    curvature, growth = np.linalg.pinv(terms) @ (height.mean(axis=2) / RADII).T
    spread = 8.0 * height.var(axis=2) / RADII**4
    return LocalProfile(curvature, growth, spread[:, OUTER].mean(axis=1))


def heights_around(
    offsets: Offsets,
    points: np.ndarray,
    normals: np.ndarray,
    radii: np.ndarray,
    angles: np.ndarray,
    steepest: float,
) -> np.ndarray:
    """Heights of the planes across the normals over the surface, shape (n, radii, angles) [m].

    A point of the circle at q, whose closest point of the surface is c, at the angle a from n, is
    |q - c| / cos(a) above it: exact over a plane side, to fourth order over a ball.

    Parameters
    ----------
    offsets, points, normals : as of :func:`local_profile`, points beside the surface as well
    radii : ndarray, shape (m,) or (m, n), of the circles [m]
    angles : ndarray, directions on the circles
    steepest : squared cosine of the side that counts as the steepest
    """
    first, second = tangents(normals)
    around = np.cos(angles)[:, None, None] * first + np.sin(angles)[:, None, None] * second
    out = np.empty((len(points), len(radii), len(angles)))
    for k, radius in enumerate(radii):
        q = (points + np.reshape(radius, (-1, 1)) * around).reshape(-1, 3)
        offset = offsets(q).reshape(around.shape)
        rise = np.einsum("and,nd->an", offset, normals)
        square = np.maximum(np.einsum("and,and->an", offset, offset), 1e-30)
        out[:, k] = (rise / np.maximum(rise**2 / square, steepest)).T
    return out


def tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across each normal and each other."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)
