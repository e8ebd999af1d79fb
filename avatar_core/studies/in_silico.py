"""Fifty livers generated from one by Eq. 17 (paper, Sec. 3.2).

The study asks whether LLE finds the six parameters, and how well it interpolates shape and
displacement. All livers have the same mesh, moved by the maps of Eq. 17, so that nodes correspond.
Eq. 18 is evaluated nodewise and, like in the paper, at the points of the common grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.common.processes import repeatable
from avatar_core.fem.patch_loads import default_patch_radius, load_surface
from avatar_core.geometry.level_set import GridBox, reinitialize
from avatar_core.geometry.mesh import TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.shapes.correspondence import interpolation_matrix
from avatar_core.shapes.lle import CLEAR_GAP, LLE
from avatar_core.shapes.weights import Barycenter
from avatar_core.studies.response import carried, relative_errors, trilinear, unit_load_response
from avatar_core.studies.shapes import PAPER_GRID, as_grid, distance_vectors, paper_box
from avatar_core.studies.study import Row, Run, Study, column, follow, mean_and_worst, where

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARAMETERS = 6
NEIGHBORS = 12
SPECTRA: tuple[tuple[int, float], ...] = (
    (8, 1e-6),
    (10, 1e-3),
    (10, 1e-6),
    (10, 1e-9),
    (12, 1e-3),
    (12, 1e-6),
    (12, 1e-9),
)
SPECTRA += ((15, 1e-6), (20, 1e-6))


@dataclass(frozen=True)
class InSilicoSettings:
    """Number of livers in the base and held out, mesh vertices, load positions, grid, phantom."""

    n_base: int = 45
    n_held_out: int = 5
    n_vertices: int = 1400
    n_loads: int = 22
    shape: tuple[int, int, int] = PAPER_GRID
    phantom_spacing: float = 7e-3
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Population:
    """Livers of one mesh: distance vectors (n, D), moved meshes, responses at their vertices."""

    box: GridBox
    vectors: FloatArray
    volumes: FloatArray
    meshes: tuple[TetMesh, ...]
    responses: tuple[FloatArray, ...]


class InSilicoStudy(Study[InSilicoSettings]):
    """Errors of the livers held out, then the spectrum of all; the livers are generated."""

    name = "in-silico"
    full = InSilicoSettings()
    quick = InSilicoSettings(n_vertices=600, n_loads=8, phantom_spacing=10e-3)
    paper: ClassVar = {
        "volume_error": 0.05,
        "displacement_grid": 0.0903,
        "from_gap_k12": PARAMETERS,
    }

    @repeatable
    def measure(self, run: Run[InSilicoSettings]) -> None:
        """Measure, and keep the embedding of all livers for the picture."""
        livers = populate(run.settings)
        n = run.settings.n_base
        spectra = [spectrum_row(livers.vectors, k, r) for k, r in SPECTRA if k < n]
        for row in (*held_out_rows(livers, run.settings), *spectra):
            run.add(row)
        base = LLE(NEIGHBORS).fit(livers.vectors)
        run.kept["eigenvalues"] = base.dimension().eigenvalues
        run.kept["flat"] = base.embedding_
        run.notices += _spectrum_notices(spectra)

    def summary(self, run: Run[InSilicoSettings]) -> dict[str, float]:
        def of(key: str) -> FloatArray:
            return column(run.rows, key)

        summary = {
            **mean_and_worst("volume_error", of("volume_error")),
            **mean_and_worst("displacement_nodewise", of("nodewise")),
            **mean_and_worst("displacement_grid", of("grid")),
            "displacement_nodewise_all": float(of("nodewise_all").mean()),
            "displacement_passage": float(of("passage").mean()),
        }
        for k in (10, 12):
            (at,) = where(run.rows, kind="spectrum", k=k, regularization=1e-6)
            for key in ("gap", "from_gap", "six_stand_out"):
                summary[f"{key}_k{k}"] = float(at[key] or 0)
        return summary

    def sentence(self, run: Run[InSilicoSettings]) -> str:
        summary, settings = run.summary, run.settings
        verdict = "stand out" if summary["six_stand_out_k12"] else "do not stand out"
        other = "stand out" if summary["six_stand_out_k10"] else "do not"
        volume, grid = summary["volume_error"], summary["displacement_grid"]
        twelve, every = summary["displacement_nodewise"], summary["displacement_nodewise_all"]
        return (
            f"{settings.n_base} + {settings.n_held_out} livers by Eq. 17: volume {volume:.2%} "
            f"wrong (paper < 5 %), displacement {twelve:.2%} nodewise ({every:.2%} with all "
            f"neighbors) and {grid:.2%} on the grid (paper 9.03 %); six eigenvalues {verdict} for "
            f"k = 12, {other} for k = 10."
        )

    def draw(self, figure: Figure, run: Run[InSilicoSettings]) -> None:
        left, middle, right = figure.subplots(1, 3)
        eigenvalues, flat = run.kept["eigenvalues"], run.kept["flat"]
        numbers = np.arange(1, len(eigenvalues) + 1)
        first = numbers <= PARAMETERS
        left.semilogy(numbers[first], eigenvalues[first], "o", color="crimson", label="first six")
        left.semilogy(numbers[~first], eigenvalues[~first], "o", color="gray", label="others")
        left.set(xlabel="number of the eigenvalue", ylabel="eigenvalue of M [-]")
        left.set_title(f"spectrum, k = {NEIGHBORS} (paper, Fig. 5a)")
        left.legend()
        n = run.settings.n_base
        middle.plot(*flat[:n].T, "o", color="steelblue", label="base")
        middle.plot(*flat[n:].T, "o", color="crimson", label="held out")
        middle.set(xlabel="first coordinate [-]", ylabel="second coordinate [-]", title="embedding")
        middle.legend()
        place = np.arange(run.settings.n_held_out)
        for k, (key, text) in enumerate(
            (("volume_error", "volume"), ("nodewise", "u nodewise"), ("grid", "u on the grid"))
        ):
            right.bar(place + 0.27 * (k - 1), 100 * column(run.rows, key), 0.25, label=text)
        right.set_yscale("log")
        right.axhline(9.03, color="black", ls="--", lw=1, label="paper, displacement 9.03 %")
        right.set(xlabel="held-out liver", ylabel="relative error [%]", title="interpolated livers")
        right.legend(fontsize=8)


STUDY = InSilicoStudy()


def populate(settings: InSilicoSettings) -> Population:
    """Return the phantom moved by the maps of Eq. 17: distances, meshes and responses."""
    organ = phantom_liver(settings.phantom_spacing)
    maps = population(settings.n_base + settings.n_held_out, settings.seed)
    moved = [shape.moved(organ) for shape in maps]
    box = paper_box(moved, settings.shape)
    mesh = tetrahedralize(organ, settings.n_vertices)
    regions = regions_by_rule(mesh)
    radius = default_patch_radius(mesh, regions)
    positions = load_surface(mesh, regions, radius).centers
    positions = positions[np.linspace(0, len(positions) - 1, settings.n_loads).astype(int)]
    meshes = [TetMesh(shape(mesh.vertices), mesh.tets) for shape in maps]
    responses = [
        unit_load_response(one, regions.clamped, shape(positions), radius)
        for one, shape in zip(meshes, follow(maps, "finite elements"), strict=True)
    ]
    volumes = np.array([surface.volume for surface in moved])
    return Population(box, distance_vectors(moved, box), volumes, tuple(meshes), tuple(responses))


def spectrum_row(vectors: FloatArray, k: int, regularization: float) -> Row:
    """Return the dimension by the largest ratio of eigenvalues, and whether the sixth leads."""
    base = LLE(k, regularization=regularization).fit(vectors)
    found = base.dimension(n_values=PARAMETERS + 8)
    values = np.maximum(found.eigenvalues, np.finfo(float).eps * len(base.vectors_))
    return {
        "kind": "spectrum",
        "k": k,
        "regularization": regularization,
        "from_gap": found.from_gap,
        "gap": found.gap,
        "seventh_over_sixth": float(values[PARAMETERS] / values[PARAMETERS - 1]),
        "six_stand_out": bool(found.from_gap == PARAMETERS and found.gap >= CLEAR_GAP),
        "from_local_pca": found.from_local_pca,
    }


def held_out_rows(livers: Population, settings: InSilicoSettings) -> list[Row]:
    """Return the errors of each held-out liver, interpolated among the base."""
    base = LLE(NEIGHBORS).fit(livers.vectors[: settings.n_base])
    everyone = LLE(settings.n_base - 1).fit(livers.vectors[: settings.n_base])
    held_out = range(settings.n_base, settings.n_base + settings.n_held_out)
    rows: list[Row] = []
    for i in follow(held_out, "held-out livers"):
        point = base.barycenter(livers.vectors[i])
        blend = as_grid(point.combine(livers.vectors[: settings.n_base]), livers.box)
        found = reinitialize(blend).volume
        mesh, wanted = livers.meshes[i], livers.responses[i]
        nodewise = relative_errors(point.combine(livers.responses), wanted, mesh)
        by_all = everyone.barycenter(livers.vectors[i]).combine(livers.responses)
        on_grid = relative_errors(_through_grid(livers, point, mesh), wanted, mesh)
        itself = relative_errors(_passage(livers, i, mesh), wanted, mesh)
        rows.append(
            {
                "liver": i,
                "volume_error": abs(found / float(livers.volumes[i]) - 1.0),
                "nodewise": float(nodewise.mean()),
                "nodewise_worst_load": float(nodewise.max()),
                "nodewise_all": float(relative_errors(by_all, wanted, mesh).mean()),
                "grid": float(on_grid.mean()),
                "grid_worst_load": float(on_grid.max()),
                "passage": float(itself.mean()),
                "absolute_sum": point.absolute_sum,
                "hull_over_nearest": point.hull_distance / float(point.distances[0]),
            }
        )
    return rows


def _through_grid(livers: Population, point: Barycenter, mesh: TetMesh) -> FloatArray:
    """Return Eq. 18 at the grid points, read at the vertices of the patient's mesh."""
    corners, back = trilinear(mesh.vertices, np.array(livers.box.origin), livers.box.spacing)
    total = np.zeros((len(mesh.vertices), *livers.responses[0].shape[1:]))
    for weight, j in zip(point.weights, point.neighbors, strict=True):
        there_and_back = (back @ interpolation_matrix(livers.meshes[j], corners)).tocsr()
        total += weight * carried(there_and_back, livers.responses[j])
    return total


def _passage(livers: Population, i: int, mesh: TetMesh) -> FloatArray:
    """Return the patient's own field through the grid and back: the error of the grid alone."""
    corners, back = trilinear(mesh.vertices, np.array(livers.box.origin), livers.box.spacing)
    return carried((back @ interpolation_matrix(mesh, corners)).tocsr(), livers.responses[i])


def _spectrum_notices(spectra: list[Row]) -> list[str]:
    return [
        f"k = {row['k']}, regularisation {row['regularization']:g}: six eigenvalues "
        f"{'stand out' if row['six_stand_out'] else 'do NOT stand out'} (the largest step, "
        f"{row['gap']:.1f} times, is after {row['from_gap']}); local PCA says "
        f"{row['from_local_pca']}"
        for row in spectra
    ]
