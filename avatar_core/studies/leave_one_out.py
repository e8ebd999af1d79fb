"""Each real liver interpolated from the others (paper, Sec. 3.3): LLE and its rivals.

Every method yields weights that sum to one, and all are judged alike. The blended signed distances
are re-initialised near the surface, and the Dice overlap with the true liver is measured. Livers
are compared with centred volumes, and aligned to the phantom by a similarity transform. Lengths are
always those of the patient. Scans of one person are left out together. Each method may choose its
best setting: LLE among numbers of neighbors up to all, PCA among numbers of components up to all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import igl
import numpy as np

from avatar_core.common.processes import repeatable
from avatar_core.geometry.level_set import (
    DistanceGrid,
    GridBox,
    dice,
    isosurface,
    orientation_offset,
)
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.lle import Gram
from avatar_core.shapes.registration import TemplateRule, align_upright
from avatar_core.shapes.springs import sample_target
from avatar_core.shapes.weights import barycenter_weights, convex_weights
from avatar_core.studies.shapes import (
    PAPER_GRID,
    FloatArray,
    IntArray,
    Livers,
    as_grid,
    centred,
    distance_vectors,
    paper_box,
    read_livers,
)
from avatar_core.studies.study import Row, Run, Study, column, follow, label, where

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

K_PAPER = 10
NEAR = 3.0  # distances are made exact this many spacings around the blended surface
# The closest fit counts here, whichever way an organ lies: no prior holds it upright.
FREE = TemplateRule(rotation_spread=90.0)
N_TEMPLATE = 1000  # vertices of the mesh of the phantom that is aligned to the livers
ALIGNMENTS = ("centred", "similarity")


@dataclass(frozen=True)
class LeaveOneOutSettings:
    """Sizes of the study, and the settings that each method may choose from.

    n_livers : largest number of livers; None for all
    neighbors, regularizations : settings of LLE; 0 neighbors are all
    least_regularizations : further regularizations, with all neighbors only
    components : settings of PCA; 0 are as many as there are
    shape : shape of the grid
    phantoms : number that replaces a missing folder
    """

    n_livers: int | None = None
    neighbors: tuple[int, ...] = (5, 10, 20, 40, 0)
    regularizations: tuple[float, ...] = (1e-3, 1e-6)
    least_regularizations: tuple[float, ...] = (1e-9,)
    components: tuple[int, ...] = (5, 10, 20, 40, 60, 80, 100, 120, 0)
    shape: tuple[int, int, int] = PAPER_GRID
    phantoms: int = 40


@dataclass(frozen=True, eq=False)
class Base:
    """Livers on one grid.

    vectors : ndarray, shape (n, D), signed distances [m]
    scales : ndarray, shape (n,), lengths of the patient over those on the grid
    subjects : ndarray of int, shape (n,), equal for scans of one person
    notices : livers whose alignment did not converge
    """

    box: GridBox
    vectors: FloatArray
    scales: FloatArray
    subjects: IntArray
    gram: Gram
    notices: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Method:
    """A way to write liver i by some others: weights(i, others) has the shape of others.

    k : number of neighbors, or of principal components
    """

    name: str
    k: int
    regularization: float | None
    weights: Callable[[int, IntArray], FloatArray]


class LeaveOneOutStudy(Study[LeaveOneOutSettings]):
    """One row for each alignment and method."""

    name = "leave-one-out"
    full = LeaveOneOutSettings()
    quick = LeaveOneOutSettings(
        n_livers=24, neighbors=(5, 10, 0), components=(5, 10, 0), shape=(29, 21, 25), phantoms=16
    )
    paper: ClassVar = {"sdf_max_mm_k10": 4.0}

    @repeatable
    def measure(self, run: Run[LeaveOneOutSettings]) -> None:
        settings = run.settings
        livers = read_livers(run.surfaces, settings.n_livers, settings.phantoms)
        run.kept |= {"livers": len(livers.surfaces), "subjects": len(np.unique(livers.subjects))}
        run.notices += livers.notices
        for alignment in ALIGNMENTS:
            base = placed(livers, alignment, settings)
            run.notices += base.notices
            for method in follow(methods(base, settings), f"leave one out, {alignment}"):
                run.add({"alignment": alignment, **judged(base, method)})
        run.notices.append(
            "LLE with all neighbors and little regularisation is the projection on all principal "
            "components: the same affine hull"
        )

    def summary(self, run: Run[LeaveOneOutSettings]) -> dict[str, float]:
        """Return each method's best setting; for k = 10 the best regularisation and alignment."""
        lle = where(run.rows, method="LLE")
        top, ten = _best(lle), _best(where(lle, k=K_PAPER) or lle)
        summary = {
            "dice_best": top["dice"],
            "dice_best_worst": top["dice_worst"],
            "dice_k10": ten["dice"],
            "dice_k10_worst": ten["dice_worst"],
            "sdf_max_mm_k10": ten["sdf_max_mm"],
            "sdf_max_mm_k10_worst": ten["sdf_max_mm_worst"],
            "sdf_max_mm_best": top["sdf_max_mm"],
        }
        for alignment in ALIGNMENTS:
            summary[f"dice_best_{alignment}"] = _best_dice(where(lle, alignment=alignment))
        for method in ("convex LLE", "nearest neighbor", "inverse distance", "PCA"):
            found = where(run.rows, method=method)
            summary[f"dice_{method.replace(' ', '_').lower()}"] = _best_dice(found)
        return {**summary, **run.kept}

    def sentence(self, run: Run[LeaveOneOutSettings]) -> str:
        summary, best = run.summary, _best(where(run.rows, method="LLE"))
        return (
            f"{summary['livers']} livers of {summary['subjects']} persons, each written by the "
            f"others: Dice {summary['dice_best']:.3f} at best (k = {best['k']}, regularisation "
            f"{best['regularization']:g}, {best['alignment']}), {summary['dice_k10']:.3f} with "
            f"k = 10; nearest neighbor {summary['dice_nearest_neighbor']:.3f}, inverse distance "
            f"{summary['dice_inverse_distance']:.3f}, PCA {summary['dice_pca']:.3f}."
        )

    def draw(self, figure: Figure, run: Run[LeaveOneOutSettings]) -> None:
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        regularizations = sorted(set(column(where(run.rows, method="LLE"), "regularization")))
        for alignment, style in zip(ALIGNMENTS, ("--", "-"), strict=True):
            rows = where(run.rows, alignment=alignment)
            for color, r in enumerate(regularizations):
                text = f"LLE, {alignment}, r = {r:g}"
                some = where(rows, method="LLE", regularization=r)
                _draw_dice(left, some, f"{style}o", f"C{color}", text)
            _draw_dice(left, where(rows, method="PCA"), f"{style}x", "gray", f"PCA, {alignment}")
        x = "neighbors k, or principal components"
        title = "livers left out, scans of one person together"
        label(left, x, "mean Dice [-]", title, legend=7)
        names = ("nearest neighbor", "inverse distance", "convex LLE", "PCA", "LLE")
        for k, alignment in enumerate(ALIGNMENTS):
            rows = where(run.rows, alignment=alignment)
            best = [_best_dice(where(rows, method=name)) for name in names]
            right.bar(np.arange(len(names)) + 0.4 * (k - 0.5), best, 0.38, label=alignment)
        right.set_xticks(range(len(names)), [name.replace(" ", "\n") for name in names])
        right.set_ylim(bottom=0.5, top=1.0)
        right.set(ylabel="mean Dice [-], best setting", title="beside its rivals")
        right.legend(fontsize=8)


