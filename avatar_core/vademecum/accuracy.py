"""Accuracy against time: measured error and cost of contact steps, and the choice for a budget.

A :class:`Detail` says how finely a step shows the displacement. An :class:`AccuracyCurve` holds the
measured error and time of many details, and :func:`choose` picks among them for a :class:`Budget`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np

from avatar_core.errors import AccuracyError

Quantity = Literal["l2", "force"]
Cloud = Literal["surface", "volume", "off"]

CONTENT = 0.95  # fraction of the loads below a certified error
LEVELS = (1, 2, 3, 4, 5, 6, 8)  # numbers of modes that are measured, beside all of them
_CONFIDENCE = 0.95  # of the bound, over draws of the measured loads


@dataclass(frozen=True)
class Detail:
    """Resolution at which a step shows the displacement.

    Attributes
    ----------
    modes : int
        Mean number of modes used for one cloud point (global plus regional), e.g. `modes=7`; a
        vademecum's ``n_modes`` uses all.
    cloud : Cloud
        Vertices that are shown.
    """

    modes: int
    cloud: Cloud = "surface"

    def __str__(self) -> str:
        return f"{self.modes} modes, cloud {self.cloud}"


def mode_levels(n_modes: int) -> tuple[int, ...]:
    """Return the numbers of modes of a curve's details, ascending; the last uses all."""
    return (*(level for level in LEVELS if level < n_modes), n_modes)


@dataclass(frozen=True)
class CurvePoint:
    """Measured error, size and time of a detail.

    Attributes
    ----------
    l2 : float
        Relative error of the cloud's displacement under the computed force, which 95 % of unseen
        contacts stay below; NaN for no cloud.
    force : float
        Relative error of the force at the tip's depth, which 95 % of unseen contacts stay below.
    nbytes : int
        Size of all data that show the displacement [bytes]; a step reads a part.
    p50, p99 : float
        Processor time of a step, median and 99th percentile [s]; NaN where it was not timed.
    """

    detail: Detail
    l2: float
    force: float
    nbytes: int
    p50: float = float("nan")
    p99: float = float("nan")

    def error(self, quantity: Quantity) -> float:
        """Return the certified error of a quantity."""
        return self.l2 if quantity == "l2" else self.force


@dataclass(frozen=True)
class Budget:
    """Limits on the error and the time of a step.

    Attributes
    ----------
    tolerance : float
        Largest relative error of ``quantity``, which 95 % of contacts stay below.
    deadline : float
        Largest measured processor time of a step, which 99 % stay below [s]. A detail that was not
        timed meets any deadline.
    quantity : Quantity
        "l2" for the displacement or "force".

    Raises
    ------
    AccuracyError
        For a limit that is not positive, or an unknown quantity.

    Examples
    --------
    >>> budget = av.Budget(tolerance=0.1, deadline=1.0)  # 10 % in the mean, within 1 s
    >>> av.prepare(v, budget=budget).n_modes <= v.n_modes
    True
    """

    tolerance: float
    deadline: float
    quantity: Quantity = "l2"

    def __post_init__(self) -> None:
        if self.quantity not in get_args(Quantity):
            raise AccuracyError(
                f"quantity is '{self.quantity}'; give {', '.join(get_args(Quantity))}"
            )
        for name, value in (("tolerance", self.tolerance), ("deadline", self.deadline)):
            if not value > 0.0:  # NaN is refused, infinity is no limit
                raise AccuracyError(f"{name} is {value:g}; give a number above 0")

    def holds(self, point: CurvePoint) -> bool:
        """Return whether a point meets both limits."""
        return point.error(self.quantity) <= self.tolerance and not point.p99 > self.deadline


