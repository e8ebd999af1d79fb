"""What the planning page shows at a time: one period of the loop, or the last valid one.

A cloud and the forces that belong to it come by two ways. Shown together are those of one stamp. A
tip that is pressed beyond what the vademecum covers has no force any more, and the organ of that
period lies at rest with the tool in it. Nothing says what it would look like, so that the shape of
the last period with a force stays, marked as what it is, until the tool is lifted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_ros.msg import ContactState

_PLACE = 10.0  # no tool of an organ is farther off; a step without a pose has it far away [m]


class ShownPeriod(NamedTuple):
    """Numbers beside the picture.

    tip : where the tool is drawn [m]
    force : of the organ [N]; error : of it [N]; fraction : of it, that the device gets
    largest : displacement [m]; NaN where no cloud comes
    is_held : beyond the range; force and displacement are those of the last valid period
    band : that holds 90 % of what is known of the material, of the force [N]; None if not asked for
    """

    tip: np.ndarray
    force: np.ndarray
    error: float
    fraction: float
    largest: float
    is_held: bool
    band: tuple[float, float] | None = None


class PeriodChooser:
    """Takes each period that could be shown, and says what is."""

    def __init__(self) -> None:
        self._valid: ShownPeriod | None = None  # the last with a force, while the tool is in
        self.is_held = False

    def forget(self) -> None:
        """Another organ: nothing of the last one is held."""
        self._valid, self.is_held = None, False

    def take(self, row: np.ndarray) -> bool:
        """Whether the cloud of a period is to be drawn; ``row`` as in the shared memory."""
        out = int(row["status"]) == ContactState.STATUS_OUT_OF_RANGE
        self.is_held = out and self._valid is not None
        if not self.is_held:
            self._valid = None  # until it is known what is drawn
        return not self.is_held

    def drawn(self, row: np.ndarray, largest: float, sent: np.ndarray) -> ShownPeriod:
        """What is shown, once the cloud was drawn or left as it was.

        largest : displacement of the cloud, if it was drawn [m]
        sent : pose that was sent last, for periods whose step did not use one [m]
        """
        used = row["tip"]
        tip = used.copy() if np.isfinite(used).all() and np.abs(used).max() < _PLACE else sent
        if self.is_held and self._valid is not None:
            return self._valid._replace(tip=tip, is_held=True)
        error = float(row["error"])
        now = ShownPeriod(
            tip,
            row["force"].copy(),
            error if np.isfinite(error) else 0.0,
            float(row["sent_fraction"]),
            largest,
            is_held=False,
        )
        if int(row["touches"]) > 0:
            self._valid = now
        return now
