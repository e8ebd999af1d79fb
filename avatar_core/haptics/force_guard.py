"""Limits on the force of a tool: magnitude, slew rate, soft engagement, ramp to zero after faults.

The organ's force f_k is sent as F_k. While the poses are valid,

    F_k = F_k-1 + clip(g_k clip(f_k, F_max) - F_k-1, S dt),    clip(v, m) = v min(1, m / |v|),

with F_max the largest force, S the largest slew rate and g the engagement. g is 0 until poses have
been valid for ``SETTLING``, then grows to 1 over ``ENGAGEMENT``. After a fault at t_0,

    F(t) = F(t_0) max(0, 1 - (t - t_0) / RAMP),

independent of S and to its end, even if poses are valid again in the meantime. A fault therefore
costs at least RAMP, SETTLING and ENGAGEMENT, and no force returns at once. In ordinary use F = f,
bit by bit: sliding and pressing reach neither limit.

Torque is scaled like its force. It changes no faster than the torque of a force at ``LEVER``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ContactError

SETTLING = 50e-3  # time time of valid poses before the force returns [s]
ENGAGEMENT = 100e-3  # from no force to all of it [s]
RAMP = 8e-3  # from a force to none; within 10 ms even if a period is late [s]
LEVER = 20e-3  # radius of the largest tip: a torque may change by S LEVER a second [m]
_LONGEST = 2e-3  # period for the slew limit, at most [s]


@dataclass(frozen=True)
class ForceLimits:
    """Largest force [N] and slew rate [N/s] of a device.

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


# Largest forces by the makers' data sheets; the slew rate reaches them within 5 ms.
DEVICES = {
    "touch": ForceLimits(3.3, 660.0),  # 3D Systems Touch
    "omega": ForceLimits(12.0, 2400.0),  # Force Dimension omega.3, omega.6, omega.7
    "sigma": ForceLimits(20.0, 4000.0),  # Force Dimension sigma.7
}


class ForceGuard:
    """The force on one tool, limited in every period.

    Attributes
    ----------
    sent_fraction : float
        Sent fraction |F| / |f| of the organ's force; 1 if that is zero.
    limited : bool
        Whether a limit is active.
    """

    def __init__(self, limits: ForceLimits) -> None:
        self.limits = limits
        self.sent_fraction = 1.0
        self.limited = False
        self._sent = [0.0] * 6  # force and torque of the last period
        self._falling = [0.0] * 6  # at the moment of the fault
        self._fault = -math.inf  # when [s]
        self._sound = math.inf  # since when [s]
        self._last = -math.inf  # period [s]

    @property
    def engaged(self) -> bool:
        """Whether engagement is complete and only limits act. Real-time safe."""
        return self._last - self._sound >= SETTLING + ENGAGEMENT

    @property
    def silent(self) -> bool:
        """Whether nothing is sent. Real-time safe."""
        return not any(self._sent)

    def update(
        self, now: float, sound: bool, force: FloatArray, torque: FloatArray, share: float = 1.0
    ) -> None:
        """Turn the organ's force and torque, shape (3,), into those to send, in place.

        Real-time safe: neither raises nor blocks. A force that is not finite is a fault.

        Parameters
        ----------
        now : float
            Time of any steady clock [s].
        sound : bool
            Whether the tool's pose is valid.
        force : ndarray, shape (3,)
            Force [N].
        torque : ndarray, shape (3,)
            Torque [N m].
        share : float
            This force over the computed one, which other limits reduced.
        """
        period, self._last = min(max(now - self._last, 0.0), _LONGEST), now
        x, y, z = float(force[0]), float(force[1]), float(force[2])
        size = math.hypot(x, y, z)
        turn = math.hypot(float(torque[0]), float(torque[1]), float(torque[2]))
        if not (sound and math.isfinite(size + turn)):
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
        sent_of_this = math.hypot(*sent[:3]) / size if 0.0 < size < math.inf else 1.0
        self.sent_fraction = share * sent_of_this

    def _fail(self, now: float) -> None:
        """Start the ramp, unless the ramp of an earlier fault is under way."""
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
        """Approach the limited force, and the torque, as fast as the slew rate allows."""
        largest = self.limits.force
        if size > largest:
            gain *= largest / size
        wanted = [gain * float(value) for value in (*force, *torque)]
        last = self._sent
        change = max(math.dist(wanted[:3], last[:3]), math.dist(wanted[3:], last[3:]) / LEVER)
        step = self.limits.slew * period
        part = step / change if change > step else 1.0
        self.limited = size > largest or part < 1.0
        if part < 1.0:
            wanted = [old + part * (new - old) for old, new in zip(last, wanted, strict=True)]
        self._sent = wanted
