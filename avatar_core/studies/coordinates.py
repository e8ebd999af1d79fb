"""Cost and error of each extra coordinate: Poisson's ratio, tumour, large deformation.

All errors are on loads at face centroids and on values that no build has seen, against full finite
elements on the same mesh.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from avatar_core.certify.combinations import COMBINATIONS, push_errors
from avatar_core.certify.large_deformation import certify_large
from avatar_core.certify.parametric import certify_range
from avatar_core.fem.elasticity import Element
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.geometry.tumour import read_tumour
from avatar_core.offline.large_deformation import (
    LargeRule,
    hyperelastic_problem,
    with_large_deformation,
)
from avatar_core.offline.rule import BuildRule, Progress
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.studies.bench.methods import time_steps
from avatar_core.studies.organ import Organ
from avatar_core.studies.shapes import DEFAULT_FOLDER, read_liver
from avatar_core.studies.study import ProgressBar, Row, Run, Study, column, label, where
from avatar_core.vademecum.large_deformation import LargeMaterial
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TUMOUR_FOLDER = DEFAULT_FOLDER.parent / "tumour"
TUMOUR_AXES = "LPS"  # as they lie against the phantom; the files do not say
RANKS = (40, 60, 100)  # modes at a place at most


@dataclass(frozen=True)
class CoordinatesSettings:
    """Sizes of the study: vertices of the meshes, unseen loads.

    n_pushed : sites of large pushes
    n_combined : sites of combinations
    patch_radius : radius of the loads, by default the organ's own [m]
    """

    n_vertices: int = 2850
    n_loads: int = 80
    n_pushed: int = 6
    n_combined: int = 2
    patch_radius: float | None = None


class CoordinatesStudy(Study[CoordinatesSettings]):
    """All coordinates on LiTS-4, Poisson's ratio on LiTS-23 too, real tumours if they are there."""

    name = "coordinates"
    full = CoordinatesSettings()
    quick = CoordinatesSettings(1000, 48, 3, 1)
    paper: ClassVar = {"large_build_cpu_seconds": "3 to 4 days"}

    def measure(self, run: Run[CoordinatesSettings]) -> None:
        settings = run.settings
        one, other = (read_liver(run.surfaces, name) for name in ("LiTS-4", "LiTS-23"))
        run.notices.append(f"{one.name} and {other.name}")
        poisson, incompressible = ((Coordinate("poisson", 0.40, most),) for most in (0.49, 0.499))
        with ProgressBar(6) as bar:
            for surface in (one, other) if one.name != other.name else (one,):
                progress = bar.begin(f"Poisson's ratio, {surface.name}")
                organ = _organ(surface, settings)
                run.rows += _parametric(organ, "poisson", poisson, settings, progress)
            progress = bar.begin("towards incompressibility")
            organ = _organ(one, settings, "Taylor-Hood")
            run.rows += _parametric(organ, "incompressible", incompressible, settings, progress)
            run.rows += _tumour_rows(settings, bar.begin("tumour"))
            large = _organ(one, settings)
            run.rows += _large(large, "neo-hookean", settings, bar.begin("neo-Hookean"))
            progress = bar.begin("St Venant-Kirchhoff")
            run.rows += _large(large, "st-venant-kirchhoff", settings, progress)

    def summary(self, run: Run[CoordinatesSettings]) -> dict[str, float]:
        """Return the worst of both livers where there are two."""
        summary: dict[str, float] = {}
        for name in ("poisson", "incompressible", "tumour"):
            best = where(run.rows, coordinate=name, modes=RANKS[-1])
            for key, source in (
                ("mean", "l2_mean"),
                ("worst", "l2_worst"),
                ("contact_mean", "contact_mean"),
                ("build_cpu_seconds", "build_cpu_seconds"),
            ):
                summary[f"{name}_{key}"] = float(max(column(best, source), default=np.nan))
        for name, key in (("neo-hookean", "large"), ("st-venant-kirchhoff", "stvk")):
            (row,) = where(run.rows, coordinate=f"large, {name}")
            for ours, theirs in (
                ("mean", "l2_mean"),
                ("worst", "l2_worst"),
                ("contact_mean", "contact_mean"),
                ("depth", "depth"),
                ("build_cpu_seconds", "build_cpu_seconds"),
            ):
                summary[f"{key}_{ours}"] = float(row[theirs])  # type: ignore[arg-type]
            if "step_over_linear" in row:
                summary["large_step_over_linear"] = float(row["step_over_linear"])  # type: ignore[arg-type]
        within = where(run.rows, coordinate="push, neo-hookean", within=True)
        depth = column(within, "depth")
        deep = (depth > 0.0125) & (depth < 0.0175)
        ratio = (column(within, "linear_l2") / column(within, "l2"))[deep]
        summary["linear_over_large_15mm"] = _mean(ratio)
        for name in COMBINATIONS:
            found = where(run.rows, combination=name)
            for key in ("contact", "linear_contact"):
                summary[f"{name.replace(' ', '_')}_{key}_mean"] = _mean(column(found, key))
        return summary

    def sentence(self, run: Run[CoordinatesSettings]) -> str:
        summary = run.summary
        return (
            f"Unseen loads and values: Poisson's ratio 0.40 to 0.49 {summary['poisson_mean']:.1%}, "
            f"to 0.499 {summary['incompressible_mean']:.1%}, with a tumour's contrast "
            f"{summary['tumour_mean']:.1%}; neo-Hookean pushes {summary['large_mean']:.1%} (linear "
            f"{summary['linear_over_large_15mm']:.1f} times as wrong at 15 mm)."
        )

    def draw(self, figure: Figure, run: Run[CoordinatesSettings]) -> None:
        left, right = figure.subplots(1, 2)
        for name, organ in sorted(
            (kind, str(row["organ"]))
            for kind in ("poisson", "incompressible", "tumour")
            for row in where(run.rows, coordinate=kind, modes=RANKS[0])
        ):
            some = where(run.rows, coordinate=name, organ=organ)
            modes, error = column(some, "modes"), column(some, "l2_mean")
            left.semilogy(modes, error, "o-", ms=3, label=f"{name}, {organ}")
        label(left, "modes", "mean relative L2 error [-]", "unseen loads and values")
        pushes = where(run.rows, coordinate="push, neo-hookean")
        for key, text, colour in (
            ("linear_l2", "linear", "tab:gray"),
            ("l2", "with magnitude", "crimson"),
        ):
            depth, error = 1e3 * column(pushes, "depth"), column(pushes, key)
            right.semilogy(depth, error, ".", color=colour, label=text)
        y = "relative L2 error of displacement [-]"
        label(right, "depth of the push [mm]", y, "neo-Hookean pushes, unseen")


