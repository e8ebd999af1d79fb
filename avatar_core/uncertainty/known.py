"""Distributions of all parameters of a vademecum, from those that are given.

Other parameters take the vademecum's own values, or anything within its ranges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from avatar_core.common.dataclass_json import of_plain, plain
from avatar_core.common.supports import SUPPORT
from avatar_core.errors import CoordinateError
from avatar_core.reduction.coordinates import RESECTION, Coordinate, fixed_support, remedy
from avatar_core.uncertainty.distributions import Distribution, Fixed, LogUniform, Uniform, within

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum

# From the softest livers of elastography to twice the 170 kPa of the paper.
YOUNG = LogUniform(500.0, 350e3)


@dataclass(frozen=True)
class Held:
    """The parameters that a vademecum holds; small enough to be sent along.

    Attributes
    ----------
    own : dict[str, float]
        Its values, by name of a parameter [SI].
    coordinates : tuple[Coordinate, ...]
        Coordinates with their ranges.
    reference : float
        Young's modulus for which the ranges of supports are stated [Pa].
    fixed : tuple[str, ...]
        Supports that are no coordinates, and fix Young's modulus with them.
    """

    own: dict[str, float]
    coordinates: tuple[Coordinate, ...]
    reference: float
    fixed: tuple[str, ...] = ()

    @staticmethod
    def by(vademecum: Vademecum) -> Held:
        """Return the parameters of a vademecum."""
        material, parametric = vademecum.material, vademecum.parametric
        coordinates = uncertain(vademecum)
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
        """Return the parameters as numbers and text, for a message."""
        return dict(plain(asdict(self)))

    @staticmethod
    def of_plain(stored: Mapping[str, Any]) -> Held:
        """Return the parameters from numbers and text, the inverse of :meth:`plain`."""
        return of_plain(Held, stored, "held")

    def known(self, given: Mapping[str, Distribution]) -> dict[str, Distribution]:
        """Return a distribution of every coordinate and of "young", within the vademecum's ranges.

        A parameter that is not given has the vademecum's own value.

        Raises
        ------
        CoordinateError
            For a parameter that the vademecum does not have, or a distribution beyond its range.
        """
        names = ["young", *(c.name for c in self.coordinates)]
        for name in given:
            if name not in names:
                raise CoordinateError(
                    f"this vademecum has no '{name}' but {', '.join(names)}; {remedy(name)}"
                )
        young = given.get("young", Fixed(self.own["young"]))
        if young.cdf(0.0) > 0.0:
            raise CoordinateError(f"young ({young.said()}) may be negative; give positive values")
        if self.fixed and young != Fixed(self.own["young"]):
            raise fixed_support(self.fixed[0], self.own["young"])
        found = {"young": young}
        for c in self.coordinates:
            scale = self.scale(c, young)
            whole = given.get(c.name, Fixed(self.own[c.name]))
            found[c.name] = within(c.name, whole, scale * c.low, scale * c.high)
        return found

    def scale(self, coordinate: Coordinate, young: Distribution) -> float:
        """Return the scale of a coordinate's range: supports count over Young's modulus."""
        if coordinate.kind != "support":
            return 1.0
        return float(young.ppf(np.array(0.5))) / self.reference


def uncertain(vademecum: Vademecum) -> tuple[Coordinate, ...]:
    """Return the coordinates that may be unknown: the opening of a cut is chosen, with kinks."""
    coordinates = vademecum.parametric.coordinates if vademecum.parametric else ()
    return tuple(c for c in coordinates if c.kind != RESECTION)


def known_of(vademecum: Vademecum, given: Mapping[str, Distribution]) -> dict[str, Distribution]:
    """Return the result of :meth:`Held.known` for a vademecum."""
    return Held.by(vademecum).known(given)


def priors_of(
    vademecum: Vademecum, given: Mapping[str, Distribution] | None = None
) -> dict[str, Distribution]:
    """Return a prior of every coordinate and of "young": as given, or as wide as possible.

    Without a given one, a coordinate lies anywhere in its range; Young's modulus in ``YOUNG``,
    unless a support that is no coordinate fixes it.

    Raises
    ------
    CoordinateError
        See :meth:`Held.known`.
    """
    given, held = given or {}, Held.by(vademecum)
    own = Fixed(held.own["young"])
    wide: dict[str, Distribution] = {"young": own if held.fixed else YOUNG}
    young = given.get("young", wide["young"])
    for c in held.coordinates:
        if c.kind == "poisson":
            wide[c.name] = Uniform(c.low, c.high)
            continue
        scale = held.scale(c, young)
        wide[c.name] = LogUniform(scale * c.low, scale * c.high)
    return held.known(wide | dict(given))
