"""Heights of tangent planes over a surface: what a tip meets around the point it touches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from avatar_core.geometry.offsets import Offsets


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
    offsets : Offsets
        Offsets from the surface, exact or of a grid.
    points : ndarray, shape (n, 3)
        Points on the surface or beside it [m].
    normals : ndarray, shape (n, 3)
        Unit vectors, outward.
    radii : ndarray, shape (m,) or (m, n)
        Radii of the circles [m].
    angles : ndarray
        Directions on the circles.
    steepest : float
        Squared cosine of the side that counts as the steepest.
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
    """Return two unit vectors across each normal and each other."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)
