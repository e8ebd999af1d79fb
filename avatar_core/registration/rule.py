"""Prior knowledge of a registration, and limits of its iteration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import RegistrationError
from avatar_core.registration.loads import Kind
from avatar_core.registration.posterior import Scales

_RANGES = {  # of all numbers but the angle; lengths in metres
    "noise": (1e-5, 0.02),
    "shift": (0.0, 0.2),
    "support_shift": (0.0, 0.2),
    "correlation": (0.0, 0.2),
    "within": (1e-5, 0.2),
    "tolerance": (1e-9, 0.01),
    "freedom": (1.0, 1e6),
    "rigid_steps": (0, 10_000),
    "most_steps": (1, 10_000),
}
_NUMBERS = ("freedom", "rigid_steps", "most_steps")


@dataclass(frozen=True)
class RegistrationRule:
    """Prior knowledge, and limits of the iteration.

    Attributes
    ----------
    noise : float
        Least standard deviation of a point along the normal [m], also for errors of strain and
        mesh.
    turn, shift : float
        Prior root mean squares of the rigid motion, all axes together [rad, m]; near 0 in a known
        frame.
    kind : Kind or None
        Kind of the loads (:mod:`avatar_core.registration.loads`); None for the better of smooth and
        few.
    forces : str
        Places where forces may act, see :func:`avatar_core.registration.loads.allowed_at`.
    support_shift : float
        Prior root mean square motion of each support of the vademecum [m]; 0 for none.
    correlation : float
        Length over which errors of the points are correlated [m]; 0 for none. Mesh errors always
        are.
    within : float
        Largest half-width of a place's 90 % interval that counts as determined [m].
    freedom : float
        Degrees of freedom of Student's distribution, which weights points.
    tolerance : float
        Step of a surface point that ends the iteration [m].
    rigid_steps, most_steps : int
        Numbers of rigid iterations, and of all iterations at most.
    rescaled : tuple[int, ...]
        Steps after the rigid ones at which the scales are sought.

    Raises
    ------
    RegistrationError
        For a number out of its range, or an unknown kind.

    Examples
    --------
    >>> rule = av.RegistrationRule(noise=0.5e-3, turn=0.0, shift=0.0)  # it deformed alone
    >>> rule.within
    0.005
    """

    noise: float = 1e-3
    turn: float = float(np.radians(10.0))
    shift: float = 10e-3
    kind: Kind | None = None
    forces: str = "accessible"
    support_shift: float = 0.0
    correlation: float = 0.0
    within: float = 5e-3
    freedom: float = 10.0
    tolerance: float = 1e-4
    rigid_steps: int = 8
    most_steps: int = 40
    rescaled: tuple[int, ...] = (1, 3, 6)

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                unit = "" if name in _NUMBERS else " in metres (1e-3: 1 mm)"
                raise RegistrationError(f"{name} is {value:g}; give {low:g} to {high:g}{unit}")
        if not 0.0 <= self.turn <= np.pi:
            raise RegistrationError(f"turn is {np.degrees(self.turn):g} degrees; give 0 to 180")
        if self.kind not in (None, *get_args(Kind)):
            raise RegistrationError(
                f"unknown kind {self.kind!r}; choose one of {', '.join(get_args(Kind))}, or None"
            )

    def scales(self, kind: Kind, young_modulus: float) -> Scales:
        """Return prior scales of loads, length, noise and mismatch."""
        loads = 0.02 if kind == "few" else 0.02 * young_modulus  # displacement [m], traction [Pa]
        mismatch = 1.0 if self.correlation else 0.5 if kind == "few" else 0.2  # of the noise
        middle = np.log([loads, 0.03, self.noise, mismatch * self.noise])
        return Scales(middle, np.array([0.7 if kind == "few" else 2.0, 0.7, 0.3, 0.7]))

    @property
    def least_scales(self) -> FloatArray:
        """Logarithms below which scales are not sought: the stated noise is a lower limit."""
        alike = np.log(self.noise) if self.correlation else -np.inf
        return np.array([-np.inf, -np.inf, np.log(self.noise), alike])
