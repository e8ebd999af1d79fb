"""Error against the number of anatomies (paper, Fig. 7), and time of LLE beside scikit-learn.

A liver that is not in the base is interpolated from its twelve nearest of n livers of Eq. 17, n
from 12 to 500. The error is that of the distance field within the organ. Times are from vectors of
49,321 distances in memory to weights and embedding. Both programs use one thread for linear
algebra.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.common.processes import repeatable
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.shapes.lle import LLE
from avatar_core.shapes.weights import barycenter
from avatar_core.studies.shapes import PAPER_GRID, distance_vectors, paper_box
from avatar_core.studies.study import Row, Run, Study, column, follow, label, mean_and_worst, where

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NEIGHBORS = 12
DIMENSION = 6
TIMED_REGULARIZATION = 1e-3  # scikit-learn's default: both programs do the same
NAN = math.nan


@dataclass(frozen=True)
class SamplesSettings:
    """Sizes of the base, number of targets, grid, phantom, repetitions of each timing."""

    sizes: tuple[int, ...] = (12, 25, 50, 100, 200, 350, 500)
    n_targets: int = 20
    shape: tuple[int, int, int] = PAPER_GRID
    phantom_spacing: float = 7e-3
    repeats: int = 5
    seed: int = 0


@dataclass(frozen=True)
class Timing:
    """Shortest of several runs [s] on n vectors; NaN without scikit-learn.

    weights_difference : largest difference of a weight from scikit-learn's
    """

    n_samples: int
    seconds: float
    sklearn_seconds: float
    weights_difference: float


class SamplesStudy(Study[SamplesSettings]):
    """Errors for each size of the base, then times for the largest; the livers are generated."""

    name = "samples"
    full = SamplesSettings()
    quick = SamplesSettings(sizes=(12, 50, 150, 500), n_targets=5, phantom_spacing=12e-3, repeats=2)
    paper: ClassVar = {"lle_seconds_500": 1.4}

    @repeatable
    def measure(self, run: Run[SamplesSettings]) -> None:
        settings, largest = run.settings, run.settings.sizes[-1]
        organ = phantom_liver(settings.phantom_spacing)
        maps = population(largest + settings.n_targets, settings.seed)
        moved = [shape.moved(organ) for shape in maps]
        vectors = distance_vectors(moved, paper_box(moved, settings.shape))
        base, targets = vectors[:largest], vectors[largest:]
        for n in follow(settings.sizes, "errors"):
            run.add(error_row(base[:n], targets))
        timing = time_lle(base, settings.repeats)
        run.add({"kind": "time", **vars(timing)})
        if math.isnan(timing.sklearn_seconds):
            run.notices.append("scikit-learn is not installed: no times beside ours")
        run.notices.append("the paper's Fig. 7 prints no numbers: the error falls monotonically")

    def summary(self, run: Run[SamplesSettings]) -> dict[str, float]:
        """Return the errors at the ends, the rate p of error ~ n^-p, and the times."""
        (timing,), rows = where(run.rows, kind="time"), where(run.rows, kind="error")
        n, error, worst = (column(rows, key) for key in ("n_samples", "error", "error_worst"))
        summary: dict[str, float] = {}
        for k in (0, -1):
            summary[f"error_{n[k]:.0f}"] = float(error[k])
            summary[f"error_{n[k]:.0f}_worst"] = float(worst[k])
        ours, theirs, off = (
            float(timing[key])  # type: ignore[arg-type]
            for key in ("seconds", "sklearn_seconds", "weights_difference")
        )
        return {
            **summary,
            "rate": float(-np.polyfit(np.log(n), np.log(error), 1)[0]),
            f"lle_seconds_{timing['n_samples']}": ours,
            f"sklearn_seconds_{timing['n_samples']}": theirs,
            "sklearn_ratio": theirs / ours,
            "weights_difference": off,
        }

    def sentence(self, run: Run[SamplesSettings]) -> str:
        summary, n = run.summary, run.settings.sizes[-1]
        return (
            f"The error of a liver written by 12 of n livers falls like n^-{summary['rate']:.2f}, "
            f"to {summary[f'error_{n}']:.2%} of the distance field at n = {n}; LLE takes "
            f"{summary[f'lle_seconds_{n}']:.2f} s there (paper 1.4 s), scikit-learn "
            f"{summary['sklearn_ratio']:.1f} times as long, one BLAS thread each."
        )

    def draw(self, figure: Figure, run: Run[SamplesSettings]) -> None:
        left, right = figure.subplots(1, 2, width_ratios=(2, 1))
        rows, n = where(run.rows, kind="error"), run.settings.sizes[-1]
        for key, text, style in (
            ("nearest", "nearest neighbor", "s:"),
            ("error", f"LLE, k = {NEIGHBORS}, mean of all targets", "o-"),
            ("error_worst", "the same, worst target", "^--"),
            ("error_first", "the same, one liver (as in the paper)", "x-"),
            ("all", "LLE, k = n (at most 100)", "d-."),
        ):
            left.loglog(column(rows, "n_samples"), 100 * column(rows, key), style, label=text)
        label(
            left,
            "livers in the base",
            "relative L2 error of the distance field [%]",
            "convergence with the number of samples (paper, Fig. 7)",
        )
        seconds = [run.summary[f"{name}_seconds_{n}"] for name in ("lle", "sklearn")]
        bars = dict(zip(("here", "scikit-learn", "paper"), (*seconds, 1.4), strict=True))
        shown = {text: value for text, value in bars.items() if not math.isnan(value)}
        right.bar(list(shown), list(shown.values()), color=["crimson", "steelblue", "gray"])
        right.set(ylabel="time [s]", title=f"LLE of {n} livers, one BLAS thread")


STUDY = SamplesStudy()


def error_row(base: FloatArray, targets: FloatArray) -> Row:
    """Return errors of the twelve nearest, of the nearest alone, and of LLE among all."""
    errors = {"error": NEIGHBORS, "nearest": 1, "all": min(len(base), 100)}
    row: Row = {"kind": "error", "n_samples": len(base)}
    for key, k in errors.items():
        found = [_field_error(base, target, k) for target in targets]
        row.update(mean_and_worst(key, found))
        row[f"{key}_first"] = found[0]
    return row


def _field_error(base: FloatArray, target: FloatArray, k: int) -> float:
    """Return |phi - sum_j w_j phi_j| / |phi| in L2 over the grid points inside the organ."""
    inside = target < 0
    found = barycenter(base, target, k).combine(base)
    return float(np.linalg.norm((found - target)[inside]) / np.linalg.norm(target[inside]))


def time_lle(vectors: FloatArray, repeats: int) -> Timing:
    """Time weights and embedding of all vectors, ours and scikit-learn's in turn."""

    def ours() -> LLE:
        base = LLE(NEIGHBORS, DIMENSION, regularization=TIMED_REGULARIZATION).fit(vectors)
        _ = base.embedding_  # which is timed too
        return base

    theirs = _sklearn(vectors)
    best, best_theirs = math.inf, math.inf
    for _ in follow(range(repeats), "times"):
        best = min(best, _seconds(ours))
        if theirs is not None:
            best_theirs = min(best_theirs, _seconds(theirs))
    if theirs is None:
        return Timing(len(vectors), best, NAN, NAN)
    return Timing(len(vectors), best, best_theirs, _weights_difference(ours(), vectors))


def _sklearn(vectors: FloatArray) -> Callable[[], object] | None:
    try:
        from sklearn.manifold import LocallyLinearEmbedding
    except ImportError:
        return None

    def embedded() -> object:
        return LocallyLinearEmbedding(
            n_neighbors=NEIGHBORS, n_components=DIMENSION, reg=TIMED_REGULARIZATION, random_state=0
        ).fit(vectors)

    return embedded


def _weights_difference(ours: LLE, vectors: FloatArray) -> float:
    from sklearn.manifold._locally_linear import barycenter_kneighbors_graph

    theirs = barycenter_kneighbors_graph(vectors, NEIGHBORS, reg=TIMED_REGULARIZATION)
    return float(np.abs(ours.weight_matrix - theirs.toarray()).max())


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start
