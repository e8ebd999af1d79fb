"""Time and memory of a patient and of an addition against the number of anatomies in an atlas.

The anatomies are the template bent by smooth maps, with responses of a small rank and on a coarse
grid. A thousand of them are therefore written in minutes; each goes through the same files as a
real one. A patient is found by kriging among all, and combined from its neighbors
(``interpolated``, without registration, which does not depend on the atlas). Every row is measured
in a process of its own.
"""

from __future__ import annotations

import resource
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.atlas.anatomy import Anatomy, Origin, Response, WholeAnatomy
from avatar_core.atlas.base import base_of
from avatar_core.atlas.frame import Frame
from avatar_core.atlas.growth import AtlasOptions, default_template, extend_atlas, new_frame
from avatar_core.atlas.storage import load_atlas, n_bytes, save_anatomy, save_frame
from avatar_core.atlas.transfer import combine, patient_weights
from avatar_core.atlas.workers import Workers
from avatar_core.common.processes import cpu_seconds
from avatar_core.fem.elasticity import Material
from avatar_core.fem.patch_loads import load_surface
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.mesh import quality as mesh_quality
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import (
    Registration,
    RegistrationQuality,
    SimilarityTransform,
    TemplateRule,
)
from avatar_core.studies.study import Row, Run, Study, column, follow

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AT = 100_000  # anatomies of the estimate on paper
REAL_MB = 5.4  # size of a real anatomy: 120 modes, 49,000 points
BUILD_SECONDS = 15.0  # CPU time of a real one: registration and response
# an addition takes as long in a small atlas as in a large one, but for what depends on the size
ROUGH = TemplateRule(
    n_stages=5, last_sweeps=0, n_samples=800, largest_mean=2e-3, largest_reverse_mean=5e-3
)


@dataclass(frozen=True)
class AtlasSizeSettings:
    """Numbers of anatomies, rank of their responses, and vertices of the template."""

    sizes: tuple[int, ...] = (10, 100, 1000)
    rank: int = 8
    template_vertices: int = 2500


class AtlasSizeStudy(Study[AtlasSizeSettings]):
    """One row for each number of anatomies."""

    name = "atlas-size"
    full = AtlasSizeSettings()
    quick = AtlasSizeSettings((5, 20), 4, 700)

    def measure(self, run: Run[AtlasSizeSettings]) -> None:
        settings, largest = run.settings, max(run.settings.sizes)
        template = default_template(settings.template_vertices)
        frame = new_frame(template, AtlasOptions(spacing=0.03, rule=ROUGH))
        maps = population(largest + 2, seed=0)
        member = _Member(frame, settings.rank)
        with TemporaryDirectory() as name:
            folder = Path(name, "atlas")
            folder.mkdir()
            save_frame(folder, frame, "study")
            for n in settings.sizes:
                there = len(list(folder.glob("*/")))
                for k in follow(range(there, n), f"{n} anatomies"):
                    save_anatomy(folder, member(k, maps[k](template.mesh.vertices)))
                patient = maps[-1](template.mesh.vertices)
                row: Row = {"n": n, "megabytes": n_bytes(folder) / 1e6}
                row |= _in_own_process(_patient, folder, patient)
                newcomer = replace(maps[-2].moved(phantom_liver()), name="newcomer")
                row |= _in_own_process(_addition, folder, newcomer)
                run.add(row)
                shutil.rmtree(folder / "newcomer")
        run.notices += _on_paper(run.rows)

    def summary(self, run: Run[AtlasSizeSettings]) -> dict[str, float]:
        """Return the figures of each number of anatomies."""
        keys = [key for key in run.rows[0] if key != "n"]
        return {f"{key}_{row['n']}": float(row[key] or 0.0) for row in run.rows for key in keys}

    def sentence(self, run: Run[AtlasSizeSettings]) -> str:
        first, last = run.rows[0], run.rows[-1]
        return (
            f"From {first['n']} to {last['n']} anatomies: an atlas is opened in "
            f"{first['open_seconds']:.2f} and {last['open_seconds']:.2f} s, a patient found in "
            f"{first['find_seconds']:.2f} and {last['find_seconds']:.2f} s and combined in "
            f"{first['combine_seconds']:.2f} and {last['combine_seconds']:.2f} s; an addition, "
            f"roughly registered, takes {first['add_seconds']:.2f} and "
            f"{last['add_seconds']:.2f} s; memory {first['patient_mb']:.0f} and "
            f"{last['patient_mb']:.0f} MB."
        )

    def draw(self, figure: Figure, run: Run[AtlasSizeSettings]) -> None:
        left, right = figure.subplots(1, 2)
        n = column(run.rows, "n")
        for key, text in (
            ("open_seconds", "open the atlas"),
            ("find_seconds", "find the neighbors"),
            ("combine_seconds", "read and combine their responses"),
            ("add_seconds", "add a surface, roughly registered"),
        ):
            left.loglog(n, column(run.rows, key), "o-", label=text)
        left.set_ylabel("CPU time [s]")
        for key, text in (
            ("patient_mb", "memory of the process that makes a patient"),
            ("megabytes", "files"),
        ):
            right.loglog(n, column(run.rows, key), "o-", label=text)
        right.set_ylabel("size [MB]")
        for axes in (left, right):
            axes.set_xlabel("anatomies in the atlas [-]")
            axes.legend(fontsize=8)
            axes.grid(alpha=0.3)


