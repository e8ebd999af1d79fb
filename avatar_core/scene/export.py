"""A vademecum for ParaView: the organ at rest, its modes, and how a load deforms it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import igl
import meshio
import numpy as np

from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import LoadError, StorageError, one_line
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.push import push

# By suffix: how meshio writes it into one file. XDMF beside HDF5 would be two, and the second
# would be called as the vademecum is.
FORMATS = {
    ".vtu": {"file_format": "vtu"},
    ".xdmf": {"file_format": "xdmf", "data_format": "XML"},
}
FARTHEST = 5e-3  # of a load from the accessible surface, into which it is then moved [m]


@dataclass(frozen=True)
class PointLoad:
    """A force on a patch of the accessible surface.

    positions, weights : of the point, :meth:`avatar_core.fem.patch_loads.LoadSurface.weights`
    point : ndarray, shape (3,), on the surface [m]
    normal : ndarray, shape (3,), outward, of length one
    force : ndarray, shape (3,) [N]
    """

    positions: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    force: np.ndarray


def point_load(
    vademecum: Vademecum, at: Sequence[float] | None, force: Sequence[float]
) -> PointLoad:
    """A load on the surface nearest to a point.

    Parameters
    ----------
    at : three coordinates [m], or None for the middle of the accessible surface
    force : one number, along the inward normal, or the three of a vector [N]

    Raises
    ------
    LoadError
        If the point lies off the accessible surface, or a number is not finite.
    """
    surface = vademecum.surface
    wanted = surface.centers[middle_of_access(vademecum)] if at is None else np.array(at, float)
    given = np.array(force, float)
    if not (np.isfinite(wanted).all() and np.isfinite(given).all()):
        raise LoadError("a load has numbers that are not finite; give metres and newtons")
    square, face, nearest = igl.point_mesh_squared_distance(
        wanted[None], surface.centers, surface.corners.astype(np.int64)
    )
    distance = float(np.sqrt(np.ravel(square)[0]))
    if distance > FARTHEST:
        raise LoadError(
            f"the load is {1e3 * distance:.1f} mm off the accessible surface; give a point within "
            f"{1e3 * FARTHEST:g} mm of it, in metres"
        )
    face, point = np.ravel(face)[:1].astype(int), np.reshape(nearest, (-1, 3))[0]
    corners = surface.centers[surface.corners[face[0]]]
    barycentric = np.linalg.lstsq(
        np.vstack([corners.T, np.ones(3)]), np.append(point, 1.0), rcond=None
    )[0]
    positions, weights = surface.weights(face, barycentric[None])
    normal = weights[0] @ surface.normals[positions[0]]
    normal /= np.linalg.norm(normal)
    vector = -given[0] * normal if len(given) == 1 else given
    return PointLoad(positions[0], weights[0], point, normal, vector)


def displacement_under(vademecum: Vademecum, load: PointLoad) -> np.ndarray:
    """Displacement of all vertices under a load, shape (n_vertices, 3) [m].

    What presses into the organ bends where the vademecum holds large deformation; what pulls or
    drags is added linearly.
    """
    pressing = max(0.0, -float(load.force @ load.normal))
    rest = load.force + pressing * load.normal
    pressed = push(vademecum, load.positions, load.weights, pressing).displacement
    dragged = vademecum.displacement(load.positions, load.weights) @ rest
    return np.asarray(pressed + dragged).reshape(-1, 3)


def organ_mesh(vademecum: Vademecum, load: PointLoad, n_modes: int) -> meshio.Mesh:
    """The mesh at rest [m] with point data.

    displacement (n_vertices, 3) [m] under the load; mode_001 and so on, (n_vertices, 3), as in
    the file; clamped, accessible (n_vertices,), 1 on these parts of the surface
    """
    mesh, far = vademecum.mesh, vademecum.far
    data = {"displacement": displacement_under(vademecum, load)}
    for name in ("clamped", "accessible"):
        faces = mesh.boundary_faces[getattr(vademecum.regions, name)]
        data[name] = np.isin(np.arange(len(mesh.vertices)), faces).astype(np.int32)
    for k in range(min(n_modes, far.rank)):
        data[f"mode_{k + 1:03d}"] = np.asarray(far.space[:, k], float).reshape(-1, 3)
    return meshio.Mesh(mesh.vertices, [("tetra", mesh.tets)], point_data=data)


def write_mesh(mesh: meshio.Mesh, path: str | Path) -> None:
    """Write a mesh as its suffix says; the file appears complete or not at all.

    Raises
    ------
    StorageError
        For another suffix, a missing folder or a full disk.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise StorageError(f"{path} ends on '{path.suffix}'; choose {' or '.join(FORMATS)}")
    if not path.parent.is_dir():
        raise StorageError(f"folder {path.parent} does not exist; create it first")
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            whole = Path(folder) / path.name
            meshio.write(whole, mesh, **FORMATS[path.suffix])
            os.replace(whole, path)
    except OSError as error:
        raise StorageError(
            f"cannot write {path} ({one_line(error, 120)}); "
            "free disk space or choose another folder"
        ) from error
