"""Parts of an organ's boundary from files of points, as a segmentation of the images gives them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from avatar_core.errors import MeshError
from avatar_core.geometry.mesh import Regions, TetMesh, checked, touching

REGIONS = ("clamped", "accessible")  # groups that are no supports


def read_groups(mesh: TetMesh, path: str | Path) -> dict[str, np.ndarray]:
    """Faces near each group of points of an ``.npz`` file, ndarrays of bool, shape (n_faces,).

    Each array has the shape (n, 3) [m]. A boundary face belongs to a group if all three of its
    corners lie closer to a point of that group than the mesh's mean surface edge.

    Raises
    ------
    MeshError
        For a file that is none, or groups that are no points.
    """
    try:
        with np.load(path, allow_pickle=False) as groups:
            points = {name: np.asarray(groups[name], float) for name in groups.files}
        return {name: _near(mesh, group) for name, group in points.items()}
    except (OSError, ValueError, AttributeError) as error:
        raise _unreadable(path, str(error)) from error


def regions_from_groups(mesh: TetMesh, path: str | Path) -> Regions:
    """Clamp and accessible surface from a file with the groups ``clamped`` and ``accessible``."""
    groups = read_groups(mesh, path)
    for name in REGIONS:
        if name not in groups:
            raise _unreadable(path, f"'{name}' is not in it")
    clamped, accessible = (groups[name] for name in REGIONS)
    return checked(Regions(clamped, accessible & ~touching(mesh, clamped)))


def _near(mesh: TetMesh, points: np.ndarray) -> np.ndarray:
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"an array has the shape {points.shape}")
    near = cKDTree(points).query(mesh.vertices)[0] < mesh.mean_surface_edge
    return np.asarray(near[mesh.boundary_faces].all(axis=1))


def _unreadable(path: str | Path, reason: str) -> MeshError:
    return MeshError(
        f"cannot read node groups from {path} ({reason}); it must be an .npz with arrays "
        "'clamped' and 'accessible', or those of supports, of shape (n, 3) in metres"
    )
