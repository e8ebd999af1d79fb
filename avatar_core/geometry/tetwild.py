"""fTetWild by the compiled module of the package pytetwild, without the package around it.

The package imports pyvista, and with it VTK, for functions that are not needed here.
"""

from __future__ import annotations

from functools import cache
from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from avatar_core.errors import MeshError, one_line

_REMEDY = "pip install 'pytetwild>=0.4.2,<0.5'"


def fill_box(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], edge: float, envelope: float
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Fill the box around a surface with tetrahedra that follow it, as pytetwild does.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3)
    faces : ndarray of int, shape (m, 3)
    edge, envelope : float
        Edge length and farthest distance from the surface, over the diagonal of its box.

    Returns
    -------
    vertices : ndarray, shape (k, 3)
    tets : ndarray of int, shape (l, 4)

    Raises
    ------
    MeshError
        If pytetwild is missing, or has another interface.
    """
    arguments = {
        "vertices": np.ascontiguousarray(vertices, dtype=np.float64),
        "faces": np.ascontiguousarray(faces, dtype=np.uint32),
        "optimize": True,
        "skip_simplify": False,
        "edge_length_r": edge,
        "edge_length_abs": 0.0,  # the fraction counts
        "epsilon": envelope,
        "stop_energy": 10.0,
        "coarsen": False,
        "num_threads": 1,
        "num_opt_iter": 80,
        "loglevel": 3,
        "quiet": True,
        "vtk_ordering": False,
        "disable_filtering": True,
        "bg_vertices": np.empty((0, 3)),  # no field of edge lengths
        "bg_tets": np.empty((0, 4), dtype=np.int32),
        "bg_values": np.empty(0),
    }
    try:
        filled = _compiled().tetrahedralize_mesh(*arguments.values())  # it takes no names
    except (AttributeError, TypeError) as error:
        raise MeshError(
            f"this version of pytetwild has another interface to fTetWild; {_REMEDY}"
        ) from error
    return filled[0], filled[1]


@cache
def _compiled() -> ModuleType:
    """The compiled module; MeshError if there is none that this Python can load."""
    name = "PyfTetWildWrapper"
    package = find_spec("pytetwild")  # this does not import it
    folders = package.submodule_search_locations if package else None
    found = PathFinder.find_spec(name, folders) if folders else None
    if found is None or found.loader is None:
        raise MeshError(f"pytetwild, which makes the tetrahedra, is not installed; {_REMEDY}")
    try:
        module = module_from_spec(found)
        found.loader.exec_module(module)
    except ImportError as error:
        raise MeshError(
            f"pytetwild does not fit this Python or system ({one_line(error, 80)}); {_REMEDY}"
        ) from error
    return module
