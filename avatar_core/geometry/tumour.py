"""Tumour in an organ: the fraction that it fills of each tetrahedron and of a tip's strain energy.

Its level set is the second one of the organ (paper, Sec. 4): the signed distance to its surface,
which may have several bodies. The mesh does not conform to it; a tetrahedron that it cuts has the
volume-weighted mean stiffness.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.errors import SurfaceError
from avatar_core.geometry.heights import tangents
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.surface import SurfaceMesh, read_surface

_LATTICE = 6  # points per edge of a tetrahedron
_POLAR, _AZIMUTHS, _DEPTHS = 4, 8, 8  # directions and distances of points under a tip
_CORE = 0.25  # part of the energy within the contact's own radius


def read_tumour(
    path: str | Path, unit: str = "mm", axes: Any = None, label: int | str | None = None
) -> SurfaceMesh:
    """Read the surface of one or more tumours, in the coordinates of its file.

    Raises SurfaceError as :func:`avatar_core.geometry.surface.read_surface`, but for size and
    bodies.
    """
    return read_surface(path, unit, axes, label, check_size=False, one_body=False)


def volume_fraction_inside(mesh: TetMesh, tumour: SurfaceMesh) -> np.ndarray:
    """Return the volume fraction of each tetrahedron inside a tumour, shape (n_tets,).

    The fraction is counted on a lattice of points in each tetrahedron near the tumour.

    Raises
    ------
    SurfaceError
        If the tumour fills less than a tetrahedron, or all of the organ.
    """
    corners = mesh.vertices[mesh.tets]
    lattice = _lattice()
    low, high = tumour.vertices.min(axis=0), tumour.vertices.max(axis=0)
    near = np.flatnonzero(((corners.max(axis=1) > low) & (corners.min(axis=1) < high)).all(axis=1))
    volume_fraction = np.zeros(len(mesh.tets))
    if len(near):
        points = np.einsum("pc,tcd->tpd", lattice, corners[near])
        inside = tumour.skin.contains(points.reshape(-1, 3))
        volume_fraction[near] = inside.reshape(len(near), -1).mean(axis=1)
    volume = float(volume_fraction @ mesh.tet_volumes)
    if volume < mesh.tet_volumes.mean():
        raise SurfaceError(
            f"{tumour.name}: {volume * 1e6:.2f} ml of the tumour lie in the organ, less than a "
            "tetrahedron; check its unit and axes, or ask for more --vertices"
        )
    if volume > 0.9 * mesh.volume:
        raise SurfaceError(
            f"{tumour.name}: the tumour fills {volume / mesh.volume:.0%} of the organ; give the "
            "surface of the tumour alone"
        )
    return volume_fraction


def strained_fraction(
    tumour: SurfaceMesh, points: np.ndarray, normals: np.ndarray, radius: float, reach: float
) -> np.ndarray:
    """Return the fraction of strain energy under a normal force that lies in the tumour.

    The energy is the one in an elastic half-space. A point force on an incompressible half-space
    stores, at the distance r and the angle t from the axis (Boussinesq; Johnson, Contact Mechanics,
    1985, Sec. 3.2),

        W = sigma_rr^2 / (2 E),      sigma_rr = 3 F cos(t) / (2 pi r^2),

    here constant in r within the contact's radius. To first order, a tumour of contrast c
    multiplies the compliance by 1 - f + f / c, f being this fraction.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Points on the surface [m].
    normals : ndarray, shape (n, 3)
        Unit vectors, outward.
    radius : float
        Radius of the contact [m].
    reach : float
        Distance beyond which energy does not count [m].

    Returns
    -------
    ndarray, shape (n,)
        Fraction from 0 to 1.
    """
    fraction = np.zeros(len(points))
    middle = tumour.vertices.mean(axis=0)
    size = np.linalg.norm(tumour.vertices - middle, axis=1).max()
    near = np.linalg.norm(points - middle, axis=1) < size + reach
    if not near.any():
        return fraction
    direction, distance, weight = _beneath(radius, reach)
    first, second = tangents(normals[near])
    frame = np.stack([first, second, -normals[near]], axis=1)
    rays = np.einsum("kc,ncd->nkd", direction, frame)
    at = points[near, None, None] + distance[:, None] * rays[:, :, None]
    inside = tumour.skin.contains(at.reshape(-1, 3)).reshape(at.shape[:3])
    fraction[near] = inside.mean(axis=1) @ weight
    return fraction


def _beneath(radius: float, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sample points of equal energy beneath a contact.

    Directions (k, 3) have the last component inward; distances (m,) [m] and their weights, which
    sum to one.
    """
    cosine = ((np.arange(_POLAR) + 0.5) / _POLAR) ** (1.0 / 3.0)  # by the density cos^2
    angle = 2.0 * np.pi * (np.arange(_AZIMUTHS) + 0.5) / _AZIMUTHS
    c, a = (each.ravel() for each in np.meshgrid(cosine, angle))
    sine = np.sqrt(1.0 - c**2)
    most = 1.0 - radius / reach  # r = radius / (1 - t) has the density 1 / r^2 for even t
    t = most * (np.arange(_DEPTHS) + 0.5) / _DEPTHS
    beyond = (1.0 - _CORE) * most
    weight = np.append(_CORE, np.full(_DEPTHS, beyond / _DEPTHS)) / (_CORE + beyond)
    direction = np.stack([sine * np.cos(a), sine * np.sin(a), c], axis=1)
    return direction, np.append(0.8 * radius, radius / (1.0 - t)), weight


def _lattice() -> np.ndarray:
    """Return the barycentric coordinates of points that stand for equal volumes, shape (n, 4)."""
    n = _LATTICE
    counts = np.array([c for c in np.ndindex(n, n, n) if sum(c) < n])
    last = n - 1 - counts.sum(axis=1, keepdims=True)
    return (np.hstack([counts, last]) + 0.25) / n
