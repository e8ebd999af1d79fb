"""Meshes of the built-in liver that are the same in every run.

fTetWild inserts the faces of a surface in an order of chance (``std::random_device``, which takes
no seed), so that no two meshes of it are the same, and figures taken from a few contacts differ by
some percent. Tests get the meshes recorded here, each by the edge it was asked for; any other
surface is filled anew.

``python tests/recorded_meshes.py`` records them anew, whatever comes first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

from avatar_core.geometry import mesh
from avatar_core.geometry.mesh import TetMesh, make_mesh, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh

Fill = Callable[[SurfaceMesh, float], TetMesh]

FILE = Path(__file__).parent / "data" / "phantom_meshes.npz"
N_VERTICES = {7e-3: (700, 900), 12e-3: (300, 400, 450, 600, 700, 800)}  # by spacing [m]


class Recorded(NamedTuple):
    """One mesh, and the spacing of the surface and the edge that it was made for [m]."""

    spacing: float
    edge: float
    vertices: np.ndarray
    tets: np.ndarray


def recorded(fill: Fill) -> Fill:
    """Look a mesh up before a surface is filled; the liver may be larger or smaller."""

    def look_up(surface: SurfaceMesh, edge: float) -> TetMesh:
        for one in _meshes():
            scale = _scale(surface, one.spacing)
            if scale > 0.0 and np.isclose(edge, scale * one.edge, rtol=1e-6):
                return make_mesh(scale * one.vertices, one.tets)
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
def _meshes() -> tuple[Recorded, ...]:
    with np.load(FILE) as file:
        return tuple(
            Recorded(spacing, edge, file[f"vertices_{i}"], file[f"tets_{i}"].astype(np.int64))
            for i, (spacing, edge) in enumerate(file["made_for"])
        )


def record() -> None:
    """Fill the liver at every spacing and size, and keep each try."""
    found = [
        one for spacing, sizes in N_VERTICES.items() for n in sizes for one in tries(spacing, n)
    ]
    write(found)


def tries(spacing: float, n_vertices: int) -> list[Recorded]:
    """The meshes that are made on the way to so many vertices."""
    found, fill = [], mesh._fill

    def keep(surface: SurfaceMesh, edge: float) -> TetMesh:
        made = fill(surface, edge)
        found.append(Recorded(spacing, edge, made.vertices, made.tets))
        return made

    with patch.object(mesh, "_fill", keep):
        tetrahedralize(_liver(spacing), n_vertices)
    print(f"{1e3 * spacing:g} mm, {n_vertices}: {len(found[-1].vertices)} vertices")
    return found


def write(found: list[Recorded]) -> None:
    """Keep meshes in the file."""
    arrays = {"made_for": np.array([(one.spacing, one.edge) for one in found])}
    for i, one in enumerate(found):
        arrays[f"vertices_{i}"] = one.vertices
        arrays[f"tets_{i}"] = one.tets.astype(np.uint16)
    FILE.parent.mkdir(exist_ok=True)
    np.savez_compressed(FILE, **arrays)


if __name__ == "__main__":
    record()
