"""Error of the level-set grid (paper, Sec. 3.3.1 and Fig. 9), with h = 10, 5, 2.5 and 1 mm.

A member of the base has weight one on itself, so that all of its error comes from the grid:

- volume: of the level set (as the library computes it) and of its marching-cubes surface;
- distance: phi at random points of the organ, read from the grid trilinearly, against the exact
  one, relative L2 (Fig. 9d);
- displacement: finite element solutions stored at grid points, like the paper stores u(x, s), and
  interpolated back to the mesh's vertices. The error is relative L2 over the organ, mean and worst
  over patch loads;
- remeshed displacement: finite elements on a new mesh of the marching-cubes surface against the
  mesh of the original one, same clamp and loads. Its floor is the error of another mesh of the
  original surface (h = 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.common.processes import repeatable
from avatar_core.fem.patch_loads import load_surface
from avatar_core.geometry.level_set import distance_grid, isosurface
from avatar_core.geometry.mesh import Regions, TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.point_location import closest_points
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.correspondence import interpolation_matrix
from avatar_core.studies.response import carried, relative_errors, trilinear, unit_load_response
from avatar_core.studies.shapes import read_livers
from avatar_core.studies.study import Row, Run, Study, column, follow, label, mean_and_worst

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPACINGS = (10e-3, 5e-3, 2.5e-3, 1e-3)  # [m]
FINEST_REMESHED = 2e-3  # fTetWild needs minutes for a marching-cubes surface finer than this [m]
BAND = 3.0  # spacings
OTHER_MESH = 0.85  # vertices of the second mesh of the same surface, relative


@dataclass(frozen=True)
class GridSettings:
    """Numbers of livers, also at 1 mm and with displacements; mesh, loads, sample points."""

    n_livers: int | None = None
    n_fine: int = 6
    n_displaced: int = 3
    n_vertices: int = 1500
    n_loads: int = 12
    n_points: int = 3000
    remeshed: bool = True
    spacings: tuple[float, ...] = SPACINGS
    phantoms: int = 3
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Reference:
    """A liver on its own mesh: regions, load centres and radius [m], responses at its vertices."""

    mesh: TetMesh
    regions: Regions
    centers: FloatArray
    radius: float
    responses: FloatArray


class GridStudy(Study[GridSettings]):
    """One row for each liver and spacing, and one with h = 0 for the second mesh."""

    name = "grid"
    full = GridSettings()
    quick = GridSettings(
        n_livers=6, n_fine=1, n_displaced=1, n_vertices=800, n_loads=6, remeshed=False
    )
    paper: ClassVar = {"displacement_error_1mm": 0.09}

    @repeatable
    def measure(self, run: Run[GridSettings]) -> None:
        settings = run.settings
        livers = read_livers(run.surfaces, settings.n_livers, settings.phantoms)
        step = max(1, len(livers.surfaces) // max(settings.n_fine, settings.n_displaced, 1))
        for i, surface in enumerate(follow(livers.surfaces, "livers")):
            rank = i // step if i % step == 0 else len(livers.surfaces)
            reference = reference_of(surface, settings) if rank < settings.n_displaced else None
            if reference is not None and settings.remeshed:
                run.add(other_mesh_row(surface, reference, settings))
            fine = rank < settings.n_fine
            for h in settings.spacings:
                if h > FINEST_REMESHED or fine:
                    run.add(grid_row(surface, h, reference, settings))
        run.notices += [
            *livers.notices,
            "displacement_error: the field kept at grid points and read back, one mesh; "
            "remeshed_error: finite elements on a mesh of the marching-cubes surface",
        ]

    def summary(self, run: Run[GridSettings]) -> dict[str, float]:
        """Return the mean and worst of each error over the livers, for each spacing; the order."""
        rows, spacings = run.rows, run.settings.spacings
        summary: dict[str, float] = {}
        for h in spacings:
            for key in ("volume_error", "displacement_error", "distance_error", "remeshed_error"):
                found = _values(rows, key, 1e3 * h)
                if len(found):
                    summary |= mean_and_worst(f"{key}_{_millimetres(h)}", found)
        floor = _values(rows, "remeshed_error", 0.0)
        if len(floor):
            summary |= mean_and_worst("remeshed_error_same_surface", floor)
        first, last = (_mean(rows, "volume_error", 1e3 * h) for h in (spacings[0], spacings[-1]))
        summary["volume_order"] = math.log(first / last) / math.log(spacings[0] / spacings[-1])
        return summary

    def sentence(self, run: Run[GridSettings]) -> str:
        parts = [
            f"{run.summary[f'volume_error_{name}']:.2%} at "
            f"{name.replace('_', '.').replace('mm', ' mm')}"
            for name in ("5mm", "2_5mm")
            if f"volume_error_{name}" in run.summary
        ]
        moved = run.summary.get("displacement_error_1mm", math.nan)
        return (
            f"{len({row['liver'] for row in run.rows})} livers through a level set: volume wrong "
            f"by {', '.join(parts)}; displacements kept on a grid of 1 mm and read back wrong by "
            f"{moved:.2%} (paper 9 %)."
        )

    def draw(self, figure: Figure, run: Run[GridSettings]) -> None:
        left, right = figure.subplots(1, 2)
        spacings = sorted(set(column(run.rows, "spacing_mm")) - {0.0})
        for axes, key, text, style in (
            (left, "volume_error", "level set", "o-"),
            (left, "isosurface_volume_error", "marching-cubes surface", "s--"),
            (left, "distance_error", "distance within the organ (L2)", "d:"),
            (right, "displacement_error", "kept on the grid, read back", "o-"),
            (right, "displacement_error_worst", "the same, worst load", "^--"),
            (right, "remeshed_error", "on a mesh of the level set's surface", "s-"),
        ):
            means = [100 * _mean(run.rows, key, h) for h in spacings]
            axes.loglog(spacings, means, style, label=text)
        floor = 100 * _mean(run.rows, "remeshed_error", 0.0)
        if math.isfinite(floor):
            right.axhline(floor, color="gray", ls=":", label="on another mesh of the same surface")
        right.plot([1.0], [9.0], "k*", ms=12, label="paper, 1 mm: 9 %")
        for axes in (left, right):
            axes.set_xticks(spacings, [f"{h:g}" for h in spacings])
            axes.minorticks_off()
        label(left, "spacing h [mm]", "relative error [%]", "shape (paper, Fig. 9d)")
        label(right, "spacing h [mm]", "relative L2 error [%]", "displacement")


STUDY = GridStudy()


def grid_row(
    surface: SurfaceMesh, h: float, reference: Reference | None, settings: GridSettings
) -> Row:
    """Return the errors of one liver at one spacing; displacements only with a reference."""
    grid = distance_grid(surface, h, padding=BAND * h, band=BAND * h)
    marched = isosurface(grid)
    row: Row = {
        "liver": surface.name,
        "spacing_mm": 1e3 * h,
        "volume_error": abs(grid.volume / surface.volume - 1.0),
        "isosurface_volume_error": abs(marched.volume / surface.volume - 1.0),
        "distance_error": distance_error(surface, grid.origin, h, settings),
    }
    if reference is not None:
        errors = passage_errors(reference, grid.origin, h)
        row |= {"displacement_error": errors.mean(), "displacement_error_worst": errors.max()}
        if settings.remeshed and h > FINEST_REMESHED:
            found = remeshed_errors(marched, reference, settings.n_vertices)
            row |= {"remeshed_error": found.mean(), "remeshed_error_worst": found.max()}
    return row


def other_mesh_row(surface: SurfaceMesh, reference: Reference, settings: GridSettings) -> Row:
    """Return the change of the displacement with another mesh of the same surface."""
    found = remeshed_errors(surface, reference, round(OTHER_MESH * settings.n_vertices))
    return {
        "liver": surface.name,
        "spacing_mm": 0.0,
        "remeshed_error": found.mean(),
        "remeshed_error_worst": found.max(),
    }


def reference_of(surface: SurfaceMesh, settings: GridSettings) -> Reference:
    """Return finite elements on the mesh of the surface, with loads over its accessible region."""
    mesh = tetrahedralize(surface, settings.n_vertices)
    regions = regions_by_rule(mesh)
    loads = load_surface(mesh, regions)
    chosen = np.linspace(0, loads.n_positions - 1, settings.n_loads).astype(int)
    centers = loads.centers[chosen]
    responses = unit_load_response(mesh, regions.clamped, centers, loads.patch_radius)
    return Reference(mesh, regions, centers, loads.patch_radius, responses)


def passage_errors(reference: Reference, origin: FloatArray, h: float) -> FloatArray:
    """Return errors of the responses stored on a grid and read back, shape (n_loads,)."""
    corners, back = trilinear(reference.mesh.vertices, origin, h)
    there_and_back = (back @ interpolation_matrix(reference.mesh, corners)).tocsr()
    found = carried(there_and_back, reference.responses)
    return relative_errors(found, reference.responses, reference.mesh)


def remeshed_errors(surface: SurfaceMesh, reference: Reference, n_vertices: int) -> FloatArray:
    """Return errors of finite elements on a new mesh, read at the old vertices, (n_loads,)."""
    mesh = tetrahedralize(surface, n_vertices)
    middle = mesh.vertices[mesh.boundary_faces].mean(axis=1)
    own = reference.mesh
    _, nearest, _ = closest_points(own.vertices, own.boundary_faces, middle)
    clamped = reference.regions.clamped[nearest]
    found = unit_load_response(mesh, clamped, reference.centers, reference.radius)
    on_old = carried(interpolation_matrix(mesh, reference.mesh.vertices), found)
    return relative_errors(on_old, reference.responses, reference.mesh)


def distance_error(
    surface: SurfaceMesh, origin: FloatArray, h: float, settings: GridSettings
) -> float:
    """Return |phi_h - phi| / |phi| in L2 over the organ, at random points of it."""
    low, high = surface.bounding_box
    points = np.random.default_rng(settings.seed).uniform(low, high, (settings.n_points, 3))
    exact = surface.skin.signed_distance(points)
    inside = exact < 0
    corners, back = trilinear(points[inside], origin, h)
    found = back @ surface.skin.signed_distance(corners)
    return float(np.linalg.norm(found - exact[inside]) / np.linalg.norm(exact[inside]))


def _millimetres(h: float) -> str:
    return f"{1e3 * h:g}mm".replace(".", "_")


def _values(rows: list[Row], key: str, spacing: float) -> FloatArray:
    return column([row for row in rows if math.isclose(row["spacing_mm"], spacing)], key)  # type: ignore[arg-type]


def _mean(rows: list[Row], key: str, spacing: float) -> float:
    found = _values(rows, key, spacing)
    return float(np.mean(found)) if len(found) else math.nan