STUDY = AtlasSizeStudy()


class _Member:
    """Builder of anatomies without registration or solution: the template bent, random modes."""

    def __init__(self, frame: Frame, rank: int) -> None:
        self._frame, self._rank = frame, rank
        mesh, regions = frame.template.mesh, frame.template.regions
        self._loads = load_surface(mesh, regions)
        quality = RegistrationQuality(0.0, 0.0, 0.0, 0.0, 1.0, 0.0, mesh_quality(mesh))
        still = SimilarityTransform(1.0, np.eye(3), np.zeros(3))
        origin = Origin("", "m", "RAS", len(mesh.vertices))
        self._shape = Anatomy("", "", origin, mesh.volume, still, mesh.vertices, quality, True)

    def __call__(self, k: int, vertices: np.ndarray) -> WholeAnatomy:
        random, n = np.random.default_rng(k), self._loads.n_positions
        space, load = (
            1e-2 * random.standard_normal((length, self._rank)).astype(np.float32)
            for length in (vertices.size, 3 * n)
        )
        residual = np.zeros((n, 3, 3))
        response = Response(space, load, residual, Material(), "P2", self._loads.patch_radius)
        name = f"bent-{k:06d}"
        shape = replace(
            self._shape, name=name, key=name, registered=vertices, response=response.kind
        )
        return WholeAnatomy(shape, np.zeros(self._frame.n_points), response)


def _in_own_process(function: Callable[..., Row], *arguments: object) -> Row:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def _patient(folder: Path, vertices: np.ndarray) -> Row:
    """Return CPU seconds of a patient by stage, and the largest memory of the process [MB]."""
    start = cpu_seconds()
    atlas = load_atlas(folder)
    base = base_of(atlas)
    opened = cpu_seconds()
    first, mesh = atlas.anatomies[0], TetMesh(vertices, base.template.mesh.tets)
    laid = Registration(base.template, mesh, first.alignment, first.quality, (), True)
    weights = patient_weights(base, laid, phantom_liver())
    found = cpu_seconds()
    combine(base.responses, weights)
    return {
        "open_seconds": opened - start,
        "find_seconds": found - opened,
        "combine_seconds": cpu_seconds() - found,
        "n_neighbors": len(weights.weights),
        "patient_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def _addition(folder: Path, newcomer: SurfaceMesh) -> Row:
    """Return CPU seconds to add a surface, with its rough registration and without a response."""
    start = cpu_seconds()
    extend_atlas(folder, [newcomer], workers=Workers(1))
    return {"add_seconds": cpu_seconds() - start}


def _on_paper(rows: Sequence[Row]) -> list[str]:
    """Return the extrapolation to AT anatomies by the slopes between the two largest atlases."""
    if len(rows) < 2:
        return []
    one, other = rows[-2:]
    span = float(other["n"] or 0) - float(one["n"] or 0)

    def at(key: str) -> float:
        low, high = float(one[key] or 0.0), float(other[key] or 0.0)
        return high + (high - low) / span * (AT - float(other["n"] or 0))

    hours = AT * BUILD_SECONDS / 3600
    return [
        f"on paper, {AT:,} anatomies: opened in {at('open_seconds'):.0f} s once, a patient found "
        f"in {at('find_seconds'):.0f} s in {at('patient_mb') / 1e3:.1f} GB of memory, one added in "
        f"{at('add_seconds'):.0f} s beside its building; files of 120 modes "
        f"{AT * REAL_MB / 1e6:.2f} TB; building takes {hours:.0f} h of CPU, {hours / 100:.1f} h "
        "on a Dask cluster of 100 cores"
    ]
