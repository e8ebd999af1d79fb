"""A force guard without limits, for tests of the steps before it."""

from __future__ import annotations

from typing import Any

from avatar_core.haptics.force_guard import DEVICES


class UnlimitedGuard:
    """Replacement for ForceGuard."""

    def __init__(self) -> None:
        self.limits, self.sent_fraction, self.limited = DEVICES["sigma"], 1.0, False
        self.engaged = self.silent = True

    def update(self, now: float, sound: bool, force: Any, torque: Any, share: float = 1.0) -> None:
        if not sound:
            force[:] = torque[:] = 0.0
