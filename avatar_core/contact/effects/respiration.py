"""Breathing: the organ's frame and clamp move, the tool stays in the world's frame.

    x(t) = A e (1 - cos^2n(pi t / T)),    p in the organ's frame = p in the world's - x(t)

starting at the end of exhalation (Lujan et al., Medical Physics 26:715, 1999). Its acceleration
(12 mm in 4 s: 0.03 m/s^2) is 0.3 % of gravity and neglected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast, inlined
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect, Ground, direction


@dataclass(frozen=True)
class Respiration(Effect):
    """The organ and its clamp move with the breath; the tool stays in the world's frame.

    Examples
    --------
    >>> av.effects.Respiration(period=5.0, amplitude=10e-3).axis
    (0.0, 0.0, -1.0)
    """

    name: ClassVar[str] = "respiration"
    text: ClassVar[str] = "the organ moves with the breath"

    Constants: ClassVar[Any] = kind(
        "Respiration",
        stroke=array("3"),  # A e [m]
        timing=array("3"),  # period of the breath [s], n, period of the step [s]
    )
    State: ClassVar[Any] = kind(
        "RespirationState",
        clock=array("1"),  # time since the end of exhalation [s]
        shift=array("3"),  # x(t) [m]
    )

    period: float = quantity("s", 0.5, 60.0, "period of a breath", 4.0)
    amplitude: float = quantity("m", 0.0, 0.05, "from breath out to breath in", 0.012)
    axis: tuple[float, ...] = quantity(
        "-",
        -1e3,
        1e3,
        "direction of breath in, in the organ's frame (RAS, caudal: 0 0 -1)",
        (0.0, 0.0, -1.0),
    )
    dwell: int = quantity("-", 1, 10, "n, how long the breath stays out", 3)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", direction(self.axis, self.name, "axis"))

    @classmethod
    def example(cls) -> Respiration:
        """Return a breath to measure and test."""
        return cls(amplitude=1e-3)

    def lay_out(self, ground: Ground) -> Any:
        """Return stroke and timing of the breath."""
        return self.Constants(
            self.amplitude * np.array(self.axis),
            np.array([self.period, float(self.dwell), ground.period]),
        )


@inlined
def to_organ_frame(model, data):  # type: ignore[no-untyped-def]
    """Advance the breath by a period, and transform the tips to the organ's frame."""
    breath, breathing = data.respiration, model.respiration
    if not model.respiration.on:
        return
    period = breathing.timing[0]
    breath.clock[0] = (breath.clock[0] + breathing.timing[2]) % period
    out = np.cos(np.pi * breath.clock[0] / period) ** 2
    inhaled = 1.0 - out ** breathing.timing[1]
    for d in range(3):
        breath.shift[d] = inhaled * breathing.stroke[d]
        for t in range(data.tip.shape[0]):
            data.tip[t, d] -= breath.shift[d]


@inlined
def to_world_frame(model, data):  # type: ignore[no-untyped-def]
    """Move contacts back to the world's frame; frames do not rotate, so forces stay the same."""
    if not model.respiration.on:
        return
    for i in range(data.out.n_contacts[0]):
        for d in range(3):
            data.out.contact_position[i, d] += data.respiration.shift[d]


@fast
def shift_cloud(model, data):  # type: ignore[no-untyped-def]
    """Move deformed positions to the world's frame; displacements stay relative to the organ."""
    breath = data.respiration
    if not model.respiration.on:
        return
    cloud = data.out.cloud
    x, y, z = (
        np.float32(breath.shift[0]),
        np.float32(breath.shift[1]),
        np.float32(breath.shift[2]),
    )
    for v in range(cloud.shape[0]):
        cloud[v, 0] += x
        cloud[v, 1] += y
        cloud[v, 2] += z