STUDY = CoordinatesStudy()


def _organ(
    surface: SurfaceMesh,
    settings: CoordinatesSettings,
    element: Element | None = None,
    tumour: SurfaceMesh | None = None,
) -> Organ:
    return Organ.of(surface, settings.n_vertices, element, tumour, settings.patch_radius)


# --- coordinates of the material ----------------------------------------------------------------


def _parametric(
    organ: Organ,
    name: str,
    coordinates: tuple[Coordinate, ...],
    settings: CoordinatesSettings,
    progress: Progress,
) -> list[Row]:
    """Return errors of the default vademecum by number of modes, and the time of its build."""
    start = time.process_time()
    vademecum = organ.parametric(coordinates, BuildRule(), progress)
    seconds = time.process_time() - start
    assert vademecum.parametric is not None
    rows: list[Row] = []
    for rank in RANKS:
        fewer = _with_modes(vademecum, rank)
        n_loads = settings.n_loads if rank == RANKS[-1] else settings.n_loads // 2
        c = certify_range(fewer, organ.elasticity, n_loads, seed=1)
        rows.append(
            {
                "coordinate": name,
                "organ": organ.outline.name,
                "method": "default",
                "modes": rank,
                "l2_mean": c.l2_mean,
                "l2_worst": c.l2_worst,
                "contact_mean": c.contact_mean,
                "contact_worst": c.contact_worst,
                "build_cpu_seconds": seconds,
            }
        )
    return rows


def _with_modes(vademecum: Vademecum, modes: int) -> Vademecum:
    """Return the vademecum with fewer modes at a place, at any value of its coordinates."""
    parametric = vademecum.parametric
    assert parametric is not None
    most = modes - parametric.n_global
    fewer = replace(
        parametric,
        projection=parametric.projection[:, :most],
        regional_load=parametric.regional_load[..., :most],
    )
    return replace(vademecum, field=vademecum.field.with_most(modes), parametric=fewer)


def _tumour_rows(settings: CoordinatesSettings, progress: Progress) -> list[Row]:
    """Return rows of Poisson's ratio and the contrast of real tumours together."""
    liver, tumour = TUMOUR_FOLDER / "liver.vtk", TUMOUR_FOLDER / "liver_tumours.vtk"
    if not liver.is_file():
        return []
    surface = read_surface(liver, axes=TUMOUR_AXES)
    organ = _organ(surface, settings, tumour=read_tumour(tumour, axes=TUMOUR_AXES))
    coordinates = (Coordinate("poisson", 0.40, 0.49), Coordinate("contrast", 0.5, 20.0))
    return _parametric(organ, "tumour", coordinates, settings, progress)


# --- large deformation --------------------------------------------------------------------------


def _large(
    organ: Organ, material: LargeMaterial, settings: CoordinatesSettings, progress: Progress
) -> list[Row]:
    """Return rows of one material: its summary, every push, and neo-Hookean combinations."""
    start = time.process_time()
    linear = organ.linear(BuildRule(), progress)
    problem = hyperelastic_problem(linear, material)
    bent = with_large_deformation(linear, problem, material, LargeRule(), progress)
    seconds = time.process_time() - start

    def pushed(fraction: float, error: float) -> None:
        progress("push", fraction, error)

    certificate, found = certify_large(bent, problem, settings.n_pushed, seed=1, progress=pushed)
    summary: Row = {
        "coordinate": f"large, {material}",
        "organ": organ.outline.name,
        "method": "default",
        "modes": bent.large.terms.rank if bent.large else 0,
        "build_cpu_seconds": seconds,
        **vars(certificate),
    }
    rows: list[Row] = [summary]
    rows += [{"coordinate": f"push, {material}", **vars(row)} for row in found]
    if material == "neo-hookean":
        summary["step_over_linear"] = _pace(linear, bent)
        depths = (5e-3, 10e-3, 15e-3)

        def combined(fraction: float) -> None:
            progress("combine", fraction, certificate.l2_mean)

        together = push_errors(bent, problem, depths, settings.n_combined, 2, True, combined)
        rows += [{"coordinate": "combination", **vars(row)} for row in together]
    return rows


def _pace(linear: Vademecum, bent: Vademecum) -> float:
    """Return the median time of a step with large deformation over that without, all modes."""
    times = [time_steps(one, 1).p50_us for one in (linear, bent)]
    return times[1] / times[0]


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")