STUDY = LeaveOneOutStudy()


def placed(livers: Livers, alignment: str, settings: LeaveOneOutSettings) -> Base:
    """Return all livers on one grid, centred or laid on the phantom."""
    scales, notices = np.ones(len(livers.surfaces)), list[str]()
    if alignment == "centred":
        moved = [centred(surface) for surface in livers.surfaces]
    else:
        reference, moved = phantom_liver(), []
        template, rule = tetrahedralize(reference, N_TEMPLATE), FREE
        for i, surface in enumerate(follow(livers.surfaces, "alignment")):
            upright = _upright(surface, reference)
            target = sample_target(upright, 3 * rule.n_samples)
            found, converged = align_upright(template, target, rule)
            moved.append(replace(upright, vertices=found.back(upright.vertices)))
            scales[i] = found.scale
            if not converged:
                notices.append(f"{surface.name}: the alignment did not converge")
    box = paper_box(moved, settings.shape)
    vectors = distance_vectors(moved, box)
    return Base(box, vectors, scales, livers.subjects, Gram.of(list(vectors)), tuple(notices))


def _upright(surface: SurfaceMesh, reference: SurfaceMesh) -> SurfaceMesh:
    """Return the surface with its axes along those of the reference, if it is turned."""
    offset = orientation_offset(surface, reference)
    if not offset.is_turned:
        return surface
    return replace(surface, vertices=surface.vertices @ offset.rotation.T)


def methods(base: Base, settings: LeaveOneOutSettings) -> list[Method]:
    """Return LLE in all settings, then the rivals."""
    n = len(base.vectors)
    choices = [
        (k or n - 1, r) for k in settings.neighbors for r in settings.regularizations if k < n
    ]
    choices += [(n - 1, r) for r in settings.least_regularizations]
    found = [Method("LLE", k, r, partial(lle_weights, base.gram, k, r)) for k, r in choices]
    found.append(Method("convex LLE", n - 1, None, partial(hull_weights, base.gram)))
    found.append(Method("nearest neighbor", 1, None, partial(inverse_weights, base.gram, 1)))
    found.append(
        Method("inverse distance", K_PAPER, None, partial(inverse_weights, base.gram, K_PAPER))
    )
    found += [
        Method("PCA", d or n - 1, None, partial(principal_weights, base.gram, d or n - 1))
        for d in settings.components
        if d < n - 1
    ]
    return found


