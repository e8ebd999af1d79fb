"""Colours of the organ: the displacement, or error and spread of the force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avatar_core.contact.error_map import force_error_at
from avatar_core.errors import AvatarError, one_line
from avatar_core.uncertainty.distributions import Distribution, Fixed
from avatar_core.uncertainty.force_ratios import force_spread_at
from avatar_core.uncertainty.known import Held
from avatar_ros.framework.parameters import ParameterError
from avatar_ros.loop.settings import chosen_known
from avatar_ros.prepare.bands import usable_known
from avatar_ros.ui.session.chosen import Chosen
from avatar_ros.ui.view import legend
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.view import OrganView

DISPLACEMENT, ERROR, SPREAD = "displacement", "expected error", "spread of the force"
FIELDS = (DISPLACEMENT, ERROR, SPREAD)
_LEGENDS = {ERROR: legend.EXPECTED_ERROR, SPREAD: legend.SPREAD}
_NO_DISTRIBUTIONS = (
    "no spread: the parameter uncertainty of the contact node has no distribution for this organ"
)


class Coloured:
    """Chooses the field that is drawn on the organ.

    show : sets the page's control to a field
    in_executor : calls in the thread that draws the organ
    """

    def __init__(
        self,
        view: OrganView,
        chosen: Chosen,
        say: Callable[[str], None],
        show: Callable[[str], None],
        in_executor: Callable[[Callable[[], None]], None],
    ) -> None:
        self._view, self._chosen, self._say = view, chosen, say
        self._show, self._in_executor = show, in_executor
        self._field = self._wanted = DISPLACEMENT  # drawn, and requested

    def forget(self) -> None:
        """Show the displacement of another organ first."""
        self._field = self._wanted = DISPLACEMENT

    def legend(self) -> str:
        """Return the present colour scale as HTML."""
        view, organ = self._view, self._chosen.organ
        has_springs = organ is not None and bool(organ.sprung.any())
        return legend.legend(*self.scale, view.opacity, has_springs, view.is_reach_marked)

    @property
    def scale(self) -> tuple[str, float]:
        """Return the name of the colour scale with its unit, and its end in that unit."""
        if self._field == DISPLACEMENT:
            return legend.DISPLACEMENT, 1e3 * self._view.top
        return _LEGENDS[self._field], 1e2 * self._view.field_top

    def choose(self, field: str) -> None:
        """Colour by one of ``FIELDS``."""
        organ = self._chosen.organ
        if organ is None:
            return
        self._wanted = field
        if field == SPREAD:
            self._show_spread(organ)
        elif field == ERROR:
            errors = force_error_at(organ.vademecum, organ.vertices)
            missing = "errors of this organ were never measured; build it with a certificate"
            self._paint(organ, ERROR, errors, missing)
        else:
            self._in_executor(lambda: self._draw(organ, DISPLACEMENT, None))

    @property
    def fields(self) -> tuple[str, ...]:
        """Return the fields to choose from: a spread only if distributions are given."""
        fields = FIELDS if self._chosen.contact.get("uncertainty") else (DISPLACEMENT, ERROR)
        if self._wanted not in fields:
            self.choose(DISPLACEMENT)
        return fields

    def _show_spread(self, organ: Organ) -> None:
        try:
            known = self._known(organ, chosen_known(self._chosen.contact["uncertainty"]))
        except (AvatarError, ParameterError) as error:
            self._refuse(one_line(error))
            return
        if all(isinstance(one, Fixed) for one in known.values()):
            self._refuse(_NO_DISTRIBUTIONS)
            return
        spread = force_spread_at(organ.vademecum, self._chosen.tip, known, organ.vertices)
        self._paint(organ, SPREAD, spread, "no tool reaches this organ")

    def _known(self, organ: Organ, given: dict[str, Distribution]) -> dict[str, Distribution]:
        """Return distributions of the organ's parameters; by default fixed at the value in use."""
        held = Held.by(organ.vademecum)
        used, notices = usable_known(organ.name, held, given)
        for notice in notices:
            self._say(notice)
        values = {name: Fixed(value) for name, value in self._chosen.values(organ).items()}
        return held.known({**values, **used})

    def _paint(self, organ: Organ, field: str, values: np.ndarray, missing: str) -> None:
        if np.isfinite(values).any():
            self._in_executor(lambda: self._draw(organ, field, values))
        elif self._is_wanted(organ, field):
            self._refuse(missing)

    def _draw(self, organ: Organ, field: str, values: np.ndarray | None) -> None:
        if self._is_wanted(organ, field):
            self._field = field
            self._view.paint(values)

    def _is_wanted(self, organ: Organ, field: str) -> bool:
        """Return whether neither another organ nor another field was chosen meanwhile."""
        return organ is self._chosen.organ and field == self._wanted

    def _refuse(self, reason: str) -> None:
        """Keep the present field, and set the control back to it."""
        self._say(reason)
        self._wanted = self._field
        self._show(self._field)
