"""Organs registered to synthetic clouds, beside a rigid motion alone and thin-plate splines.

The truth is hyperelastic (:mod:`avatar_core.studies.registration_truth`), the vademecum's response
linear. Errors are those of all vertices of the true mesh, in the cloud's frame, weighted by their
volumes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import RBFInterpolator

from avatar_core.common.arrays import FloatArray
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.point_location import carriers, closest_points
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.pipeline import OrganOptions, build
from avatar_core.registration.cloud import Cloud
from avatar_core.registration.fit import rigid_motion
from avatar_core.registration.register import INTERVAL_90, register
from avatar_core.registration.rigid import RigidMotion
from avatar_core.registration.rule import RegistrationRule
from avatar_core.studies.certainty_section import CertaintySettings, Section
from avatar_core.studies.registration_others import Shown, other_rows, table_of
from avatar_core.studies.registration_truth import CLASSES, Case, RegistrationSettings, Truth
from avatar_core.studies.shapes import DEFAULT_FOLDER
from avatar_core.studies.study import Panel, ProgressBar, Row, Run, Study, column, follow
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METHODS = ("vademecum", "rigid", "splines")
_LIVER = "LiTS-4.obj"
_FINER = 1.4  # vertices of the true mesh over the vademecum's
_ERRORS = (
    "Mean error over the whole organ, beside a rigid motion and thin-plate splines, by what "
    "deformed it; dotted: 20 %."
)
_COVERAGE = "Part of the organ whose place the intervals of 90 % hold, by what deformed it."
_N_SPLINE = 400  # points that splines go through; their equations are dense


class RegistrationStudy(Study[RegistrationSettings]):
    """The phantom and, unless quick, a real liver of the folder; a row for each case."""

    name = "registration"
    full = RegistrationSettings()
    quick = RegistrationSettings(n_vertices=900, n_true=1400, n_cases=2, with_liver=False)

    def measure(self, run: Run[RegistrationSettings]) -> None:
        settings, folder = run.settings, run.surfaces or DEFAULT_FOLDER
        organs = [phantom_liver()]
        if settings.with_liver and (folder / _LIVER).is_file():
            organs.append(read_surface(folder / _LIVER))
        elif settings.with_liver:
            run.notices.append(f"no {_LIVER} in {folder}: the phantom alone")
        for organ in organs:
            options = OrganOptions(n_vertices=settings.n_vertices, n_certified=20)
            vademecum = build(organ, options)
            for row in case_rows(vademecum, Truth.of(organ, settings.n_true), settings):
                run.add(row)
            rows, run.kept["shown"] = other_rows(organ, settings)
            for row in rows:
                run.add(row)
        run.notices += table_of(_others(run.rows))
        run.notices.append(
            "the paper registers no clouds: there is no figure of its own beside ours"
        )

    def summary(self, run: Run[RegistrationSettings]) -> dict[str, float]:
        own = [row for row in run.rows if row["class"] in CLASSES]
        return summarise(own) | others_summed_up(_others(run.rows))

    def sentence(self, run: Run[RegistrationSettings]) -> str:
        settings, summary = run.settings, run.summary
        return (
            f"A vademecum registered to {settings.seen:.0%} of the surface, {settings.n_points} "
            f"points of {1e3 * settings.noise:g} mm noise: {summary['registration_error']:.0%} of "
            f"the mean displacement off ({summary['registration_rigid_error']:.0%} rigidly, "
            f"{summary['registration_splines_error']:.0%} by splines), 90 % intervals hold "
            f"{summary['registration_coverage']:.0%}, in "
            f"{summary['registration_seconds']:.2f} s. Point forces, a fifth of the surface seen: "
            f"{summary['point_force_error']:.0%}, or {summary['point_force_error_zone_known']:.0%} "
            f"if frame and zone of the forces are known (full finite elements: "
            f"{summary['point_force_error_full_elements']:.0%})"
        )

    def draw(self, figure: Figure, run: Run[RegistrationSettings]) -> None:
        left, middle, right = figure.subplots(1, 3, width_ratios=(3, 2, 2))
        draw_errors(left, run.rows)
        draw_coverage(middle, run.rows)
        draw_determined(right, run.kept["shown"])


STUDY = RegistrationStudy()


def registration_section(
    surface: SurfaceMesh, settings: CertaintySettings, bar: ProgressBar
) -> Section:
    """Register a vademecum to deformations of another mesh."""
    sizes = RegistrationSettings(
        n_vertices=settings.n_vertices,
        n_true=int(_FINER * settings.n_vertices),
        n_cases=settings.n_registrations,
    )
    options = OrganOptions(n_vertices=sizes.n_vertices, n_certified=20)
    vademecum = build(surface, options, bar.begin("registration"))
    rows = case_rows(vademecum, Truth.of(surface, sizes.n_true), sizes)
    summary = summarise(rows)
    return Section(
        name="registration",
        sentence=(
            f"Registered to {sizes.seen:.0%} of a hyperelastic surface with 1 mm noise: "
            f"{summary['registration_error']:.0%} of the mean displacement off "
            f"({summary['registration_rigid_error']:.0%} rigidly), 90 % intervals hold "
            f"{summary['registration_coverage']:.0%}."
        ),
        summary=summary,
        rows=tuple(rows),
        panels=(
            Panel(_ERRORS, partial(draw_errors, rows=rows)),
            Panel(_COVERAGE, partial(draw_coverage, rows=rows)),
        ),
    )


def case_rows(vademecum: Vademecum, truth: Truth, settings: RegistrationSettings) -> list[Row]:
    """Return all cases of one vademecum and the true mesh of its organ."""
    rows = []
    for kind in CLASSES:
        rng = np.random.default_rng(CLASSES.index(kind))
        for _ in follow(range(settings.n_cases), f"{vademecum.name}, {kind}"):
            case = truth.case(kind, settings, rng)
            rows.append({"organ": vademecum.name, "class": kind, **measured(vademecum, case)})
    return rows


def summarise(rows: Sequence[Row]) -> dict[str, float]:
    """Return means over the cases, all and of each class.

    ``registration_seconds`` is the median.
    """

    def mean(key: str, kind: str | None = None) -> float:
        return float(column(_of(rows, kind), key).mean())

    summary = {
        "registration_error": mean("vademecum_error"),
        "registration_coverage": mean("coverage"),
        "registration_seconds": float(np.median(column(rows, "seconds"))),
        "registration_of_peak": mean("vademecum_of_peak"),
        "registration_worst": float(column(rows, "vademecum_error").max()),
        "registration_explained": mean("explained"),
        "registration_small_strains_off": mean("small_strains_off"),
        "registration_rigid_error": mean("rigid_error"),
        "registration_splines_error": mean("splines_error"),
    }
    for kind in CLASSES:
        name = kind.replace(" ", "_")
        summary[f"registration_error_{name}"] = mean("vademecum_error", kind)
        summary[f"registration_coverage_{name}"] = mean("coverage", kind)
    return summary


def _others(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["class"] not in CLASSES]


def draw_determined(axes: Axes, shown: Shown) -> None:
    """Draw half of the 90 % interval over the organ, from the front, and the cloud."""
    x, _, z = 1e3 * shown.place.T
    drawn = axes.scatter(x, z, c=1e3 * shown.interval, s=9, cmap="viridis", vmin=0.0)
    axes.plot(*(1e3 * shown.cloud[::20, [0, 2]].T), "k.", markersize=1.5, label="cloud")
    axes.figure.colorbar(drawn, ax=axes, label="half-width of the 90 % interval [mm]")
    axes.set_aspect("equal")
    axes.invert_xaxis()  # seen from the front: the patient's right on the left
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("z [mm]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.3), fontsize=8)
    axes.set_title("after one force at an unknown place", fontsize=9)


def others_summed_up(rows: Sequence[Row]) -> dict[str, float]:
    """Return the mean errors of point forces by prior, of packing, and of a pneumoperitoneum."""

    def mean(kind: str, prior: str, key: str = "error") -> float:
        some = [r for r in rows if str(r["class"]).startswith(kind) and r["prior"] == prior]
        return float(np.mean([float(r[key]) for r in some if key in r]))  # type: ignore[arg-type]

    return {
        "point_force_error": mean("point", "nothing said"),
        "point_force_error_frame_known": mean("point", "frame known"),
        "point_force_error_zone_known": mean("point", "frame and zone known"),
        "point_force_error_full_elements": mean("point", "rival: full elements, zone known"),
        "point_force_coverage_unseen": mean("point", "nothing said", "coverage_unseen"),
        "packing_error": mean("packing", "nothing said"),
        "pneumoperitoneum_error": mean("pneumo", "pressure, shift 30 mm"),
    }


def measured(vademecum: Vademecum, case: Case) -> Row:
    """Return the errors of all methods, over the mean and the largest true displacement."""
    size = np.linalg.norm(case.displacement, axis=1)
    mean, peak = float(case.volume @ size), float(size.max())
    start = time.process_time()
    found = register(vademecum, case.cloud)
    seconds = time.process_time() - start
    corners, weights = carriers(vademecum.mesh, case.rest)

    def carried(values: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nk,nkd->nd", weights, values[corners]))

    rigid = rigid_motion(vademecum, case.cloud, RegistrationRule(rigid_steps=40))
    places = {
        "vademecum": carried(found.place),
        "rigid": rigid(case.rest),
        "splines": splines(vademecum, case.cloud, rigid)(case.rest),
    }
    small = case.volume @ np.linalg.norm(case.small_strains - case.displacement, axis=1)
    row: Row = {"mean_mm": 1e3 * mean, "peak_mm": 1e3 * peak}
    row |= {"small_strains_off": float(small) / mean}
    for name, place in places.items():
        error = float(case.volume @ np.linalg.norm(place - case.place, axis=1))
        row |= {f"{name}_error": error / mean, f"{name}_of_peak": error / peak}
    off = np.abs(places["vademecum"] - case.place)
    within = off <= INTERVAL_90 * carried(found.place_deviation)
    return row | {
        "coverage": float(case.volume @ within.mean(axis=1)),
        "residual_mm": 1e3 * found.rms,
        "explained": not found.problems,
        "seconds": seconds,
    }


def splines(
    vademecum: Vademecum, cloud: Cloud, rigid: RigidMotion
) -> Callable[[FloatArray], FloatArray]:
    """Return thin-plate splines as a map of the organ at rest.

    They lead from feet on the rigidly moved organ to the cloud. Their smoothing is the one that
    best predicts every other point.
    """
    mesh = vademecum.mesh
    points = rigid.back(cloud.thinned()[:: max(1, len(cloud.thinned()) // _N_SPLINE)])
    feet, _, _ = closest_points(mesh.vertices, mesh.boundary_faces, points)
    feet, first = np.unique(feet.round(9), axis=0, return_index=True)
    moved = points[first] - feet

    def spline(some: slice, smoothing: float) -> RBFInterpolator:
        return RBFInterpolator(feet[some], moved[some], smoothing=smoothing)

    def missed(smoothing: float) -> float:
        predicted = spline(slice(0, None, 2), smoothing)(feet[1::2])
        return float(((predicted - moved[1::2]) ** 2).sum())

    best = spline(slice(None), min(_SMOOTHINGS, key=missed))
    return lambda rest: rigid(rest + best(rest))


_SMOOTHINGS = (1e-5, 1e-4, 1e-3, 1e-2)


def draw_errors(axes: Axes, rows: Sequence[Row]) -> None:
    """Draw mean error over mean displacement, for each class and method."""
    for k, name in enumerate(METHODS):
        error = [100.0 * value for value in _by_class(rows, f"{name}_error")]
        axes.bar(np.arange(len(CLASSES)) + 0.27 * (k - 1), error, 0.25, label=name)
    axes.axhline(20.0, color="grey", linestyle=":")
    axes.set_ylabel("mean error over mean displacement [%]")
    axes.legend()
    _name_classes(axes)


def draw_coverage(axes: Axes, rows: Sequence[Row]) -> None:
    """Draw the fraction of vertices within their 90 % intervals, for each class."""
    coverage = [100.0 * value for value in _by_class(rows, "coverage")]
    axes.bar(np.arange(len(CLASSES)), coverage, 0.6, color="grey")
    axes.axhline(90.0, color="black", linestyle=":")
    axes.set_ylabel("held by 90 % intervals [%]")
    _name_classes(axes)


def _by_class(rows: Sequence[Row], key: str) -> list[float]:
    """Return the means of each class."""
    return [float(column(_of(rows, kind), key).mean()) for kind in CLASSES]


def _of(rows: Sequence[Row], kind: str | None) -> Sequence[Row]:
    """Return the rows of a class; None for all."""
    return rows if kind is None else [row for row in rows if row["class"] == kind]


def _name_classes(axes: Axes) -> None:
    names = [kind.replace(" ", "\n") for kind in CLASSES]
    axes.set_xticks(np.arange(len(CLASSES)), names, fontsize=7)
