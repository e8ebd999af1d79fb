"""Touches of a tip with the forces that a sensor measured: the input of a calibration.

A recording holds thousands of periods that say the same. A few samples of each touch are kept: on
its way to the largest force, where the force first reaches equal parts of it. The way back is left
out, since tissue gives back less energy than it took.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import StorageError

N_SAMPLES = 6  # samples of each touch
LEAST_FORCE = 0.05  # least force of a touch [N]
_RELEASED = 0.5  # of LEAST_FORCE, below which a touch has ended
_WAY_IN = 10e-3  # path before a touch, which says where the tip came in [m]
_STEP = 1e-3  # between the points of a way [m]


@dataclass(frozen=True, eq=False)
class Palpation:
    """Paths of a tip, touch after touch, and the forces that were measured on them.

    Attributes
    ----------
    tip : ndarray, shape (n, 3)
        Positions of the tip for a contact model, each touch from outside the organ to its largest
        force [m].
    touch : ndarray of int, shape (n,)
        Number of the touch, ascending.
    force : ndarray, shape (n,)
        Measured size of the force [N]; NaN on the way between samples.
    """

    tip: FloatArray
    touch: IntArray
    force: FloatArray

    @property
    def sampled(self) -> np.ndarray:
        """Whether a point of the path is a sample, shape (n,)."""
        return np.isfinite(self.force)

    @property
    def n_touches(self) -> int:
        """Number of touches."""
        return int(self.touch[-1]) + 1

    def where(self, kept: np.ndarray) -> Palpation:
        """Return some touches only, a mask (n_touches,)."""
        chosen = kept[self.touch]
        _, touch = np.unique(self.touch[chosen], return_inverse=True)
        return Palpation(self.tip[chosen], touch, self.force[chosen])


def palpation_of(tip: FloatArray, force: FloatArray, least: float = LEAST_FORCE) -> Palpation:
    """Return the touches of a path.

    Parameters
    ----------
    tip : ndarray, shape (n, 3)
        Tip in the order of time [m]; not finite where it is not known.
    force : ndarray, shape (n,)
        Size of the measured force at the same times [N].
    least : float
        Force from which the organ is touched [N].

    Raises
    ------
    StorageError
        If there is no touch.
    """
    known = np.isfinite(tip).all(axis=1) & np.isfinite(force)
    tip, force = tip[known], force[known]
    found = []
    for first, last in _touches(force, least):
        peak = first + int(np.argmax(force[first:last]))
        samples = _samples(force, first, peak, least)
        found.append(_way(tip, force, first, samples))
    if not found:
        largest = f"{force.max():.3g} N" if len(force) else "not known"
        raise StorageError(
            f"nothing was touched: the largest force is {largest}, and touches begin at {least:g} N"
        )
    touch = np.repeat(np.arange(len(found)), [len(one) for one, _ in found])
    paths, forces = zip(*found, strict=True)
    return Palpation(np.concatenate(paths), touch, np.concatenate(forces))


def _touches(force: FloatArray, least: float) -> list[tuple[int, int]]:
    """Return the first period of each touch and the one after its last."""
    found, start = [], -1
    for k, value in enumerate(force):
        if start < 0 and value >= least:
            start = k
        elif start >= 0 and value < _RELEASED * least:
            found.append((start, k))
            start = -1
    return [*found, (start, len(force))] if start >= 0 else found


def _samples(force: FloatArray, first: int, peak: int, least: float) -> IntArray:
    """Return the periods of a touch at which the force first reaches equal parts of the largest."""
    levels = force[peak] * (1.0 + np.arange(N_SAMPLES)) / N_SAMPLES
    loading = np.maximum.accumulate(force[first : peak + 1])
    reached = first + np.searchsorted(loading, levels[levels >= least])
    return np.unique(np.minimum(reached, peak))


def _way(
    tip: FloatArray, force: FloatArray, first: int, samples: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the path from outside through the samples, and the force at these."""
    last = int(samples[-1])
    travel = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(tip[: last + 1], axis=0), axis=1))]
    start = int(np.searchsorted(travel, travel[first] - _WAY_IN))
    marks = np.arange(travel[start], travel[first], _STEP)
    between = np.arange(travel[first], travel[last], _STEP)
    passed = np.searchsorted(travel, np.concatenate([marks, between]))
    kept = np.unique(np.concatenate([[start], passed, samples]))
    measured = np.where(np.isin(kept, samples), force[kept], np.nan)
    return tip[kept], measured
