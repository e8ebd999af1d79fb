"""Calibration against forces of full finite elements on another mesh.

A small organ with a tumour, held by its bare area on springs, is built once over the tumour's
contrast and the support's stiffness. The truth of each trial is the same anatomy on a finer mesh,
at drawn values. Its forces at the touches get the noise of a sensor, and the calibration has to
find the values. A model without the tumour is also fitted to each trial; its fit must be rejected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray, IntArray, farthest_points
from avatar_core.contact.error_map import force_error_at
from avatar_core.contact.tool_path import inner_positions
from avatar_core.fem.elasticity import Elasticity, Inclusion
from avatar_core.fem.patch_loads import patch_loads, patch_normals
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.geometry.tumour import volume_fraction_inside
from avatar_core.offline.supports import SupportOption, held_by
from avatar_core.pipeline import OrganOptions, build
from avatar_core.reduction.coordinates import Coordinate, problem_at
from avatar_core.studies.certainty_section import CertaintySettings, Section
from avatar_core.studies.study import Panel, ProgressBar, Row, column, follow
from avatar_core.uncertainty.calibration import TouchErrors, TouchTable, calibrated, touch_table
from avatar_core.uncertainty.distributions import Distribution, Fixed
from avatar_core.uncertainty.known import priors_of
from avatar_core.uncertainty.palpation import Palpation
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUPPORTED = "support.bare_area"
CONTRAST = Coordinate("contrast", 0.7, 30.0)
STIFFNESS = (5e5, 2e8)  # range of the support at the vademecum's Young's modulus [N/m^3]
TRUE_YOUNG, TRUE_CONTRAST, TRUE_STIFFNESS = (3e3, 12e3), (2.0, 12.0), (2e6, 2e7)
N_TOUCHES, N_AT_TUMOUR = 20, 8  # touches of a trial, and those over the tumour
POOL, POOL_AT_TUMOUR = 60, 20  # places that trials draw from, away from the tumour and over it
APART = 4e-3  # places over the tumour, at least [m]
WELL_KNOWN = 0.05  # largest force error of a touch, which nine in ten keep
NOISE = 0.02  # relative noise of a measured force
DEPTHS = (2e-3, 4e-3, 6e-3)  # [m]
TIP = Tip("patch", 8e-3)
ERRORS = TouchErrors(sensor=NOISE, least=1e-6, depth=0.1e-3)  # poses and surface are exact here
_ABOVE, _STEP = 2e-3, 1e-3  # where a touch begins, and between its points [m]
_SHRUNK, _BELOW = 0.35, 28e-3  # the tumour: of the organ's size, its middle below the surface [m]
_N_TRUE_VERTICES = 5000


@dataclass(frozen=True, eq=False)
class Truth:
    """The anatomy on its own mesh, and the unit loads of the touches there.

    loads : sparse, shape (3 n_nodes, 3 n_touches)
    normals : ndarray, shape (n_touches, 3)
    """

    problem: Elasticity
    loads: sp.csr_matrix
    normals: FloatArray

    def stiffness(self, values: Mapping[str, float]) -> FloatArray:
        """Return force over depth of the patch at every touch, shape (n_touches,) [N/m]."""
        stiffer = values["young"] / self.problem.material.young_modulus
        point = {"contrast": values["contrast"], SUPPORTED: values[SUPPORTED] / stiffer}
        solution = problem_at(self.problem, point).solve(self.loads)
        compliance = np.asarray(self.loads.T @ solution)
        own = [compliance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(len(self.normals))]
        found = [1.0 / (n @ block @ n) for n, block in zip(self.normals, own, strict=True)]
        return stiffer * np.array(found)


def calibration_section(
    surface: SurfaceMesh, settings: CertaintySettings, bar: ProgressBar
) -> Section:
    """Calibrate a small organ, whatever the liver of the study: each trial is a solution."""
    outline = phantom_liver()
    tumour = _tumour(outline)
    vademecum = _build(outline, tumour, settings.n_vertices, bar)
    positions = _places(vademecum, tumour)
    truth = _truth(outline, tumour, vademecum, positions)
    path = _path(vademecum, positions)
    bar.begin("calibrations")
    table = touch_table(vademecum, TIP, path)
    depth = _depths(outline, table)
    rows = _trials(table, priors_of(vademecum), truth, depth, settings.n_trials)
    summary = _summary(rows)
    return Section(
        name="calibration",
        sentence=_sentence(summary, settings.n_trials),
        summary=summary,
        rows=tuple(rows),
        panels=(Panel(_FOUND, partial(_draw, rows=rows)),),
        notices=(
            f"calibration: of the phantom with a tumour, {len(vademecum.mesh.vertices)} vertices, "
            f"by forces of a mesh of {len(truth.problem.mesh.vertices)}",
        ),
    )


_FOUND = (
    "Found over true values of Young's modulus, the tumour's contrast and the stiffness of the "
    "support, with intervals of 90 %, from forces of another mesh with the noise of a sensor."
)


def _tumour(outline: SurfaceMesh) -> SurfaceMesh:
    """Return a tumour below the middle of the front, which faces along y."""
    middle = outline.vertices.mean(axis=0)
    off = outline.vertices - middle
    front = outline.vertices[np.argmin(np.hypot(off[:, 0], off[:, 2]) - off[:, 1])]
    place = front - np.array([0.0, _BELOW, 0.0])
    return SurfaceMesh(place + _SHRUNK * off, outline.faces, "tumour in the phantom")


def _build(outline: SurfaceMesh, tumour: SurfaceMesh, n: int, bar: ProgressBar) -> Vademecum:
    low, high = STIFFNESS
    options = OrganOptions(
        n_vertices=n,
        coordinates=(CONTRAST,),
        tumour=tumour,
        supports=(SupportOption.parse(f"bare_area={low:g}:{high:g}"),),
        n_certified=48,
    )
    return build(outline, options, bar.begin("calibration"))


def _places(vademecum: Vademecum, tumour: SurfaceMesh) -> IntArray:
    """Return load positions: ``POOL_AT_TUMOUR`` over the tumour, then ``POOL`` far apart."""
    centers, inner = vademecum.surface.centers, _well_known(vademecum)
    near = _nearness(vademecum, tumour, inner)
    over = vademecum.surface.largest_apart(near, POOL_AT_TUMOUR, APART)
    others = np.setdiff1d(inner, over)
    return np.r_[over, others[farthest_points(centers[others], POOL)]]


def _nearness(vademecum: Vademecum, tumour: SurfaceMesh, among: IntArray) -> FloatArray:
    """Return one over the distance from the tumour's middle; zero at positions not asked for."""
    centers = vademecum.surface.centers
    found = np.zeros(len(centers))
    found[among] = 1.0 / np.linalg.norm(centers[among] - tumour.vertices.mean(axis=0), axis=1)
    return found


