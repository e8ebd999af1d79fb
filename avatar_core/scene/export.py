"""Export of a vademecum for ParaView: the organ at rest, its modes, and its motion under a load."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
from numpy.typing import ArrayLike

from avatar_core.common.files import replaced
from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import StorageError
from avatar_core.vademecum.model import Vademecum

# Options of meshio by suffix, each for a single file: XDMF with HDF5 would write a second one, with
# the name of the vademecum.
DISPLACEMENT = "displacement [m]"
FORMATS = {".vtu": {"file_format": "vtu"}, ".xdmf": {"file_format": "xdmf", "data_format": "XML"}}


def export(
    vademecum: Vademecum,
    path: str | Path,
    point: ArrayLike | None = None,
    force: ArrayLike = 1.0,
    n_modes: int = 10,
) -> meshio.Mesh:
    """Write the organ at rest, its first modes and its displacement under a load for ParaView.

    Parameters
    ----------
    path : str or Path
        File to write, .vtu or .xdmf.
    point : array_like, shape (3,), or None
        Point of the load [m]; None for the middle of the accessible surface.
    force : float or array_like, shape (3,)
        Force [N]; a number acts inward along the normal.
    n_modes : int
        Largest number of global modes.

    Returns
    -------
    meshio.Mesh
        The written mesh; see :func:`organ_mesh`.

    Raises
    ------
    LoadError, StorageError
        For a point off the accessible surface, for another suffix, a missing folder or full disk.

    Examples
    --------
    >>> mesh = av.export(v, "pressed.vtu", point, 2.0)  # for ParaView
    >>> "tetra" in mesh.cells_dict
    True
    """
    where = vademecum.surface.centers[middle_of_access(vademecum)] if point is None else point
    mesh = organ_mesh(vademecum, where, force, n_modes)
    write_mesh(mesh, path)
    return mesh


def organ_mesh(
    vademecum: Vademecum, point: ArrayLike, force: ArrayLike, n_modes: int = 10
) -> meshio.Mesh:
    """Return the mesh at rest [m] with point data.

    The data are "displacement [m]" (n_vertices, 3) under a force, by
    :meth:`Vademecum.displacement_at`; mode_001 and so on, (n_vertices, 3); and clamped, accessible
    (n_vertices,), 1 on these parts.
    """
    mesh, far = vademecum.mesh, vademecum.far
    data = {DISPLACEMENT: vademecum.displacement_at(point, force)}
    for name in ("clamped", "accessible"):
        faces = mesh.boundary_faces[getattr(vademecum.regions, name)]
        data[name] = np.isin(np.arange(len(mesh.vertices)), faces).astype(np.int32)
    for k in range(min(n_modes, far.rank)):
        data[f"mode_{k + 1:03d}"] = np.asarray(far.space[:, k], float).reshape(-1, 3)
    return meshio.Mesh(mesh.vertices, [("tetra", mesh.tets)], point_data=data)


def write_mesh(mesh: meshio.Mesh, path: str | Path) -> None:
    """Write a mesh in the format of the suffix; the file appears complete or not at all.

    Raises
    ------
    StorageError
        For another suffix, a missing folder or a full disk.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise StorageError(f"{path} ends in '{path.suffix}'; choose {' or '.join(FORMATS)}")
    with replaced(path) as whole:
        meshio.write(whole, mesh, **FORMATS[path.suffix])
