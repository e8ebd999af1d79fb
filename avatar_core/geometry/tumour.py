"""A tumour: which part of each tetrahedron of an organ it fills.

Its level set is the second one of the organ (paper, Sec. 4): the signed distance to its surface,
which may have several bodies. The mesh does not conform to it; a tetrahedron that it cuts has the
volume-weighted mean stiffness.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.errors import SurfaceError
from avatar_core.geometry.level_set import signed_distance
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.surface import SurfaceMesh, read_surface

_LATTICE = 6  # points per edge of a tetrahedron


def read_tumour(path: str | Path, unit: str = "mm", axes: Any = "RAS") -> SurfaceMesh:
    """Read the surface of one or more tumours, in the coordinates of the organ's file.

    Raises SurfaceError as :func:`avatar_core.geometry.surface.read_surface`, but for size and
    bodies.
    """
    return read_surface(path, unit, axes, check_size=False, one_body=False)


def volume_fraction_inside(mesh: TetMesh, tumour: SurfaceMesh) -> np.ndarray:
    """Volume fraction of each tetrahedron inside a tumour, shape (n_tets,).

    Counted on a lattice of points in each tetrahedron near it.

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
        inside = signed_distance(points.reshape(-1, 3), tumour) < 0.0
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


def _lattice() -> np.ndarray:
    """Barycentric coordinates of points that stand for equal volumes, shape (n, 4)."""
    n = _LATTICE
    counts = np.array([c for c in np.ndindex(n, n, n) if sum(c) < n])
    last = n - 1 - counts.sum(axis=1, keepdims=True)
    return (np.hstack([counts, last]) + 0.25) / n
