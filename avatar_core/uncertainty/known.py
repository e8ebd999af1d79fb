"""What is known of all parameters of a vademecum: what is given, for the rest its own values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from avatar_core.common.supports import SUPPORT
from avatar_core.errors import CoordinateError
from avatar_core.reduction.coordinates import Coordinate, fixed_support, option_of
from avatar_core.uncertainty.distributions import Distribution, Fixed, within

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class Held:
    """The parameters that a vademecum holds; small enough to be sent along.

    own : its values, by name of a parameter [SI]
    coordinates : with their ranges
    reference : Young's modulus for which the ranges of supports are stated [Pa]
    fixed : supports that are no coordinates, and fix Young's modulus with them
    """

    own: dict[str, float]
    coordinates: tuple[Coordinate, ...]
    reference: float
    fixed: tuple[str, ...] = ()

    @staticmethod
    def by(vademecum: Vademecum) -> Held:
        """Those of a vademecum."""
        material, parametric = vademecum.material, vademecum.parametric
        coordinates = parametric.coordinates if parametric else ()
        own = {
            "young": material.young_modulus,
            "poisson": material.poisson_ratio,
            "contrast": vademecum.contrast or 1.0,
            **{SUPPORT + support.name: support.stiffness for support in vademecum.supports},
        }
        chosen = {c.name for c in coordinates}
        return Held(
            own,
            coordinates,
            parametric.young_modulus if parametric else material.young_modulus,
            tuple(s.name for s in vademecum.supports if SUPPORT + s.name not in chosen),
        )

    def plain(self) -> dict[str, Any]:
        """As numbers and text, for a message."""
        coordinates = [
            [c.name, float(c.low), float(c.high), int(c.n_nodes)] for c in self.coordinates
        ]
        own = {name: float(value) for name, value in self.own.items()}
        return {
            "own": own,
            "coordinates": coordinates,
            "reference": float(self.reference),
            "fixed": list(self.fixed),
        }

    @staticmethod
    def of_plain(stored: Mapping[str, Any]) -> Held:
        """The inverse of :meth:`plain`."""
        coordinates = tuple(Coordinate(*one) for one in stored["coordinates"])
        return Held(dict(stored["own"]), coordinates, stored["reference"], tuple(stored["fixed"]))

    def known(self, given: Mapping[str, Distribution]) -> dict[str, Distribution]:
        """A distribution of every coordinate and of "young", within what the vademecum holds.

        What is not given has the vademecum's own value.

        Raises
        ------
        CoordinateError
            For a parameter that the vademecum does not have, or a distribution beyond its range.
        """
        names = ["young", *(c.name for c in self.coordinates)]
        for name in given:
            if name not in names:
                raise CoordinateError(
                    f"this vademecum has no '{name}' but {', '.join(names)}; build it with "
                    f"{option_of(name)}=LOW:HIGH"
                )
        young = given.get("young", Fixed(self.own["young"]))
        if young.cdf(0.0) > 0.0:
            raise CoordinateError(f"young ({young.said()}) may be negative; give positive values")
        if self.fixed and young != Fixed(self.own["young"]):
            raise fixed_support(self.fixed[0], self.own["young"])
        found = {"young": young}
        for c in self.coordinates:
            scale = self._scale(young) if c.kind == "support" else 1.0
            whole = given.get(c.name, Fixed(self.own[c.name]))
            found[c.name] = within(c.name, whole, scale * c.low, scale * c.high)
        return found

    def _scale(self, young: Distribution) -> float:
        """Of the ranges of supports, whose stiffness counts over Young's modulus."""
        return float(young.ppf(np.array(0.5))) / self.reference


def known_of(vademecum: Vademecum, given: Mapping[str, Distribution]) -> dict[str, Distribution]:
    """:meth:`Held.known` of a vademecum."""
    return Held.by(vademecum).known(given)
