"""Breathing: the organ's frame and clamp move, the tool stays in the world's frame.

    x(t) = A e (1 - cos^2n(pi t / T)),    p in the organ's frame = p in the world's - x(t)

starting at the end of exhalation (Lujan et al., Medical Physics 26:715, 1999). Its acceleration
(12 mm in 4 s: 0.03 m/s^2) is 0.3 % of gravity and neglected.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect, direction


@dataclass(frozen=True)
class Respiration(Effect):
    """The organ and its clamp move with the breath; the tool stays in the world's frame."""

    name: ClassVar[str] = "respiration"
    text: ClassVar[str] = "the organ moves with the breath"

    period: float = quantity("s", 0.5, 60.0, "of a breath", 4.0)
    amplitude: float = quantity("m", 0.0, 0.05, "from breath out to breath in", 0.012)
    axis: tuple[float, ...] = quantity(
        "-", -1e3, 1e3, "of breath in, in the organ's frame (RAS, caudal: 0 0 -1)", (0.0, 0.0, -1.0)
    )
    dwell: int = quantity("-", 1, 10, "n, how long the breath stays out", 3)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", direction(self.axis, self.name, "axis"))


RespirationArrays = namedtuple("RespirationArrays", ["stroke", "timing"])
RespirationState = namedtuple(
    "RespirationState",
    [
        "stroke",  # (3,) A e [m]
        "timing",  # (3,) period of the breath [s], n, period of the step [s]
        "clock",  # (1,) time since the end of exhalation [s]
        "shift",  # (3,) x(t) [m]
    ],
)


def respiration_arrays(effect: Respiration, period: float) -> RespirationArrays:
    """Constant arrays for steps of a period [s]."""
    return RespirationArrays(
        effect.amplitude * np.array(effect.axis),
        np.array([effect.period, float(effect.dwell), period]),
    )


def respiration_state(arrays: RespirationArrays) -> RespirationState:
    """State at the end of exhalation."""
    return RespirationState(*arrays, np.zeros(1), np.zeros(3))


@inlined
def to_organ_frame(respiration, tips):  # type: ignore[no-untyped-def]
    """Advance the breath by a period, and transform the tips to the organ's frame."""
    if not respiration.on:
        return
    period = respiration.timing[0]
    respiration.clock[0] = (respiration.clock[0] + respiration.timing[2]) % period
    out = np.cos(np.pi * respiration.clock[0] / period) ** 2
    inhaled = 1.0 - out ** respiration.timing[1]
    for d in range(3):
        respiration.shift[d] = inhaled * respiration.stroke[d]
        for t in range(tips.shape[0]):
            tips[t, d] -= respiration.shift[d]


@inlined
def to_world_frame(respiration, out):  # type: ignore[no-untyped-def]
    """Contacts back to the world's frame; the frames do not rotate, so forces stay the same."""
    if not respiration.on:
        return
    for i in range(out.n_contacts[0]):
        for d in range(3):
            out.contact_position[i, d] += respiration.shift[d]


@fast
def shift_cloud(respiration, cloud):  # type: ignore[no-untyped-def]
    """Deformed positions to the world's frame; displacements stay relative to the organ."""
    if not respiration.on:
        return
    x, y, z = (
        np.float32(respiration.shift[0]),
        np.float32(respiration.shift[1]),
        np.float32(respiration.shift[2]),
    )
    for v in range(cloud.shape[0]):
        cloud[v, 0] += x
        cloud[v, 1] += y
        cloud[v, 2] += z
