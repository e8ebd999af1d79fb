"""Gravity: the organ sags under its own weight, a constant load.

The modes X are orthonormal in energy; the Galerkin solution for a body force rho g therefore has
the amplitudes X^T M 1 rho g, M the mass matrix of unit density. Viscoelastic tissue has relaxed.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect, direction, require_body

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class SelfWeight(Effect):
    """The organ deforms under its own weight."""

    name: ClassVar[str] = "self_weight"
    text: ClassVar[str] = "the organ sags under gravity"

    density: float = quantity("kg/m^3", 100.0, 5000.0, "of the organ", 1060.0)
    gravity: float = quantity("m/s^2", 0.0, 100.0, "acceleration", 9.81)
    direction: tuple[float, ...] = quantity(
        "-", -1e3, 1e3, "of gravity in the organ's frame (supine, RAS: 0 -1 0)", (0.0, -1.0, 0.0)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "direction", direction(self.direction, self.name, "direction"))

    def require(self, vademecum: Vademecum) -> None:
        require_body(vademecum, self.name)


SelfWeightArrays = namedtuple("SelfWeightArrays", ["amplitude"])  # (k,) of the modes, under gravity


def self_weight_arrays(
    effect: SelfWeight, vademecum: Vademecum, softened: float
) -> SelfWeightArrays:
    """Amplitudes of the modes.

    softened : instantaneous over relaxed Young's modulus
    """
    assert vademecum.body is not None  # by `require`
    force = effect.density * effect.gravity * np.array(effect.direction)
    return SelfWeightArrays(softened * (vademecum.body.weight @ force))
