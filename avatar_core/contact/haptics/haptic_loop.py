"""A haptic loop to try forces on: a tool in a hand, its pose sampled, the answer late and held.

Along one axis, the organ below zero, a spring; the tool and the hand that grips it are linear,

    m x'' + b x' + k x = F + p,

F the organ's force and p the hand's push, both held over a period, so that the motion is exact: the
exponential of the matrix. So is the energy that the tool puts into the port, sum - F (x' - x).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from avatar_core.common.arrays import FloatArray
from avatar_core.common.jit import compiled
from avatar_core.contact.haptics.passivity import Passivity, limit
from avatar_core.contact.layout import PERIOD

FLOWN_OFF = 1.0  # [m] from the organ's surface, where a run ends


@dataclass(frozen=True)
class Device:
    """Tool and hand: mass [kg], damping of both [N s/m], stiffness of the grip [N/m]."""

    mass: float
    damping: float
    grip: float = 0.0

    def transition(self, period: float = PERIOD) -> tuple[FloatArray, FloatArray]:
        """(x, v) after a period: A (x, v) + B force, shapes (2, 2) and (2,)."""
        rate = np.zeros((3, 3))
        rate[0, 1] = 1.0
        rate[1] = np.array([-self.grip, -self.damping, 1.0]) / self.mass
        whole = expm(period * rate)
        return np.ascontiguousarray(whole[:2, :2]), np.ascontiguousarray(whole[:2, 2])


@dataclass(frozen=True)
class Loop:
    """A device on an organ of some stiffness [N/m], the force some periods late.

    resolution : step of the pose's readings [m]
    """

    device: Device
    stiffness: float
    delay: int
    resolution: float = 0.0


class Trace(NamedTuple):
    """What a loop did, period by period.

    position : x before each period [m]
    organ, held : the organ's force at x, and F, which the tool felt [N]
    energy : that the tool has put into the port, after each period [J]
    """

    position: FloatArray
    organ: FloatArray
    held: FloatArray
    energy: FloatArray


def run_loop(
    loop: Loop, push: FloatArray, start: float = 0.0, passivity: Passivity | None = None
) -> Trace:
    """The loop from rest at ``start`` under the hand's push, shape (n_periods,) [N]."""
    trace = Trace(*(np.zeros(len(push)) for _ in Trace._fields))
    transition = loop.device.transition(PERIOD)
    _run(*transition, loop.stiffness, loop.delay, loop.resolution, push, start, passivity, trace)
    return trace


def settling(loop: Loop, depth: float = 5e-3, offset: float = 1e-3, n: int = 4000) -> float:
    """Growth of a swing about a push into the organ: its last peaks over its first ones."""
    push = np.full(n, -loop.stiffness * depth)
    swing = np.abs(run_loop(loop, push, offset - depth).position + depth)
    return float(swing[-n // 4 :].max() / swing[: n // 4].max())


def stability_border(stiffness: float, delay: int, mass: float = 1.0) -> float:
    """Damping of a tool without grip at which its swings neither grow nor fade [N s/m].

    By bisection; near K (T / 2 + delay T) if m is large (Gil et al., J. Comput. Inf. Sci. Eng.
    9:011005, 2009), as is the damping that passivity asks for (Colgate & Schenkel, J. Robotic
    Systems 14:37, 1997).
    """
    low, high = 0.0, 4.0 * expected_border(stiffness, delay)
    while high - low > 1e-3 * high:
        middle = 0.5 * (low + high)
        if settling(Loop(Device(mass, middle), stiffness, delay)) > 1.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def expected_border(stiffness: float, delay: int) -> float:
    """K (T / 2 + delay T) [N s/m]."""
    return stiffness * PERIOD * (0.5 + delay)


@compiled()
def _run(  # type: ignore[no-untyped-def]
    a, b, stiffness, delay, resolution, push, x, passivity, trace
):
    tips, force, late = np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(delay + 1)
    v = energy = 0.0
    for k in range(push.shape[0]):
        read = np.round(x / resolution) * resolution if resolution > 0.0 else x
        trace.position[k], trace.organ[k] = x, stiffness * max(0.0, -read)
        tips[0, 2], force[0, 2] = read, trace.organ[k]
        if passivity is not None:
            limit(passivity, tips, force)
        late[k % (delay + 1)] = force[0, 2]
        held = late[(k + 1) % (delay + 1)]
        total = held + push[k]
        new = a[0, 0] * x + a[0, 1] * v + b[0] * total
        v = a[1, 0] * x + a[1, 1] * v + b[1] * total
        energy -= held * (new - x)
        x = new
        trace.held[k], trace.energy[k] = held, energy
        if abs(x) > FLOWN_OFF:
            for i in range(k + 1, push.shape[0]):
                trace.position[i], trace.energy[i] = x, energy
            break
