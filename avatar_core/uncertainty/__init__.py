"""Answers of a vademecum when its data are known as distributions only.

::

    known = {"young": uncertainty.Lognormal(5.3e3, 1.33)}
    bands = uncertainty.force_bands(vademecum, known, points, depths)

Distributions of the material come in. Bands of force and displacement go out; with touches, the
posterior distributions after measured forces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from avatar_core.common.lazy import lazy

_ORIGIN = {
    "Bands": "uncertainty.bands",
    "TouchErrors": "uncertainty.calibration",
    "Fixed": "uncertainty.distributions",
    "LogUniform": "uncertainty.distributions",
    "Lognormal": "uncertainty.distributions",
    "Uniform": "uncertainty.distributions",
    "force_bands": "uncertainty.bands",
    "read_distributions": "uncertainty.distributions",
}

__all__ = [*_ORIGIN]

if TYPE_CHECKING:
    from avatar_core.uncertainty.bands import Bands as Bands
    from avatar_core.uncertainty.bands import force_bands as force_bands
    from avatar_core.uncertainty.calibration import TouchErrors as TouchErrors
    from avatar_core.uncertainty.distributions import Fixed as Fixed
    from avatar_core.uncertainty.distributions import Lognormal as Lognormal
    from avatar_core.uncertainty.distributions import LogUniform as LogUniform
    from avatar_core.uncertainty.distributions import Uniform as Uniform
    from avatar_core.uncertainty.distributions import read_distributions as read_distributions
else:
    __getattr__, __dir__ = lazy(__name__, _ORIGIN)
