"""What a tool may feel: limits on size and slew, soft engagement, and none at all after a fault.

The organ's force f_k is sent as F_k. While the poses are sound,

    F_k = F_k-1 + clip(g_k clip(f_k, F_max) - F_k-1, S dt),    clip(v, m) = v min(1, m / |v|),

F_max the largest force, S the largest slew, g the engagement: 0 until the poses were sound for
``SETTLING``, then growing to 1 over ``ENGAGEMENT``. From a fault on, at t_0,

    F(t) = F(t_0) max(0, 1 - (t - t_0) / RAMP),

whatever S is, to the end, even if the poses are sound again meanwhile. So a fault costs at least
RAMP, SETTLING and ENGAGEMENT, and no force ever comes back at once. In ordinary use F = f to the
bit: a sliding or pressing tool reaches neither limit.

Torque takes the share of its force.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ContactError

SETTLING = 50e-3  # sound poses before a force comes back [s]
ENGAGEMENT = 100e-3  # from none to all of it [s]
RAMP = 8e-3  # from a force to none; with a late period it is over within 10 ms [s]
_LONGEST = 2e-3  # a period that took longer gives no more slew than this [s]


@dataclass(frozen=True)
class ForceLimits:
    """What a device is asked for at most: size [N] and slew [N/s].

    Raises
    ------
    ContactError
        For a limit that is not positive.
    """

    force: float
    slew: float

    def __post_init__(self) -> None:
        for name, value in (("force", self.force), ("slew", self.slew)):
            if not value > 0.0:
                raise ContactError(f"largest {name} is {value:g}; it must be positive")


# Largest forces by the makers' data sheets; all of it may come within 5 ms.
DEVICES = {
    "touch": ForceLimits(3.3, 660.0),  # 3D Systems Touch
    "omega": ForceLimits(12.0, 2400.0),  # Force Dimension omega.3, omega.6, omega.7
    "sigma": ForceLimits(20.0, 4000.0),  # Force Dimension sigma.7
}


class ForceGuard:
    """The force on one tool, from the organ's to what is sent; updated every period.

    share : |F| / |f|, of the organ's force that is sent; 1 where there is none
    limited : whether a limit made the difference
    """

    def __init__(self, limits: ForceLimits) -> None:
        self.limits = limits
        self.share = 1.0
        self.limited = False
        self._sent = [0.0] * 6  # force and torque of the last period
        self._falling = [0.0] * 6  # of the moment of the fault
        self._fault = -math.inf  # when [s]
        self._sound = math.inf  # since when [s]
        self._last = -math.inf  # period [s]

    @property
    def engaged(self) -> bool:
        """Whether all of the force is let through, but for the limits."""
        return self._last - self._sound >= SETTLING + ENGAGEMENT

    @property
    def silent(self) -> bool:
        """Whether nothing is sent."""
        return not any(self._sent)

    def update(self, now: float, sound: bool, force: FloatArray, torque: FloatArray) -> None:
        """Turn the organ's force and torque, shape (3,), into those to send, in place.

        Real-time safe: it neither raises nor blocks. A force that is not finite is a fault.

        now : any steady clock [s]; sound : whether the tool's pose can be answered
        """
        period, self._last = min(max(now - self._last, 0.0), _LONGEST), now
        x, y, z = float(force[0]), float(force[1]), float(force[2])
        size = math.hypot(x, y, z)
        if not (sound and math.isfinite(size)):
            self._fail(now)
        elif math.isinf(self._sound):
            self._sound = now
        if now - self._sound < SETTLING:
            self._fall(now)
        else:
            gain = min((now - self._sound - SETTLING) / ENGAGEMENT, 1.0)
            self._follow(gain, size, (x, y, z), torque, period)
        sent = self._sent
        force[0], force[1], force[2] = sent[0], sent[1], sent[2]
        torque[0], torque[1], torque[2] = sent[3], sent[4], sent[5]
        self.share = math.hypot(*sent[:3]) / size if 0.0 < size < math.inf else 1.0

    def _fail(self, now: float) -> None:
        """A fault while another's ramp is under way starts none anew."""
        if now - self._sound >= SETTLING:
            self._fault = now
            self._falling = self._sent
        self._sound = math.inf

    def _fall(self, now: float) -> None:
        left = max(0.0, 1.0 - (now - self._fault) / RAMP)
        self._sent = [left * value for value in self._falling]
        self.limited = False

    def _follow(
        self,
        gain: float,
        size: float,
        force: tuple[float, float, float],
        torque: FloatArray,
        period: float,
    ) -> None:
        """Go to the limited force as fast as the slew allows."""
        most = self.limits.force
        if size > most:
            gain *= most / size
        x, y, z = (gain * value for value in force)
        last = self._sent
        change = math.hypot(x - last[0], y - last[1], z - last[2])
        step = self.limits.slew * period
        part = 1.0
        if change > step:
            part = step / change
            x, y, z = (
                old + part * (new - old) for old, new in zip(last[:3], (x, y, z), strict=True)
            )
        self.limited = size > most or part < 1.0
        a, b, c = (gain * float(value) for value in torque)
        if part < 1.0:
            a, b, c = (
                old + part * (new - old) for old, new in zip(last[3:], (a, b, c), strict=True)
            )
        self._sent = [x, y, z, a, b, c]
