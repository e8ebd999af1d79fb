"""Parts of an organ's boundary from groups of points, as a segmentation of the images gives them.

A boundary face belongs to a group if all three of its corners lie closer to a point of that group
than the mesh's mean surface edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from avatar_core.errors import MeshError, one_line
from avatar_core.geometry.mesh import Regions, TetMesh, checked, touching

REGIONS = ("clamped", "accessible")  # groups that are no supports


def read_groups(path: str | Path) -> dict[str, np.ndarray]:
    """The groups of points of an ``.npz`` file by name, each of shape (n, 3) [m].

    Raises
    ------
    MeshError
        For a file that is none, or groups that are no points.
    """
    try:
        with np.load(path, allow_pickle=False) as groups:
            points = {name: np.asarray(groups[name], float) for name in groups.files}
        if any(p.shape[1:] != (3,) or not np.isfinite(p).all() for p in points.values()):
            raise ValueError("points are rows of three finite numbers")
    except Exception as error:  # whatever numpy and zipfile raise of a damaged file
        raise _unreadable(f"{path} ({one_line(error)})") from error
    return points


def faces_of_groups(mesh: TetMesh, points: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Faces of each group of points [m], ndarrays of bool, shape (n_faces,)."""
    return {name: _near(mesh, group) for name, group in points.items()}


def regions_of_groups(
    mesh: TetMesh, points: Mapping[str, np.ndarray], source: str | Path = "points"
) -> Regions:
    """Clamp and accessible surface from the groups ``clamped`` and ``accessible`` [m].

    Raises MeshError, which names their source, if one is missing.
    """
    for name in REGIONS:
        if name not in points:
            raise _unreadable(f"{source} ('{name}' is not in it)")
    clamped, accessible = (_near(mesh, points[name]) for name in REGIONS)
    return checked(Regions(clamped, accessible & ~touching(mesh, clamped)))


def regions_from_groups(mesh: TetMesh, path: str | Path) -> Regions:
    """:func:`regions_of_groups` of a file."""
    return regions_of_groups(mesh, read_groups(path), path)


def _near(mesh: TetMesh, points: np.ndarray) -> np.ndarray:
    near = cKDTree(points).query(mesh.vertices)[0] < mesh.mean_surface_edge
    return np.asarray(near[mesh.boundary_faces].all(axis=1))


def _unreadable(what: str) -> MeshError:
    return MeshError(
        f"cannot read node groups from {what}; it must be an .npz with arrays 'clamped' and "
        "'accessible', or those of supports, of shape (n, 3) in metres"
    )
