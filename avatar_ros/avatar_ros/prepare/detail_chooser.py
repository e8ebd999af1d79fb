"""Which detail a budget chooses, in the worker process, and the times it is chosen by.

Times are measured once for each vademecum and scene, and kept while only the material changes:
before the model is used if a budget chooses by them, otherwise afterwards. Core modules are
imported where they are used, because the contact node needs none of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avatar_core.contact.model import ContactModel
    from avatar_core.scene.prepare import ModelSpec
    from avatar_core.vademecum.accuracy import AccuracyCurve, Detail, Quantity
    from avatar_ros.prepare.requests import PreparationRequest


class SupersededError(Exception):
    """A vademecum or a change came in, which is to be prepared before anything is timed."""


class DetailChooser:
    """Holds the curves timed on this machine for the last vademecum and scene."""

    def __init__(self) -> None:
        self._key: Any = None
        self._timed: AccuracyCurve | None = None  # all details of the cloud
        self._rows: dict[Detail, dict[str, Any]] = {}  # details that differ only in their modes

    def detail(self, spec: ModelSpec, request: PreparationRequest) -> Detail:
        """The detail to show: the one that meets the budget, or everything without a budget.

        Raises
        ------
        AccuracyError
            No detail meets the budget (with the two nearest), or the vademecum was never measured.
        """
        from avatar_core.vademecum.accuracy import Budget, choose

        self._keep_for(spec)
        if not request.budget:
            return spec.finest
        if self._timed is None:
            self._timed = spec.timed_curve(request.period, halves=True)
        some = tuple(p for p in self._timed.points if p.detail.modes <= spec.finest.modes)
        return choose(replace(self._timed, points=some), Budget(**request.budget)).detail

    def curve(self, spec: ModelSpec, detail: Detail) -> dict[str, Any] | None:
        """The plain form of the points with at most the modes of ``detail``; None: not measured.

        Their times are NaN until :meth:`times` or a budget has had them measured.
        """
        if detail in self._rows:
            return self._rows[detail]
        row = self._row(spec, detail)
        if row is None:
            return None
        if self._timed is not None or not row.points:
            self._rows[detail] = row.plain()
        return row.plain()

    def times(
        self, spec: ModelSpec, detail: Detail, model: ContactModel, superseded: Callable[[], bool]
    ) -> dict[str, Any] | None:
        """The same, timed on ``model``, which shows the detail; None if the times were known.

        Raises
        ------
        SupersededError : as soon as ``superseded`` returns true
        """
        from avatar_core.contact.timing import slides, timed_points

        def check(fraction: float) -> None:
            if superseded():
                raise SupersededError

        check(0.0)
        row = self._row(spec, detail)
        if row is None or detail in self._rows:
            return None
        paths = slides(spec.vademecum, spec.tips)
        row = replace(row, points=tuple(timed_points(model, row.points, paths, check)))
        self._rows[detail] = row.plain()
        return self._rows[detail]

    def _row(self, spec: ModelSpec, detail: Detail) -> AccuracyCurve | None:
        curve = self._timed or spec.curve
        if curve is None:
            return None
        row = curve.like(detail)
        return replace(row, points=tuple(p for p in row.points if p.detail.modes <= detail.modes))

    def _keep_for(self, spec: ModelSpec) -> None:
        """Forget the curves of another vademecum or scene."""
        key = (spec.vademecum.id, spec.tips, spec.cloud, spec.effect_names)
        if key != self._key:
            self._key, self._timed, self._rows = key, None, {}


def least_error(spec: ModelSpec) -> dict[str, float]:
    """The error of the most exact detail, by quantity; empty if none were measured."""
    quantities: tuple[Quantity, ...] = ("l2", "force")
    points = spec.curve.points if spec.curve else ()
    found = {name: [p.error(name) for p in points if p.error(name) >= 0.0] for name in quantities}
    return {name: min(errors) for name, errors in found.items() if errors}
