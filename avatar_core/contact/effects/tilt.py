"""A flat punch that leans: the torque that rights it, and the depth to which its edge sinks first.

The face of a punch of radius a leans off the surface by an angle with the sine s. Pressed by F into
a half-space it touches all over as long as t <= 1, and then at an edge only,

    t = 4 E* a^2 s / F,      Gamma = F^2 / (4 E* a) [1 - w(t)],      M = F a w'(t).

Gamma is the complementary energy. The depth of the punch's centre is dGamma/dF, and M is the torque
about it, -dGamma/ds. Touching all over, M = 4/3 E* a^3 s and the force is that of an upright punch
(Gladwell, Contact Problems in the Classical Theory of Elasticity, 1980): w = t^2 / 6. Beyond,

    w'(t) = 1 - 2/3 [1 + 3/4 (t - 1)]^(-2/3)

continues with the same value and slope. It ends like the contact of an edge: relative to a, the
contact reaches inwards as F^(2/3), so that M misses F a by t^(-2/3). Boundary elements have a
torque up to 1.6 % larger, at t = 1.9, and a depth of the edge within 0.5 % of a s.

s is the sine between the tool's axis and the mean of the surface's normals over a spacing of the
tip field. The mean makes the force continuous. Other tips do not respond to leaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast
from avatar_core.common.quantities import quantity
from avatar_core.common.splines import in_cell
from avatar_core.contact.effects.base import Effect, Ground, direction
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Tip

_UPRIGHT = 1e-9  # sine below which a punch does not lean


@dataclass(frozen=True)
class Tilt(Effect):
    """Flat punches lean by their poses, and are righted by a torque.

    Examples
    --------
    >>> punch = av.Tool("punch", av.Tip("flat", 5e-3))
    >>> len(av.Scene(tools=(punch,), effects=(av.effects.Tilt(),)).effects)
    1
    """

    name: ClassVar[str] = "tilt"
    text: ClassVar[str] = "a flat punch that leans touches with its edge and is righted by a torque"

    Constants: ClassVar[Any] = kind(
        "Tilt",
        shaft=array("3"),  # from tip to shaft in the frame of the poses
        punch=array("T"),  # a, 0 for tips that are not flat [m]
        normals=array("3 x y z", np.float32),  # surface normals on the grid of the tip field
    )
    State: ClassVar[Any] = kind(
        "TiltState",
        gradient=array("3 3"),  # scratch
        sine=array("T"),  # s
        cosine=array("T", start=1.0),
        across=array("T 3"),  # axis x normal
        rise=array("T 3"),  # gradient of the cosine [1/m]
    )

    axis: tuple[float, ...] = quantity(
        "-", -1e3, 1e3, "axis of the tools in the frame of their poses, from the tip to the "
                        "shaft",
        (0.0, 0.0, -1.0),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", direction(self.axis, self.name, "axis"))

    @staticmethod
    def require_flat(tips: Sequence[Tip]) -> None:
        """Raise SceneError if no tip is flat."""
        if all(tip.shape != "flat" for tip in tips):
            raise SceneError("tilt: no tool has a flat tip; give one, or leave tilt out")

    def lay_out(self, ground: Ground) -> Any:
        """Return the tools' axis, radii of flat punches and the surface's normals."""
        # Here, because the contact node needs none of it.
        from avatar_core.vademecum.tip_field import grid_normals

        self.require_flat(ground.tips)
        field = ground.vademecum.tip_field
        normals = grid_normals(field.distance, float(field.spacing[0]))
        return self.Constants(
            np.array(self.axis),
            np.array([tip.radius if tip.shape == "flat" else 0.0 for tip in ground.tips]),
            np.ascontiguousarray(np.moveaxis(normals, -1, 0), np.float32),
        )


@fast
def sample_tilt(model, data, t, cell):  # type: ignore[no-untyped-def]
    """Compute a tip's lean; return its edge's depth below the centre of its face, a s [m]."""
    tilt, punches = data.tilt, model.tilt
    if not model.tilt.on:
        return 0.0
    tilt.sine[t], tilt.cosine[t] = 0.0, 1.0
    e, slope = data.axis[t], tilt.gradient
    if punches.punch[t] == 0.0 or e[0] ** 2 + e[1] ** 2 + e[2] ** 2 == 0.0:
        return 0.0
    x = in_cell(punches.normals[0], cell, slope[0])
    y = in_cell(punches.normals[1], cell, slope[1])
    z = in_cell(punches.normals[2], cell, slope[2])
    part = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-6)
    x, y, z = part * x, part * y, part * z
    cosine, across = e[0] * x + e[1] * y + e[2] * z, tilt.across[t]
    across[0], across[1] = e[1] * z - e[2] * y, e[2] * x - e[0] * z
    across[2] = e[0] * y - e[1] * x
    for d in range(3):
        turned = (e[0] - cosine * x) * slope[0, d] + (e[1] - cosine * y) * slope[1, d]
        tilt.rise[t, d] = part * (turned + (e[2] - cosine * z) * slope[2, d])
    sine = np.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2)
    if sine > _UPRIGHT:
        tilt.sine[t] = sine
    tilt.cosine[t] = cosine
    return punches.punch[t] * tilt.sine[t]


@fast
def _righting(ratio):  # type: ignore[no-untyped-def]
    """Return w'(t), the torque over F a."""
    if ratio <= 1.0:
        return ratio / 3.0
    return 1.0 - 2.0 / 3.0 * (1.0 + 0.75 * (ratio - 1.0)) ** (-2.0 / 3.0)


@fast
def evaluate_tilt(model, data, t, load):  # type: ignore[no-untyped-def]
    """Return the changes by leaning of the lowest point's depth, its slope and the stored energy.

    They are a depth [m], its derivative by the load F / E* [1/m], and an energy over E* [m^3].
    """
    if not model.tilt.on:
        return 0.0, 0.0, 0.0
    a, edge = model.tilt.punch[t], model.tilt.punch[t] * data.tilt.sine[t]
    if edge == 0.0 or load <= 0.0:
        return 0.0, 0.0, 0.0
    ratio = 4.0 * a * edge / load
    if ratio <= 1.0:
        return edge, 0.0, 2.0 / 3.0 * a * edge * edge
    first = _righting(ratio)
    root = (1.0 + 0.75 * (ratio - 1.0)) ** (1.0 / 3.0)
    w = ratio - 5.0 / 6.0 - 8.0 / 3.0 * (root - 1.0)
    second = 1.0 / (3.0 * root**5)
    scale = 0.25 / a
    depth = edge - scale * load * (2.0 * w - ratio * first)
    slope = -scale * (2.0 * (w - ratio * first) + ratio * ratio * second)
    return depth, slope, scale * load * load * (ratio * first - w)


@fast
def add_righting(model, data, t, stiffness, elastic, relaxed):  # type: ignore[no-untyped-def]
    """Add the torque that rights a tip, and its force towards less lean: -M ds.

    stiffness : E* [Pa]
    elastic : F on an elastic organ [N]
    relaxed : fraction of it that is left
    """
    tilt = data.tilt
    if not model.tilt.on:
        return
    a, sine = model.tilt.punch[t], tilt.sine[t]
    if sine == 0.0 or elastic <= 0.0 or tilt.cosine[t] <= 0.0:
        return
    ratio = 4.0 * stiffness * a * a * sine / elastic
    factor = relaxed * elastic * a * _righting(ratio) * tilt.cosine[t] / sine
    for d in range(3):
        data.out.force[t, d] += factor * tilt.rise[t, d]
        data.out.torque[t, d] += factor * tilt.across[t, d]