def _well_known(vademecum: Vademecum) -> IntArray:
    """Return the inner positions where the vademecum's own force error is small."""
    inner = inner_positions(vademecum)
    error = force_error_at(vademecum, vademecum.surface.centers[inner])
    kept: IntArray = inner[error < WELL_KNOWN]
    return kept


def _truth(
    outline: SurfaceMesh, tumour: SurfaceMesh, vademecum: Vademecum, positions: IntArray
) -> Truth:
    mesh = tetrahedralize(outline, _N_TRUE_VERTICES)
    regions, supports = held_by(mesh, [SupportOption("bare_area", TRUE_STIFFNESS[0])])
    inclusion = Inclusion(volume_fraction_inside(mesh, tumour), 1.0)
    material = vademecum.material
    problem = Elasticity(mesh, material, regions.clamped, "P2", inclusion, supports=supports)
    centers, radius = vademecum.surface.centers[positions], vademecum.surface.patch_radius
    return Truth(
        problem, patch_loads(problem, centers, radius), patch_normals(mesh, centers, radius)
    )


def _path(vademecum: Vademecum, positions: IntArray) -> Palpation:
    """Return the path of all touches; each trial adds its forces."""
    depth = np.arange(-_ABOVE, DEPTHS[-1] + _STEP / 2.0, _STEP)
    sampled = np.isclose(depth[:, None], DEPTHS).any(axis=1)
    surface = vademecum.surface
    tip = (
        surface.centers[positions, None]
        + (TIP.offset - depth)[:, None] * surface.normals[positions, None]
    )
    force = np.where(sampled, 1.0, np.nan)
    n = len(positions)
    return Palpation(tip.reshape(-1, 3), np.repeat(np.arange(n), len(depth)), np.tile(force, n))


def _depths(outline: SurfaceMesh, table: TouchTable) -> FloatArray:
    """Return the patch's depth below the surface, which no mesh places exactly, (n, 3) [m]."""
    path = table.palpation
    off = outline.skin.signed_distance(path.tip[path.sampled])
    return np.asarray(TIP.offset - off).reshape(-1, len(DEPTHS))


