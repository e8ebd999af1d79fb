"""The base class of effects: a name, checked quantities, requirements on the vademecum."""

from __future__ import annotations

import math
from abc import ABC
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from avatar_core.common.quantities import check_numbers
from avatar_core.errors import SceneError

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class Effect(ABC):
    """One physical effect with its parameters, all in SI units.

    Raises
    ------
    SceneError
        For a number out of its range, or numbers that contradict each other.
    """

    name: ClassVar[str]
    text: ClassVar[str]  # what it does, one line

    def __post_init__(self) -> None:
        check_numbers(self, f"{self.name}.")

    def require(self, vademecum: Vademecum) -> None:  # noqa: B027 (most need nothing)
        """Refuse a vademecum that cannot serve the effect.

        Raises
        ------
        SceneError
            Naming the command that builds one.
        """


def direction(values: tuple[float, ...], owner: str, key: str) -> tuple[float, float, float]:
    """Three numbers as a unit vector; a unit vector stays the same bit by bit."""
    largest = max(map(abs, values)) if len(values) == 3 else 0.0
    if largest == 0.0:
        raise SceneError(f"{owner}.{key} is {list(values)}; give three numbers, not all zero")
    x, y, z = values
    if abs(math.hypot(x, y, z) - 1.0) > 1e-12:
        x, y, z = x / largest, y / largest, z / largest  # squares of tiny numbers are zero
        length = math.hypot(x, y, z)
        x, y, z = x / length, y / length, z / length
    return (x, y, z)


def require_body(vademecum: Vademecum, effect: str) -> None:
    """Refuse a vademecum without the mass of the organ."""
    if vademecum.body is None:
        raise SceneError(
            f"{effect}: the vademecum does not know the organ's mass; build it again with 'avatar "
            "vademecum SURFACE' and at least 36 modes (patients: --fidelity full)"
        )
