"""Error against the number of anatomies (paper, Fig. 7), and time of LLE beside scikit-learn.

A liver that is not in the base is interpolated from its twelve nearest of n livers of Eq. 17, n
from 12 to 500; the error is that of the distance field within the organ. Times are from vectors of
49,321 distances in memory to weights and embedding, with one thread for linear algebra in both
programs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.processes import repeatable
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.shapes.barycenter import barycenter
from avatar_core.shapes.lle import LLE, locally_linear_embedding
from avatar_core.studies.shapes import PAPER_GRID, distance_vectors, paper_box
from avatar_core.studies.study import Study, Value, follow, mean_and_worst

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

NEIGHBORS = 12
DIMENSION = 6
TIMED_REGULARIZATION = 1e-3  # scikit-learn's default: both programs do the same
PAPER: dict[str, Value] = {"lle_seconds_500": 1.4}
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


FULL = SamplesSettings()
QUICK = SamplesSettings(sizes=(12, 50, 150, 500), n_targets=5, phantom_spacing=12e-3, repeats=2)


@dataclass(frozen=True)
class Timing:
    """Shortest of several runs [s] on n vectors; NaN without scikit-learn.

    weights_difference : largest difference of a weight from scikit-learn's
    """

    n_samples: int
    seconds: float
    sklearn_seconds: float
    weights_difference: float


def run(surfaces: Path | None, quick: bool, _folder: Path) -> Study:
    """The study; the livers are generated, a folder of surfaces is not used."""
    return study(QUICK if quick else FULL)


@repeatable
def study(settings: SamplesSettings) -> Study:
    """Errors for each size of the base, then times for the largest."""
    organ = phantom_liver(settings.phantom_spacing)
    maps = population(settings.sizes[-1] + settings.n_targets, settings.seed)
    moved = [shape.moved(organ) for shape in maps]
    vectors = distance_vectors(moved, paper_box(moved, settings.shape))
    base, targets = vectors[: settings.sizes[-1]], vectors[settings.sizes[-1] :]
    rows = [error_row(base[:n], targets) for n in follow(settings.sizes, "errors")]
    timing = time_lle(base, settings.repeats)
    summary = _summary(rows, timing)
    notices: tuple[str, ...] = ()
    if math.isnan(timing.sklearn_seconds):
        notices = ("scikit-learn is not installed: no times beside ours",)
    return Study(
        name="samples",
        sentence=_sentence(summary, settings.sizes[-1]),
        summary=summary,
        rows=(*rows, {"kind": "time", **vars(timing)}),
        paper=PAPER,
        draw=lambda figure: _draw(figure, rows, timing),
        notices=(*notices, "the paper's Fig. 7 prints no numbers: the error falls monotonically"),
    )


def error_row(base: FloatArray, targets: FloatArray) -> dict[str, Value]:
    """Error of the twelve nearest, of the nearest alone, and of LLE among all."""
    errors = {"error": NEIGHBORS, "nearest": 1, "all": min(len(base), 100)}
    row: dict[str, Value] = {"kind": "error", "n_samples": len(base)}
    for key, k in errors.items():
        found = [_field_error(base, target, k) for target in targets]
        row.update(mean_and_worst(key, found))
        row[f"{key}_first"] = found[0]
    return row


def _field_error(base: FloatArray, target: FloatArray, k: int) -> float:
    """|phi - sum_j w_j phi_j| / |phi| in L2 over the grid points inside the organ."""
    inside = target < 0
    found = barycenter(base, target, k).combine(base)
    return float(np.linalg.norm((found - target)[inside]) / np.linalg.norm(target[inside]))


def time_lle(vectors: FloatArray, repeats: int) -> Timing:
    """Weights and embedding of all vectors, ours and scikit-learn's in turn."""

    def ours() -> LLE:
        base, _ = locally_linear_embedding(
            vectors, NEIGHBORS, DIMENSION, regularization=TIMED_REGULARIZATION
        )
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


def _summary(rows: list[dict[str, Value]], timing: Timing) -> dict[str, float]:
    """Errors at the ends, the rate p of error ~ n^-p, and the times."""
    n = np.array([row["n_samples"] for row in rows], float)
    error = np.array([row["error"] for row in rows], float)
    summary: dict[str, float] = {}
    for row in (rows[0], rows[-1]):
        size = row["n_samples"]
        summary[f"error_{size}"] = float(row["error"])  # type: ignore[arg-type]
        summary[f"error_{size}_worst"] = float(row["error_worst"])  # type: ignore[arg-type]
    return {
        **summary,
        "rate": float(-np.polyfit(np.log(n), np.log(error), 1)[0]),
        f"lle_seconds_{timing.n_samples}": timing.seconds,
        f"sklearn_seconds_{timing.n_samples}": timing.sklearn_seconds,
        "sklearn_ratio": timing.sklearn_seconds / timing.seconds,
        "weights_difference": timing.weights_difference,
    }


def _sentence(summary: dict[str, float], n: int) -> str:
    return (
        f"The error of a liver written by 12 of n livers falls like n^-{summary['rate']:.2f}, to "
        f"{summary[f'error_{n}']:.2%} of the distance field at n = {n}; LLE takes "
        f"{summary[f'lle_seconds_{n}']:.2f} s there (paper 1.4 s), scikit-learn "
        f"{summary['sklearn_ratio']:.1f} times as long, one BLAS thread each."
    )


def _draw(figure: Figure, rows: list[dict[str, Value]], timing: Timing) -> None:
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    n = [row["n_samples"] for row in rows]
    for key, text, style in (
        ("nearest", "nearest neighbour", "s:"),
        ("error", f"LLE, k = {NEIGHBORS}, mean of all targets", "o-"),
        ("error_worst", "the same, worst target", "^--"),
        ("error_first", "the same, one liver (as in the paper)", "x-"),
        ("all", "LLE, k = n (at most 100)", "d-."),
    ):
        left.loglog(n, [100 * float(row[key]) for row in rows], style, label=text)  # type: ignore[arg-type]
    left.set(xlabel="livers in the base", ylabel="relative L2 error of the distance field [%]")
    left.set_title("convergence with the number of samples (paper, Fig. 7)")
    left.grid(which="both", alpha=0.3)
    left.legend(fontsize=8)
    bars = {"here": timing.seconds, "scikit-learn": timing.sklearn_seconds, "paper": 1.4}
    shown = {text: value for text, value in bars.items() if not math.isnan(value)}
    right.bar(list(shown), list(shown.values()), color=["crimson", "steelblue", "gray"])
    right.set(ylabel="time [s]", title=f"LLE of {timing.n_samples} livers, one BLAS thread")
