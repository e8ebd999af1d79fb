"""Bands of a force against draws of the full finite element problem.

A small organ with a tumour, over Poisson's ratio and the contrast, is built once. Each draw of the
material is then also solved in full for the patch at some places. Both sides see the same draws, so
that what differs is the vademecum's and its table's error, and not chance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.contact.tool_path import starts_apart
from avatar_core.fem.elasticity import Elasticity, Inclusion
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.geometry.tumour import volume_fraction_inside
from avatar_core.offline.pipeline import OrganOptions, build
from avatar_core.reduction.coordinates import Coordinate, problem_at
from avatar_core.studies.study import Value
from avatar_core.uncertainty.bands import HIGH, LOW, bands_of, drawn, known_of
from avatar_core.uncertainty.distributions import Distribution, Lognormal, Uniform
from avatar_core.uncertainty.force_table import force_table
from avatar_core.vademecum.model import Vademecum

KNOWN: dict[str, Distribution] = {
    "young": Lognormal(5.3e3, 1.33),
    "poisson": Uniform(0.42, 0.485),
    "contrast": Lognormal(4.0, 1.8),
}
COORDINATES = (Coordinate("poisson", 0.40, 0.49), Coordinate("contrast", 0.5, 20.0))
_LEVELS = (LOW, 0.5, HIGH)
_DEPTH = 4e-3  # [m]; a patch's force is proportional to it
_SHRUNK = 0.25  # of the organ's size, the tumour


@dataclass(frozen=True)
class BandsSettings:
    """Numbers of vertices, of draws and of places."""

    n_vertices: int = 700
    n_draws: int = 1000
    n_places: int = 3


FULL, QUICK = BandsSettings(), BandsSettings(450, 40, 2)


def band_rows(
    settings: BandsSettings, progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[list[dict[str, Value]], dict[str, Value]]:
    """A row for each place; summary: ``band_error``, the worst of both edges of all bands, and
    ``band_draws_per_second`` of processor time, and of full finite elements."""
    surface = phantom_liver(12e-3)
    middle = surface.vertices.mean(axis=0) + np.array([0.0, 0.03, 0.0])
    tumour = SurfaceMesh(
        middle + _SHRUNK * (surface.vertices - middle), surface.faces, "tumour in the phantom"
    )
    options = OrganOptions(
        n_vertices=settings.n_vertices, coordinates=COORDINATES, tumour=tumour, n_certified=16
    )
    vademecum = build(surface, options)
    inclusion = Inclusion(volume_fraction_inside(vademecum.mesh, tumour), 1.0)
    problem = Elasticity(
        vademecum.mesh, vademecum.material, vademecum.regions.clamped, vademecum.element, inclusion
    )
    known, places = known_of(vademecum, KNOWN), starts_apart(vademecum, settings.n_places)
    start = process_time()
    table = force_table(vademecum, Tip("patch", 8e-3), places, [_DEPTH], target=0)
    ours = bands_of(table, known, settings.n_draws).force[:, :, 0]
    own_seconds = process_time() - start
    start = process_time()
    draws = drawn(known, settings.n_draws, 0)
    truth = np.quantile(_full_forces(vademecum, problem, places, draws, progress), _LEVELS, axis=0)
    full_seconds = process_time() - start
    rows = [_row(vademecum, j, ours[:, i], truth[:, i]) for i, j in enumerate(places)]
    worst = max(abs(float(row[name])) for row in rows for name in ("low_error", "high_error"))  # type: ignore[arg-type]
    return rows, {
        "band_error": worst,
        "band_draws_per_second": settings.n_draws / own_seconds,
        "full_draws_per_second": settings.n_draws / full_seconds,
    }


def _full_forces(
    vademecum: Vademecum,
    problem: Elasticity,
    places: list[int],
    draws: dict[str, FloatArray],
    progress: Callable[[int, int], None],
) -> FloatArray:
    """Forces by a solution of each draw, shape (n, n_places) [N]."""
    surface, n = vademecum.surface, len(draws["young"])
    loads = patch_loads(problem, surface.centers[places], surface.patch_radius)
    normals, force = surface.normals[places], np.empty((n, len(places)))
    for k in range(n):
        point = {name: float(values[k]) for name, values in draws.items()}
        here = problem_at(problem, point)
        compliance = np.asarray(loads.T @ here.solve(loads))
        for i, normal in enumerate(normals):
            own = compliance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
            stiffer = point["young"] / here.material.young_modulus
            force[k, i] = stiffer * _DEPTH / (normal @ own @ normal)
        progress(k + 1, n)
    return force


def _row(
    vademecum: Vademecum, position: int, ours: FloatArray, truth: FloatArray
) -> dict[str, Value]:
    x, y, z = 1e3 * vademecum.surface.centers[position]
    row: dict[str, Value] = {"place": f"({x:.0f}, {y:.0f}, {z:.0f}) mm"}
    for name, own, full in zip(("low", "median", "high"), ours, truth, strict=True):
        row |= {f"{name}_N": float(own), f"{name}_full_N": float(full)}
        row[f"{name}_error"] = float(own / full - 1.0)
    return row
