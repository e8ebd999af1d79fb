"""Heights of tangent planes over a surface, which a tip meets around its contact point."""

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
    """Return heights of tangent planes over the surface, shape (n, radii, angles) [m].

    Let q be a point of the circle, c its closest point of the surface, and a the angle between q -
    c and n. The plane at q lies |q - c| / cos(a) above the surface: exact over a plane side, to
    fourth order over a ball.

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