def _trials(
    table: TouchTable, known: Mapping[str, Distribution], truth: Truth, depth: FloatArray, n: int
) -> list[Row]:
    rng, rows = np.random.default_rng(4), []
    without = {**known, "contrast": Fixed(1.0)}
    reference = truth.problem.material.young_modulus
    for _ in follow(range(n), "trials"):
        young, contrast, stiffness = (
            float(np.exp(rng.uniform(*np.log(ends))))
            for ends in (TRUE_YOUNG, TRUE_CONTRAST, TRUE_STIFFNESS)
        )
        values = {"young": young, "contrast": contrast, SUPPORTED: stiffness * young / reference}
        chosen = _touches(rng)
        force = truth.stiffness(values)[chosen, None] * depth[chosen]
        measured = _measured(table.where(chosen), force, rng)
        found = calibrated(measured, known, ERRORS)
        row: Row = {"explained": found.explained, "probability": found.probability}
        for name, value in values.items():
            low, high = found.interval(name)
            row |= {f"{name}_true": value, f"{name}_found": found.value(name)}
            row |= {f"{name}_low": low, f"{name}_high": high}
        row["noticed"] = not calibrated(measured, without, ERRORS).explained
        rows.append(row)
    return rows


def _touches(rng: np.random.Generator) -> np.ndarray:
    """Return a trial's touches, a mask of all places (n,).

    They are drawn anew, as each place has its own error.
    """
    chosen = np.zeros(POOL_AT_TUMOUR + POOL, bool)
    chosen[rng.permutation(POOL_AT_TUMOUR)[:N_AT_TUMOUR]] = True
    chosen[POOL_AT_TUMOUR + rng.permutation(POOL)[: N_TOUCHES - N_AT_TUMOUR]] = True
    return chosen


def _measured(table: TouchTable, force: FloatArray, rng: np.random.Generator) -> TouchTable:
    """Return the table with a truth's forces, (n_touches, n_depths), and a sensor's noise."""
    path = table.palpation
    noisy = path.force.copy()
    noisy[path.sampled] = force.ravel() * (1.0 + NOISE * rng.standard_normal(force.size))
    return replace(table, palpation=replace(path, force=noisy))


_NAMES = ("young", "contrast", SUPPORTED)


def _summary(rows: Sequence[Row]) -> dict[str, float]:
    columns = {key: column(rows, key) for key in rows[0]}
    ratio = {name: columns[f"{name}_found"] / columns[f"{name}_true"] for name in _NAMES}
    held = [
        (columns[f"{name}_low"] <= columns[f"{name}_true"])
        & (columns[f"{name}_true"] <= columns[f"{name}_high"])
        for name in _NAMES
    ]
    return {
        "young_error": float(np.quantile(np.abs(ratio["young"] - 1.0), 0.5)),
        "young_error90": float(np.quantile(np.abs(ratio["young"] - 1.0), 0.9)),
        "contrast_error": float(np.quantile(np.abs(ratio["contrast"] - 1.0), 0.5)),
        "contrast_error90": float(np.quantile(np.abs(ratio["contrast"] - 1.0), 0.9)),
        "support_factor": float(np.exp(np.quantile(np.abs(np.log(ratio[SUPPORTED])), 0.5))),
        "support_factor90": float(np.exp(np.quantile(np.abs(np.log(ratio[SUPPORTED])), 0.9))),
        "calibration_coverage": float(np.mean(held)),
        "calibration_least_coverage": float(min(one.mean() for one in held)),
        "calibration_tumour_seen": float((columns["contrast_low"] > 1.0).mean()),
        "calibration_explained": float(columns["explained"].mean()),
        "calibration_wrong_noticed": float(columns["noticed"].mean()),
    }


def _sentence(summary: Mapping[str, float], n: int) -> str:
    return (
        f"From {N_TOUCHES} touches on another mesh, with {NOISE:.0%} of noise, Young's modulus is "
        f"found within {summary['young_error']:.1%} in the median of {n} trials, the contrast "
        f"within {summary['contrast_error']:.0%}, the support's stiffness within a factor of "
        f"{summary['support_factor']:.2f}; intervals of 90 % hold the truth in "
        f"{summary['calibration_coverage']:.0%}. That the tumour is harder is seen in "
        f"{summary['calibration_tumour_seen']:.0%}; of a model without it, the check of the fit "
        f"notices that in {summary['calibration_wrong_noticed']:.0%}."
    )


def _draw(axes: Axes, rows: Sequence[Row]) -> None:
    for k, name in enumerate(_NAMES):
        true, found, low, high = (
            column(rows, f"{name}_{which}") for which in ("true", "found", "low", "high")
        )
        order = np.argsort(true)
        at = k + np.linspace(-0.4, 0.4, len(rows))
        axes.vlines(at, (low / true)[order], (high / true)[order], color=f"C{k}", alpha=0.4)
        axes.plot(at, (found / true)[order], ".", color=f"C{k}", label=name)
    axes.axhline(1.0, color="grey", linewidth=1.0)
    axes.set(yscale="log", ylabel="found over true value")
    axes.set_xticks(range(len(_NAMES)), ["Young's modulus", "contrast", "support"])
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    axes.set_xlabel("each parameter's trials, by their true values")
    axes.grid(axis="y", alpha=0.3)
