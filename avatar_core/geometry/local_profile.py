"""How a surface falls away around a point: what decides where a blunt tip first touches.

At radius r around a point of the surface, with n its outward normal, the height of the tangent
plane over the surface, averaged over the circle, is about

    h(r) = beta r + kappa r^2 / 2,

kappa the mean curvature [1/m], positive where convex, and beta >= 0 the part of ridges and
vertices: (2 / pi) tan(a) on a ridge whose two sides fall off at the angle a.
"""

from __future__ import annotations

import igl
import numpy as np

from avatar_core.geometry.skin import Soup

RADII = 1e-3 * np.array([1.5, 3.0, 4.5, 6.0])  # of the circles [m]
DIRECTIONS = 7  # odd: on a ridge, as good as twice as many
STEEPEST = 0.5  # squared cosine of a side's angle, 45 degrees: no tip follows a steeper one


def local_profile(
    surface: Soup, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """kappa and beta around points of a surface, by least squares of h(r) / r up to 6 mm.

    Where that gives beta < 0, a valley or a flat place beside an edge, beta is zero and kappa
    fits alone.

    Parameters
    ----------
    surface : vertices (m, 3) [m] and triangles (k, 3)
    points : ndarray, shape (n, 3), on the surface [m]
    normals : ndarray, shape (n, 3), unit vectors, outward

    Returns
    -------
    kappa : ndarray, shape (n,) [1/m]
    beta : ndarray, shape (n,), >= 0
    """
    slope = _heights(surface, points, normals) / RADII
    middle, mean = RADII.mean(), slope.mean(axis=1)
    offset = RADII - middle
    curvature = slope @ offset / (offset @ offset)
    ridge = mean - curvature * middle
    alone = slope @ RADII / (RADII @ RADII)
    return 2.0 * np.where(ridge > 0.0, curvature, alone), np.maximum(ridge, 0.0)


def _heights(surface: Soup, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Mean height of the tangent plane over the surface on each circle, (n, radii) [m].

    A point of the circle at q, whose closest point of the surface is c, at the angle a from n, is
    |q - c| / cos(a) above it: exact over a plane side, to fourth order over a ball.
    """
    first, second = tangents(normals)
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    around = np.cos(angle)[:, None, None] * first + np.sin(angle)[:, None, None] * second
    out = np.empty((len(points), len(RADII)))
    for k, radius in enumerate(RADII):
        q = (points + radius * around).reshape(-1, 3)
        square, _, closest = igl.point_mesh_squared_distance(q, *surface)
        rise = ((q - closest).reshape(around.shape) * normals).sum(axis=2)
        square = np.maximum(square.reshape(rise.shape), 1e-30)
        height = rise / np.maximum(rise**2 / square, STEEPEST)
        out[:, k] = np.clip(height, -radius, radius).mean(axis=0)
    return out


def tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across each normal and each other."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)
