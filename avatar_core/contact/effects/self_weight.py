"""Gravity: the organ sags under its own weight, a constant load.

The modes X are orthonormal in energy. The Galerkin solution for a body force rho g therefore has
the amplitudes X^T M 1 rho g, with M the mass matrix of unit density. Viscoelastic tissue has
relaxed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect, Ground, direction, find, require_body
from avatar_core.contact.effects.viscoelasticity import Viscoelasticity

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class SelfWeight(Effect):
    """The organ deforms under its own weight.

    Examples
    --------
    >>> av.effects.SelfWeight(direction=(0.0, -2.0, 0.0)).direction
    (0.0, -1.0, 0.0)
    """

    name: ClassVar[str] = "self_weight"
    text: ClassVar[str] = "the organ sags under gravity"

    Constants: ClassVar[Any] = kind("SelfWeight", amplitude=array("K"))  # amplitudes of the modes
    superposed: ClassVar[bool] = True
    moving: ClassVar[bool] = True

    density: float = quantity("kg/m^3", 100.0, 5000.0, "density of the organ", 1060.0)
    gravity: float = quantity("m/s^2", 0.0, 100.0, "acceleration", 9.81)
    direction: tuple[float, ...] = quantity(
        "-",
        -1e3,
        1e3,
        "direction of gravity in the organ's frame (supine, RAS: 0 -1 0)",
        (0.0, -1.0, 0.0),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "direction", direction(self.direction, self.name, "direction"))

    def require(self, vademecum: Vademecum) -> None:
        """Refuse a vademecum without the mass of the organ."""
        require_body(vademecum, self.name)

    @classmethod
    def example(cls) -> SelfWeight:
        """Return a light weight to measure and test."""
        return cls(gravity=1.0)

    def sag(self, vademecum: Vademecum) -> np.ndarray:
        """Return the amplitudes of the global modes, shape (k,), before the tissue relaxes."""
        assert vademecum.body is not None  # by `require`
        force = self.density * self.gravity * np.array(self.direction)
        return np.asarray(vademecum.body.weight @ force)

    def lay_out(self, ground: Ground) -> Any:
        """Return the amplitudes of the weight."""
        prony = find(ground.effects, Viscoelasticity)
        softened = 1.0 / (1.0 - sum(prony.g)) if prony else 1.0
        sag = softened * self.sag(ground.vademecum)
        return self.Constants(np.pad(sag, (0, ground.n_modes - len(sag))))
