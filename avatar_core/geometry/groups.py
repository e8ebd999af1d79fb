"""Parts of an organ's boundary from groups of points, as a segmentation of the images gives them.

A boundary face belongs to a group if half of it lies between the group's points: seen from there
along the surface, they stand on all sides. Nodes of another mesh and voxels of a segmentation
therefore give the area that they cover, and not an area wider by an edge. A group of up to three
points is too small to cover anything. It selects the faces whose corners all lie within the mesh's
mean surface edge of a point.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from avatar_core.errors import MeshError, one_line
from avatar_core.geometry.mesh import Regions, TetMesh, checked, touching
from avatar_core.geometry.point_location import barycentric_centroids

_FEW = 4  # points of a group, from which on they cover an area
_AROUND = 16  # nearest points that are looked at
_PIECES = 3  # a face is sampled at the centroids of this number squared of triangles
_HALF_TURN = 1.05 * np.pi  # between two points in sight, above which a place lies beside them
_REACH = 1.5  # distance of the nearest point over the spacing of a group
_OFF = 0.35  # distance of points from their surface over its mean edge
REGIONS = ("clamped", "accessible")  # groups that are no supports


def read_groups(path: str | Path) -> dict[str, np.ndarray]:
    """Return the groups of points of an ``.npz`` file by name, each of shape (n, 3) [m].

    Raises
    ------
    MeshError
        If the file cannot be read, or a group holds no points.
    """
    try:
        with np.load(path, allow_pickle=False) as groups:
            points = {name: np.asarray(groups[name], float) for name in groups.files}
        if any(p.shape[1:] != (3,) or not np.isfinite(p).all() for p in points.values()):
            raise ValueError("points are rows of three finite numbers")
    except Exception as error:  # any error of numpy and zipfile for a damaged file
        raise _unreadable(f"{path} ({one_line(error)})") from error
    return points


def faces_of_groups(mesh: TetMesh, points: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the faces of each group of points [m], ndarrays of bool, shape (n_faces,)."""
    return {name: _covered(mesh, group) for name, group in points.items()}


def regions_of_groups(
    mesh: TetMesh, points: Mapping[str, np.ndarray], source: str | Path = "points"
) -> Regions:
    """Return clamp and accessible surface from the groups ``clamped`` and ``accessible`` [m].

    Raises MeshError, which names the source of the groups, if one is missing.
    """
    for name in REGIONS:
        if name not in points:
            raise _unreadable(f"{source} ('{name}' is not in it)")
    clamped, accessible = (_covered(mesh, points[name]) for name in REGIONS)
    return checked(Regions(clamped, accessible & ~touching(mesh, clamped)))


def regions_from_groups(mesh: TetMesh, path: str | Path) -> Regions:
    """Return the result of :func:`regions_of_groups` for a file."""
    return regions_of_groups(mesh, read_groups(path), path)


def _covered(mesh: TetMesh, points: np.ndarray) -> np.ndarray:
    """Return the faces that a group of points covers, shape (n_faces,)."""
    points, corners = np.unique(points, axis=0), mesh.vertices[mesh.boundary_faces]
    tree = cKDTree(points)
    if len(points) < _FEW:
        near = tree.query(mesh.vertices)[0] < mesh.mean_surface_edge
        return np.asarray(near[mesh.boundary_faces].all(axis=1))
    places = np.einsum("qk,fkd->fqd", barycentric_centroids(_PIECES), corners)
    distance, around = tree.query(places, k=min(_AROUND, len(points)))
    along = corners[:, 1] - corners[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(mesh.face_area_normals / mesh.face_areas[:, None], along)
    arm = points[around] - places[:, :, None]
    angle = np.arctan2(*(np.einsum("fqkd,fd->fqk", arm, axis) for axis in (across, along)))
    angle.sort(axis=2)
    gap = np.diff(np.concatenate([angle, angle[:, :, :1] + 2.0 * np.pi], axis=2)).max(axis=2)
    spacing = np.median(tree.query(points, k=_FEW)[0][:, -1])  # to the third neighbor
    reach = max(_REACH * spacing, _OFF * mesh.mean_surface_edge)
    is_between = (gap < _HALF_TURN) & (distance[:, :, 0] < reach)
    return np.asarray(is_between.mean(axis=1) >= 0.5)


def _unreadable(what: str) -> MeshError:
    return MeshError(
        f"cannot read node groups from {what}; it must be an .npz with arrays 'clamped' and "
        "'accessible', or of supports, with the shape (n, 3) in metres"
    )
