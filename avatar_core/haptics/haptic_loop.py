"""A simulated haptic loop in one dimension: tool, operator's grip, sampling, delay and hold.

The organ is a spring below zero; the tool and the operator's grip are linear,

    m x'' + b x' + k x = F + p,

with F the organ's force and p the operator's push. Both are constant over a period. The matrix
exponential therefore gives the motion exactly, and the energy that the tool puts into the port, sum
- F (x' - x).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from avatar_core.common.arrays import FloatArray
from avatar_core.common.jit import compiled
from avatar_core.contact.layout import PERIOD
from avatar_core.errors import ContactError
from avatar_core.haptics.passivity import Passivity, limit

MAX_POSITION = 1.0  # [m] from the organ's surface; a run that exceeds it has diverged and ends


@dataclass(frozen=True)
class Device:
    """Tool and grip: mass [kg], damping [N s/m], stiffness of the operator's grip [N/m]."""

    mass: float
    damping: float
    grip: float = 0.0

    def transition(self, period: float = PERIOD) -> tuple[FloatArray, FloatArray]:
        """Return (x, v) after a period: A (x, v) + B force, shapes (2, 2) and (2,)."""
        rate = np.zeros((3, 3))
        rate[0, 1] = 1.0
        rate[1] = np.array([-self.grip, -self.damping, 1.0]) / self.mass
        whole = expm(period * rate)
        return np.ascontiguousarray(whole[:2, :2]), np.ascontiguousarray(whole[:2, 2])


@dataclass(frozen=True)
class Loop:
    """A device on an organ.

    Attributes
    ----------
    stiffness : float
        Stiffness of the organ [N/m].
    delay : int
        Delay of the force [periods].
    resolution : float
        Quantisation step of the pose [m].
    """

    device: Device
    stiffness: float
    delay: int
    resolution: float = 0.0


class Trace(NamedTuple):
    """The course of a loop, period by period.

    position : ndarray, x before each period [m]
    organ, held : ndarray, the organ's force at x, and F, which acts on the tool [N]
    energy : ndarray, energy that the tool has put into the port, after each period [J]
    """

    position: FloatArray
    organ: FloatArray
    held: FloatArray
    energy: FloatArray


def run_loop(
    loop: Loop, push: FloatArray, start: float = 0.0, passivity: Passivity | None = None
) -> Trace:
    """Run the loop from rest at ``start`` under the operator's push, shape (n_periods,) [N]."""
    trace = Trace(*(np.zeros(len(push)) for _ in Trace._fields))
    transition = loop.device.transition(PERIOD)
    _run(*transition, loop.stiffness, loop.delay, loop.resolution, push, start, passivity, trace)
    return trace


def oscillation_growth(
    loop: Loop, depth: float = 5e-3, offset: float = 1e-3, n: int = 4000
) -> float:
    """Return the growth of an oscillation about a constant push: last peaks over first ones."""
    push = np.full(n, -loop.stiffness * depth)
    deviation = np.abs(run_loop(loop, push, offset - depth).position + depth)
    return float(deviation[-n // 4 :].max() / deviation[: n // 4].max())


def stability_border(stiffness: float, delay: int, mass: float = 1.0) -> float:
    """Return damping of a tool without grip at which oscillations neither grow nor decay [N s/m].

    Bisection finds it to 0.1 %. It is near K (T / 2 + delay T) if m is large (Gil et al., J.
    Comput. Inf. Sci. Eng. 9:011005, 2009). So is the damping that passivity requires (Colgate &
    Schenkel, J. Robotic Systems 14:37, 1997).

    Raises
    ------
    ContactError
        If oscillations grow even at four times that damping.
    """
    low, high = 0.0, 4.0 * expected_border(stiffness, delay)
    if oscillation_growth(Loop(Device(mass, high), stiffness, delay)) > 1.0:
        raise ContactError(f"no stable damping up to {high:g} N s/m; give a larger mass")
    while high - low > 1e-3 * high:
        middle = 0.5 * (low + high)
        if oscillation_growth(Loop(Device(mass, middle), stiffness, delay)) > 1.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def expected_border(stiffness: float, delay: int) -> float:
    """Return K (T / 2 + delay T) [N s/m]."""
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
        if abs(x) > MAX_POSITION:
            for i in range(k + 1, push.shape[0]):
                trace.position[i], trace.energy[i] = x, energy
            break
