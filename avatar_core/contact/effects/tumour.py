"""A tumour: another stiffness inside a second surface. It acts through the vademecum alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect
from avatar_core.errors import SceneError

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class Tumour(Effect):
    """The tumour is stiffer, or softer, than the organ around it.

    Examples
    --------
    >>> av.effects.Tumour(contrast=5.0).contrast
    5.0
    """

    name: ClassVar[str] = "tumour"
    text: ClassVar[str] = "the tumour has a stiffness of its own"

    contrast: float | None = quantity(
        "-",
        0.01,
        100.0,
        "Young's modulus inside over that outside; by default the file's own",
        None,
    )

    def require(self, vademecum: Vademecum) -> None:
        """Refuse a vademecum without a tumour, or without the contrast."""
        coordinates = vademecum.parametric.coordinates if vademecum.parametric else ()
        ranges = [(c.low, c.high) for c in coordinates if c.name == "contrast"]
        if not ranges and vademecum.contrast is None:
            raise SceneError(
                "tumour: the vademecum has none; build one with 'avatar vademecum SURFACE "
                "--tumour FILE --coordinate contrast=0.5:20'"
            )
        own = vademecum.contrast or 1.0
        low, high = ranges[0] if ranges else (own, own)
        if self.contrast is not None and not low <= self.contrast <= high:
            raise SceneError(
                f"tumour: contrast is {self.contrast:g}, the vademecum holds {low:g} to {high:g}; "
                "build one with another --coordinate contrast=LOW:HIGH"
            )

    def adapted(self, vademecum: Vademecum) -> Vademecum:
        """Return the vademecum at the contrast of the effect; unchanged if it does not cover it."""
        coordinates = vademecum.parametric.coordinates if vademecum.parametric else ()
        ranges = [(c.low, c.high) for c in coordinates if c.name == "contrast"]
        contrast = self.contrast
        if (
            contrast is None
            or contrast == vademecum.contrast
            or not any(low <= contrast <= high for low, high in ranges)
        ):
            return vademecum
        return vademecum.at(contrast=contrast)
