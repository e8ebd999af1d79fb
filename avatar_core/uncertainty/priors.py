"""What is taken to be known of parameters of which nobody said anything."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avatar_core.uncertainty.distributions import Distribution, Fixed, LogUniform, Uniform
from avatar_core.uncertainty.known import Held
from avatar_core.vademecum.model import Vademecum

# From the softest livers of elastography to twice the 170 kPa of the paper.
YOUNG = LogUniform(500.0, 350e3)


def priors_of(
    vademecum: Vademecum, given: Mapping[str, Distribution] | None = None
) -> dict[str, Distribution]:
    """A distribution of every coordinate and of "young": as given, or as wide as may be.

    A coordinate lies anywhere in its range; Young's modulus in ``YOUNG``, unless a support that is
    no coordinate fixes it.

    Raises
    ------
    CoordinateError
        As :meth:`avatar_core.uncertainty.known.Held.known`.
    """
    given, held = given or {}, Held.by(vademecum)
    own = Fixed(held.own["young"])
    wide: dict[str, Distribution] = {"young": own if held.fixed else YOUNG}
    young = given.get("young", wide["young"])
    for c in held.coordinates:
        if c.kind == "poisson":
            wide[c.name] = Uniform(c.low, c.high)
            continue
        scale = float(young.ppf(np.array(0.5))) / held.reference if c.kind == "support" else 1.0
        wide[c.name] = LogUniform(scale * c.low, scale * c.high)
    return held.known(wide | dict(given))
