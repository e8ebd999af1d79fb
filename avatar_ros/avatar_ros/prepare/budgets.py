"""Which detail a budget chooses, in the process that prepares models; and what it is timed at.

Times are measured when a vademecum or a scene is new here, and kept while only the material
changes: before it is used where a budget chooses by them, else after. Core modules are imported
where they are used: the contact node needs none of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avatar_core.contact.model import ContactModel
    from avatar_core.vademecum.accuracy import AccuracyCurve, Detail
    from avatar_ros.prepare.orders import Order
    from avatar_ros.prepare.scenes import Plan


class OvertakenError(Exception):
    """Something came that is to be prepared before anything is timed."""


class Budgets:
    """Curves that were timed on this machine, for the vademecum and scene of last time."""

    def __init__(self) -> None:
        self._key: Any = None
        self._timed: AccuracyCurve | None = None  # all details of the cloud
        self._rows: dict[Detail, dict[str, Any]] = {}  # those that differ in modes alone

    def detail(self, plan: Plan, order: Order) -> Detail:
        """What to show: what meets the budget, or everything where there is none.

        Raises
        ------
        AccuracyError
            If no detail meets it, with the nearest two, or the vademecum was never measured.
        """
        from avatar_core.contact.timing import timed
        from avatar_core.errors import AccuracyError
        from avatar_core.vademecum.accuracy import Budget, Detail, choose

        self._keep_for(plan)
        most = plan.modes or plan.vademecum.far.rank
        if not order.budget:
            return Detail(most, plan.cloud)
        curve = _curve_of(plan)
        if curve is None:
            raise AccuracyError(
                "this vademecum has no accuracy curve for a budget to choose from; build it again "
                "with this version of 'avatar vademecum', or leave accuracy.* at 0"
            )
        if self._timed is None:
            # single precision shows nothing that 16 bits do not, and is slower
            usual = replace(
                curve, points=tuple(p for p in curve.points if p.detail.precision != "float32")
            )
            self._timed = timed(
                plan.vademecum, usual, plan.tip_radii, plan.effects, order.period, halves=True
            )
        some = tuple(p for p in self._timed.points if p.detail.modes <= most)
        return choose(replace(self._timed, points=some), Budget(**order.budget)).detail

    def curve(self, plan: Plan, detail: Detail) -> dict[str, Any] | None:
        """The plain form of the points with up to the modes of ``detail``; None: not measured.

        Their times are NaN until :meth:`times` measured them, or a budget did.
        """
        if detail in self._rows:
            return self._rows[detail]
        row = self._row(plan, detail)
        if row is None:
            return None
        if self._timed is not None or not row.points:
            self._rows[detail] = row.plain()
        return row.plain()

    def times(
        self, plan: Plan, detail: Detail, model: ContactModel, overtaken: Callable[[], bool]
    ) -> dict[str, Any] | None:
        """The same once timed on ``model``, which shows the detail; None if that was known.

        Raises
        ------
        OvertakenError : as soon as ``overtaken`` says so
        """
        from avatar_core.contact.timing import slides, timed_points

        def go_on(share: float) -> None:
            if overtaken():
                raise OvertakenError

        go_on(0.0)
        row = self._row(plan, detail)
        if row is None or detail in self._rows:
            return None
        paths = slides(plan.vademecum, plan.tip_radii)
        row = replace(row, points=tuple(timed_points(model, row.points, paths, go_on)))
        self._rows[detail] = row.plain()
        return self._rows[detail]

    def _row(self, plan: Plan, detail: Detail) -> AccuracyCurve | None:
        curve = self._timed or _curve_of(plan)
        if curve is None:
            return None
        row = curve.like(detail)
        return replace(row, points=tuple(p for p in row.points if p.detail.modes <= detail.modes))

    def _keep_for(self, plan: Plan) -> None:
        key = (plan.vademecum.id, plan.tip_radii, plan.cloud, plan.effect_names)
        if key != self._key:
            self._key, self._timed, self._rows = key, None, {}


def _curve_of(plan: Plan) -> AccuracyCurve | None:
    certificate = plan.vademecum.certificate
    if certificate is None or certificate.curve is None:
        return None
    return certificate.curve.of(plan.cloud)