def judged(base: Base, method: Method) -> Row:
    """Return mean and worst over all livers: Dice, largest distance error inside [mm], sum |w|."""
    n = len(base.vectors)
    weights = np.zeros((n, n))
    for i in range(n):
        others = np.flatnonzero(base.subjects != base.subjects[i])
        weights[i, others] = method.weights(i, others)
    blends = weights @ base.vectors
    off = np.abs(blends - base.vectors)
    errors = 1e3 * base.scales * np.where(base.vectors < 0, off, 0.0).max(axis=1)
    scores = [overlap(*pair, base.box) for pair in zip(blends, base.vectors, strict=True)]
    sums = np.abs(weights).sum(axis=1)
    return {
        "method": method.name,
        "k": method.k,
        "regularization": method.regularization,
        "dice": float(np.mean(scores)),
        "dice_worst": float(np.min(scores)),
        "sdf_max_mm": float(errors.mean()),
        "sdf_max_mm_worst": float(errors.max()),
        "absolute_sum": float(sums.mean()),
        "absolute_sum_worst": float(sums.max()),
    }


def overlap(blend: FloatArray, target: FloatArray, box: GridBox) -> float:
    """Return the Dice overlap of a blended level set with a distance; 0 without a surface."""
    if not (blend < 0).any():
        return 0.0
    return dice(sharpened(as_grid(blend, box)), as_grid(target, box))


def sharpened(grid: DistanceGrid) -> DistanceGrid:
    """Return exact distances near the zero surface; elsewhere only the sign counts for overlap."""
    zero = isosurface(grid)
    values = grid.values.ravel().copy()
    near = np.flatnonzero(np.abs(values) < NEAR * grid.spacing)
    squared, _, _ = igl.point_mesh_squared_distance(
        np.ascontiguousarray(grid.points[near]), zero.vertices, zero.faces.astype(np.int64)
    )
    values[near] = np.copysign(np.sqrt(squared), values[near])
    return DistanceGrid(grid.origin, grid.spacing, values.reshape(grid.values.shape))


def lle_weights(gram: Gram, k: int, regularization: float, i: int, others: IntArray) -> FloatArray:
    """Return weights by Eq. 15 among the k nearest others, from the products of the whole base.

    `barycenter` computes the same from differences, a hundred times slower for many settings.
    """
    squared = gram.squared_distances(np.array([i]))[0, others]
    near = np.argsort(squared, kind="stable")[:k]
    found = np.zeros(len(others))
    found[near] = barycenter_weights(_local(gram, i, others[near]), regularization)
    return found


def hull_weights(gram: Gram, i: int, others: IntArray) -> FloatArray:
    """Return the weights of the closest point of the convex hull of all others."""
    return convex_weights(_local(gram, i, others))


def inverse_weights(gram: Gram, k: int, i: int, others: IntArray) -> FloatArray:
    """Return weights proportional to 1 / distance among the k nearest others."""
    distance = np.sqrt(gram.squared_distances(np.array([i]))[0, others])
    weights = 1.0 / np.maximum(distance, 1e-12)
    weights[np.argsort(distance, kind="stable")[k:]] = 0.0
    return weights / weights.sum()


def principal_weights(gram: Gram, n_components: int, i: int, others: IntArray) -> FloatArray:
    """Return weights of the projection on the others' first principal components, summing to one.

    The centred products are G = V L V^T, the centred products with the liver itself c. The weights
    are w = 1/n + V_d L_d^-1 V_d^T c. Components without variance do not count: n livers have at
    most n - 1 components.
    """
    products = gram.products[np.ix_(others, others)]
    mean = products.mean(axis=0)
    row = gram.products[i, others] - mean
    values, vectors = np.linalg.eigh(products - mean - mean[:, None] + mean.mean())
    with_variance = int(np.count_nonzero(values > len(values) * np.finfo(float).eps * values[-1]))
    leading = slice(len(values) - min(n_components, with_variance, len(values) - 1), None)
    part = (vectors[:, leading].T @ (row - row.mean())) / values[leading]
    return 1.0 / len(others) + vectors[:, leading] @ part


def _local(gram: Gram, i: int, near: IntArray) -> FloatArray:
    """Return C_jk = (X_j - x) . (X_k - x), shape (k, k)."""
    cross = gram.products[i, near]
    return gram.products[np.ix_(near, near)] - cross - cross[:, None] + gram.squared_lengths[i]


def _best(rows: list[Row]) -> Row:
    return rows[int(column(rows, "dice").argmax())]


def _best_dice(rows: list[Row]) -> float:
    return float(max(column(rows, "dice"), default=np.nan))


def _draw_dice(axes: Axes, rows: list[Row], style: str, colour: str, text: str) -> None:
    axes.plot(column(rows, "k"), column(rows, "dice"), style, color=colour, label=text)
