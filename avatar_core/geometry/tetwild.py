"""fTetWild by the compiled module of the package pytetwild, in a process for each mesh.

The package around the module imports pyvista, and with it VTK, for functions that are not needed
here. In its own process fTetWild starts from one seed (see `tetwild_process`). Its process may fail
without ending this one: fTetWild leaves files where it runs, takes Ctrl-C for itself, and crashes
on some surfaces.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import warnings
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import MeshError, one_line

_REMEDY = "pip install 'pytetwild>=0.4.2,<0.5'"
_STOP_ENERGY = 14.0  # 10 by default: angles 13 instead of 8 degrees at the least, in twice the time

_PROCESS = Path(__file__).with_name("tetwild_process.py").read_text()
_UNSEEDED = "fTetWild takes no seed on this system: two meshes of one surface differ"


def fill_box(
    vertices: FloatArray, faces: NDArray[np.int32], edge: float, envelope: float
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Fill the box around a surface with tetrahedra that follow it, the same ones each time.

    vertices : ndarray, shape (n, 3)
    faces : ndarray of int, shape (m, 3)
    edge, envelope : edge length and farthest distance from the surface, over the diagonal of its
        box

    Returns
    -------
    vertices : ndarray, shape (k, 3)
    tets : ndarray of int, shape (l, 4)

    Raises
    ------
    MeshError
        If pytetwild is missing, has another interface, or fails on the surface.
    """
    arguments: dict[str, Any] = {  # in the order of the compiled function, which takes no names
        "vertices": np.ascontiguousarray(vertices, dtype=np.float64),
        "faces": np.ascontiguousarray(faces, dtype=np.uint32),
        "optimize": True,
        "skip_simplify": False,
        "edge_length_r": edge,
        "edge_length_abs": 0.0,  # the fraction counts
        "epsilon": envelope,
        "stop_energy": _STOP_ENERGY,
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
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder, "input.npz"), **arguments)
        run = subprocess.run(
            [sys.executable, "-c", _PROCESS, _compiled(), str(os.getpid())],
            cwd=folder,
            capture_output=True,
            text=True,
        )
        if run.returncode:
            raise _failure(run)
        with np.load(Path(folder, "output.npz")) as filled:
            if not filled["seeded"]:
                warnings.warn(_UNSEEDED, RuntimeWarning, stacklevel=2)
            return filled["vertices"], filled["tets"]


def _failure(run: subprocess.CompletedProcess[str]) -> MeshError:
    """Return the error of a process that ended without a mesh, in one line."""
    said = run.stderr.strip().rpartition("\n")[2]
    kind = said.partition(":")[0]
    if run.returncode < 0:
        return MeshError(
            f"fTetWild crashed on this surface (signal {-run.returncode}); repair the surface, "
            "or ask for more vertices"
        )
    if kind in ("AttributeError", "TypeError"):
        return MeshError(f"this version of pytetwild has another interface to fTetWild; {_REMEDY}")
    if kind == "ImportError":
        return MeshError(
            f"pytetwild does not fit this Python or system ({one_line(said, 80)}); {_REMEDY}"
        )
    return MeshError(
        f"fTetWild found no mesh ({one_line(said, 80)}); repair the surface, or ask for more "
        "vertices"
    )


@cache
def _compiled() -> str:
    """Return the path of the compiled module; MeshError if there is none for this Python."""
    package = find_spec("pytetwild")  # this does not import it
    folders = package.submodule_search_locations if package else None
    found = PathFinder.find_spec("PyfTetWildWrapper", folders) if folders else None
    if found is None or found.origin is None:
        raise MeshError(f"pytetwild, which makes the tetrahedra, is not installed; {_REMEDY}")
    return found.origin
