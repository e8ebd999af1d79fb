"""The base class of effects: a name, checked quantities, requirements on the vademecum."""

from __future__ import annotations

import math
from abc import ABC
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from avatar_core.common.quantities import check_numbers
from avatar_core.errors import SceneError

if TYPE_CHECKING:
    import numpy as np

    from avatar_core.contact.organ_response import TipResponse
    from avatar_core.geometry.tip import Tip
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class Ground:
    """The inputs from which an effect lays out its arrays.

    vademecum : vademecum after adaptation by the scene's effects
    tips, effects : tips and effects of the scene
    response : response of the organ, on the grid of its tip field
    n_modes : number of modes of the contact compliance, with the zero modes that fill up a row
    reach : longest distance between the two positions of a block of the near field [m]
    large_start : ndarray, shape (n_regions + 1,), first mode of large deformation of each region,
        among those of the cloud
    period : period of the steps [s]
    """

    vademecum: Vademecum
    tips: Sequence[Tip]
    effects: Sequence[Effect]
    response: TipResponse
    n_modes: int
    reach: float
    large_start: np.ndarray
    period: float


@dataclass(frozen=True)
class Effect(ABC):
    """One physical effect with its parameters, all in SI units.

    Attributes
    ----------
    Constants : ClassVar[Any]
        Kind of the effect's arrays that a step reads; None if it acts through the vademecum.
    State : ClassVar[Any]
        Kind of the arrays that it keeps between steps, and its scratch; None if it has none.
    superposed : ClassVar[bool]
        Whether the displacement of a tip follows from all loads and histories together.
    moving : ClassVar[bool]
        Whether it moves the organ beyond the present loads.

    Raises
    ------
    SceneError
        For a number out of its range, or numbers that contradict each other.

    Examples
    --------
    >>> isinstance(av.effects.Friction(), av.effects.Effect)
    True
    """

    name: ClassVar[str]
    text: ClassVar[str]  # its purpose, one line
    Constants: ClassVar[Any] = None
    State: ClassVar[Any] = None
    superposed: ClassVar[bool] = False
    moving: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_numbers(self, f"{self.name}.")

    def require(self, vademecum: Vademecum) -> None:  # noqa: B027 (most need nothing)
        """Refuse a vademecum that cannot serve the effect.

        Raises
        ------
        SceneError
            Naming the command that builds one.
        """

    @classmethod
    def example(cls) -> Effect:
        """Return an example, under which a tip that slides 5 mm deep stays in touch."""
        return cls()

    def adapted(self, vademecum: Vademecum) -> Vademecum:
        """Return the vademecum in the modes, or at the values, that the effect needs."""
        return vademecum

    def lay_out(self, ground: Ground) -> Any:
        """Return the arrays of ``Constants``."""
        return self.Constants()

    @staticmethod  # noqa: B027 (most begin at zero)
    def begin(model: Any, state: Any) -> None:
        """Set the state of an organ at rest where it differs from the first values."""


_E = TypeVar("_E", bound=Effect)


def find(effects: Sequence[Effect], kind: type[_E]) -> _E | None:
    """Return the effect of a kind, if it was chosen."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)


def direction(values: tuple[float, ...], owner: str, key: str) -> tuple[float, float, float]:
    """Return three numbers as a unit vector; a unit vector stays the same bit by bit."""
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
            "vademecum SURFACE' and at least 36 modes (patients: --fidelity solved)"
        )
