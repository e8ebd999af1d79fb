"""Meshes of the built-in liver that are the same in every run.

fTetWild inserts the faces of a surface in an order of chance (``std::random_device``, which takes
no seed), so that no two meshes of it are the same, and figures taken from a few contacts differ by
some percent. Tests get the meshes recorded here; any other surface is filled anew.

``python tests/recorded_meshes.py`` records them anew, whatever comes first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from avatar_core.mesh import TetMesh, first_edge, make_mesh, tetrahedralize
from avatar_core.phantom import phantom_liver
from avatar_core.surface import SurfaceMesh

Fill = Callable[[SurfaceMesh, float], TetMesh]

FILE = Path(__file__).parent / "data" / "phantom_meshes.npz"
N_VERTICES = {7e-3: (700, 900), 12e-3: (300, 400, 450, 600, 700, 800)}  # by spacing [m]


def recorded(fill: Fill) -> Fill:
    """Look a mesh up before a surface is filled; the liver may be larger or smaller."""

    def look_up(surface: SurfaceMesh, edge: float) -> TetMesh:
        for spacing, sizes in N_VERTICES.items():
            scale = _scale(surface, spacing)
            for n in sizes if scale else ():
                if np.isclose(edge, first_edge(surface.volume, n), rtol=1e-6):
                    vertices, tets = _meshes()[spacing, n]
                    return make_mesh(scale * vertices, tets)
        return fill(surface, edge)

    return look_up


def _scale(surface: SurfaceMesh, spacing: float) -> float:
    """By how much a surface is the liver enlarged; 0 if it is another."""
    liver = _liver(spacing)
    if liver.vertices.shape != surface.vertices.shape:
        return 0.0
    scale = float((surface.volume / liver.volume) ** (1.0 / 3.0))
    same = np.allclose(surface.vertices, scale * liver.vertices, rtol=0.0, atol=1e-6 * scale)
    return scale if same else 0.0


@cache
def _liver(spacing: float) -> SurfaceMesh:
    return phantom_liver(spacing)


@cache
def _meshes() -> dict[tuple[float, int], tuple[np.ndarray, np.ndarray]]:
    with np.load(FILE) as file:
        return {
            (spacing, n): (
                file[_key(spacing, n, "vertices")],
                file[_key(spacing, n, "tets")].astype(np.int64),
            )
            for spacing, sizes in N_VERTICES.items()
            for n in sizes
        }


def _key(spacing: float, n_vertices: int, what: str) -> str:
    return f"{1e3 * spacing:g}mm_{n_vertices}_{what}"


def record() -> None:
    """Fill the liver at every spacing and size."""
    arrays = {}
    for spacing, sizes in N_VERTICES.items():
        for n in sizes:
            mesh = tetrahedralize(_liver(spacing), n)
            arrays[_key(spacing, n, "vertices")] = mesh.vertices
            arrays[_key(spacing, n, "tets")] = mesh.tets.astype(np.uint16)
            print(f"{1e3 * spacing:g} mm, {n}: {len(mesh.vertices)} vertices")
    FILE.parent.mkdir(exist_ok=True)
    np.savez_compressed(FILE, **arrays)


if __name__ == "__main__":
    record()