@dataclass(frozen=True)
class AccuracyCurve:
    """Measured error and time of many details of one vademecum.

    Attributes
    ----------
    n_errors : int
        Number of unseen contacts behind each error.
    machine : str
        Machine where it was timed.
    """

    points: tuple[CurvePoint, ...]
    n_errors: int
    machine: str = ""

    def of(self, cloud: Cloud) -> AccuracyCurve:
        """Return the points of one cloud, by ascending number of modes."""
        some = (point for point in self.points if point.detail.cloud == cloud)
        return replace(self, points=tuple(sorted(some, key=lambda p: p.detail.modes)))

    def up_to(self, modes: int) -> AccuracyCurve:
        """Return the points of at most this many modes."""
        return replace(self, points=tuple(p for p in self.points if p.detail.modes <= modes))

    def front(self, quantity: Quantity = "l2") -> tuple[CurvePoint, ...]:
        """Return the points that no other one beats in time and error (Pareto), fastest first."""
        best, front = np.inf, []
        for point in sorted(self.points, key=lambda p: (p.p50, p.error(quantity))):
            if point.error(quantity) < best:
                best = point.error(quantity)
                front.append(point)
        return tuple(front)

    def plain(self) -> dict[str, Any]:
        """Return the curve as columns of numbers and text, for a file."""
        columns: dict[str, Any] = {
            name: [getattr(point.detail, name) for point in self.points] for name in _names(Detail)
        }
        for name in _names(CurvePoint)[1:]:
            columns[name] = [getattr(point, name) for point in self.points]
        return columns | {"n_errors": self.n_errors, "machine": self.machine}

    @staticmethod
    def of_plain(stored: dict[str, Any]) -> AccuracyCurve:
        """Return the curve of columns, the inverse of :meth:`plain`."""

        def rows(names: tuple[str, ...]) -> Iterable[tuple[Any, ...]]:
            return zip(*(stored[name] for name in names), strict=True)

        pairs = zip(rows(_names(Detail)), rows(_names(CurvePoint)[1:]), strict=True)
        points = tuple(CurvePoint(Detail(*detail), *values) for detail, values in pairs)
        return AccuracyCurve(points, stored["n_errors"], stored["machine"])


def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def choose(curve: AccuracyCurve | None, budget: Budget) -> CurvePoint:
    """Return the fastest point that meets a budget; among equally fast ones the most accurate.

    On a curve that was not timed, the fewest modes are the fastest. A looser tolerance is therefore
    never slower. A longer deadline never changes the choice, unless nothing met the shorter one.

    Raises
    ------
    AccuracyError
        If no point meets the budget; the message names the nearest point on either side. Also if
        there is no curve.
    """
    if curve is None:
        raise AccuracyError(
            "this vademecum has no accuracy curve for a budget to choose from; build it with "
            "'avatar vademecum', or ask without a budget"
        )
    feasible = [point for point in curve.points if budget.holds(point)]
    if feasible:
        return min(feasible, key=lambda p: (_cost(p), p.error(budget.quantity)))
    raise AccuracyError(_refusal(curve, budget))


def _cost(point: CurvePoint) -> float:
    return point.detail.modes if math.isnan(point.p50) else point.p50


def _refusal(curve: AccuracyCurve, budget: Budget) -> str:
    asked = f"no step is within {budget.tolerance:.3g} of {budget.quantity} in "
    asked += "any time" if np.isinf(budget.deadline) else f"{budget.deadline * 1e6:.0f} us"
    quantity = budget.quantity
    exact = [p for p in curve.points if p.error(quantity) <= budget.tolerance]
    fast = [p for p in curve.points if not p.p99 > budget.deadline]
    near = [*_first(exact, lambda p: p.p99), *_first(fast, lambda p: p.error(quantity))] or list(
        _first(curve.points, lambda p: p.error(quantity))
    )
    nearest = " or ".join(f"{p.error(quantity):.3g}{_spent(p)} ({p.detail})" for p in near)
    return f"{asked}; nearest: {nearest or 'nothing was measured'}"


def _spent(point: CurvePoint) -> str:
    return "" if math.isnan(point.p99) else f" in {point.p99 * 1e6:.0f} us"


def _first(
    points: Iterable[CurvePoint], key: Callable[[CurvePoint], float]
) -> tuple[CurvePoint, ...]:
    known = [point for point in points if not np.isnan(key(point))]
    return (min(known, key=key),) if known else ()


def upper_quantile(values: np.ndarray, content: float = CONTENT) -> float:
    """Return a bound that holds for a fraction ``content`` of the distribution of the values (n,).

    Distribution-free tolerance bound (Wilks, Annals of Mathematical Statistics 12, 1941): the
    smallest order statistic x_(r) with P[B >= r] <= 1 - confidence. B is binomial of n and
    ``content``. If the sample is too small for the confidence, the bound is the largest value.
    """
    from scipy.stats import binom

    if len(values) == 0:
        return float("nan")
    rank = min(int(binom.ppf(_CONFIDENCE, len(values), content)) + 1, len(values))
    return float(np.sort(values)[rank - 1])
