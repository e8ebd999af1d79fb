"""Bands of a force against draws of the full finite element problem.

A small organ with a tumour, over Poisson's ratio and the contrast, is built once. Each draw of the
material is then also solved in full for the patch at some places. Both sides see the same draws.
The difference is therefore the error of the vademecum and its table, and not chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.contact.tool_path import starts_apart
from avatar_core.fem.elasticity import Elasticity, Inclusion
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.geometry.tumour import volume_fraction_inside
from avatar_core.pipeline import OrganOptions, build
from avatar_core.reduction.coordinates import Coordinate, problem_at
from avatar_core.studies.certainty_section import CertaintySettings, Section
from avatar_core.studies.study import Panel, ProgressBar, Row, column, follow
from avatar_core.uncertainty.bands import HIGH, LOW, bands_of, drawn
from avatar_core.uncertainty.distributions import Distribution, Lognormal, Uniform
from avatar_core.uncertainty.force_table import force_table
from avatar_core.uncertainty.known import known_of
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KNOWN: dict[str, Distribution] = {
    "young": Lognormal(5.3e3, 1.33),
    "poisson": Uniform(0.42, 0.485),
    "contrast": Lognormal(4.0, 1.8),
}
COORDINATES = (Coordinate("poisson", 0.40, 0.49), Coordinate("contrast", 0.5, 20.0))
_LEVELS = (LOW, 0.5, HIGH)
_DEPTH = 4e-3  # [m]; a patch's force is proportional to it
_SHRUNK = 0.25  # size of the tumour over the organ's
_N_VERTICES = 700


def bands_section(surface: SurfaceMesh, settings: CertaintySettings, bar: ProgressBar) -> Section:
    """Return the bands of a small organ, whatever the liver of the study.

    A thousand of its problems are solved.
    """
    vademecum, problem = _small_organ(settings, bar)
    known, places = known_of(vademecum, KNOWN), starts_apart(vademecum, settings.n_places)
    start = process_time()
    table = force_table(vademecum, Tip("patch", 8e-3), places, [_DEPTH], vademecum.mesh.vertices[0])
    ours = bands_of(table, known, settings.n_draws).force[:, :, 0]
    seconds = process_time() - start
    bar.begin("draws of the full problem")
    start = process_time()
    forces = _full_forces(vademecum, problem, places, drawn(known, settings.n_draws, 0))
    truth = np.quantile(forces, _LEVELS, axis=0)
    full_seconds = process_time() - start
    rows = [_row(vademecum, j, ours[:, i], truth[:, i]) for i, j in enumerate(places)]
    worst, shape = band_errors(rows)
    return Section(
        name="band",
        sentence=(
            f"The edges of the bands of 90 % of the force lie within {worst:.1%} of those of "
            f"{settings.n_draws} full finite element solutions, and, over their medians, within "
            f"{shape:.1%}."
        ),
        summary={
            "band_error": worst,
            "band_shape_error": shape,
            "band_draws_per_second": settings.n_draws / seconds,
            "band_full_draws_per_second": settings.n_draws / full_seconds,
        },
        rows=tuple(rows),
        panels=(Panel(_BANDS, partial(_draw, rows=rows)),),
        notices=("bands: of the phantom with a tumour, whose draws can all be solved",),
    )


_BANDS = (
    "Force of a patch 4 mm deep: median and band of 90 % from the vademecum, beside those of full "
    "finite elements for the same draws of E, nu and the tumour's contrast."
)


def band_errors(rows: Sequence[Row]) -> tuple[float, float]:
    """Return the worst relative error of all bands' edges, and of their ratios to the medians.

    The first includes the error of the force itself at a place, which `avatar show` prints. At a
    thin edge it is large, because the contact surface is smoothed there. The second is the error of
    the band alone.
    """
    low, median, high = (1.0 + column(rows, f"{name}_error") for name in ("low", "median", "high"))
    edges = np.concatenate([low, high])
    ratios = np.concatenate([low / median, high / median])
    return float(np.abs(edges - 1.0).max()), float(np.abs(ratios - 1.0).max())


def _small_organ(settings: CertaintySettings, bar: ProgressBar) -> tuple[Vademecum, Elasticity]:
    surface = phantom_liver(12e-3)
    middle = surface.vertices.mean(axis=0) + np.array([0.0, 0.03, 0.0])
    tumour = SurfaceMesh(
        middle + _SHRUNK * (surface.vertices - middle), surface.faces, "tumour in the phantom"
    )
    options = OrganOptions(
        n_vertices=_N_VERTICES, coordinates=COORDINATES, tumour=tumour, n_certified=16
    )
    vademecum = build(surface, options, bar.begin("bands"))
    inclusion = Inclusion(volume_fraction_inside(vademecum.mesh, tumour), 1.0)
    mesh, clamped = vademecum.mesh, vademecum.regions.clamped
    return vademecum, Elasticity(mesh, vademecum.material, clamped, vademecum.element, inclusion)


def _full_forces(
    vademecum: Vademecum, problem: Elasticity, places: list[int], draws: dict[str, FloatArray]
) -> FloatArray:
    """Return the forces by a solution of each draw, shape (n, n_places) [N]."""
    surface, n = vademecum.surface, len(draws["young"])
    loads = patch_loads(problem, surface.centers[places], surface.patch_radius)
    normals, force = surface.normals[places], np.empty((n, len(places)))
    for k in follow(range(n), "draws"):
        point = {name: float(values[k]) for name, values in draws.items()}
        here = problem_at(problem, point)
        compliance = np.asarray(loads.T @ here.solve(loads))
        for i, normal in enumerate(normals):
            own = compliance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
            stiffer = point["young"] / here.material.young_modulus
            force[k, i] = stiffer * _DEPTH / (normal @ own @ normal)
    return force


def _row(vademecum: Vademecum, position: int, ours: FloatArray, truth: FloatArray) -> Row:
    x, y, z = 1e3 * vademecum.surface.centers[position]
    row: Row = {"place": f"({x:.0f}, {y:.0f}, {z:.0f}) mm"}
    for name, own, full in zip(("low", "median", "high"), ours, truth, strict=True):
        row |= {f"{name}_N": float(own), f"{name}_full_N": float(full)}
        row[f"{name}_error"] = float(own / full - 1.0)
    return row


def _draw(axes: Axes, rows: Sequence[Row]) -> None:
    at = np.arange(len(rows))
    for shift, suffix, text in ((-0.1, "", "vademecum"), (0.1, "_full", "full finite elements")):
        low, median, high = (
            column(rows, f"{name}{suffix}_N") for name in ("low", "median", "high")
        )
        bars = (median - low, high - median)
        axes.errorbar(at + shift, median, bars, fmt="o", capsize=4, label=text)
    axes.set(ylabel="force [N]", ylim=(0.0, None))
    axes.set_xticks(at, [str(row["place"]) for row in rows], fontsize=6)
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize=7)
