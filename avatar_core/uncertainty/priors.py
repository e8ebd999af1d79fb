"""What is taken to be known of parameters of which nobody said anything."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avatar_core.common.supports import SUPPORT
from avatar_core.uncertainty.bands import known_of
from avatar_core.uncertainty.distributions import Distribution, Fixed, LogUniform, Uniform
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
        As :func:`avatar_core.uncertainty.bands.known_of`.
    """
    given = given or {}
    parametric = vademecum.parametric
    coordinates = parametric.coordinates if parametric else ()
    reference = parametric.young_modulus if parametric else vademecum.material.young_modulus
    names = {c.name for c in coordinates}
    held = any(SUPPORT + support.name not in names for support in vademecum.supports)
    wide: dict[str, Distribution] = {"young": Fixed(reference) if held else YOUNG}
    young = given.get("young", wide["young"])
    for c in coordinates:
        if c.kind == "poisson":
            wide[c.name] = Uniform(c.low, c.high)
            continue
        scale = float(young.ppf(np.array(0.5))) / reference if c.kind == "support" else 1.0
        wide[c.name] = LogUniform(scale * c.low, scale * c.high)
    return known_of(vademecum, wide | dict(given))
