"""What the planning page shows at a time: one period of the loop, or the last valid one.

A cloud and the forces that belong to it come by two ways. Shown together are those of one stamp. A
tip that is pressed beyond what the vademecum covers has no force any more, and the organ of that
period lies at rest with the tool in it. Nothing says what it would look like, so that the shape of
the last period with a force stays, marked as what it is, until the tool is lifted. Where there was
none, where nobody answers or an answer is of another organ, no number is written: zero is one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_ros.msg import ContactState

BEYOND = "the tool is beyond what the vademecum covers, too deep or off the accessible surface"
SILENT = "the contact node does not answer"
OTHER_ORGAN = "the contact node does not use this organ: it is preparing it, or has refused it"
PLACE = 10.0  # no tool of an organ is farther off; a step without a pose has it far away [m]


class ShownPeriod(NamedTuple):
    """Numbers beside the picture.

    tip : where the tool is drawn [m]
    force : of the organ [N]; fraction : of it, that the device gets
    error : of the force [N]; NaN if unknown
    largest : displacement [m]; NaN where no cloud comes
    missing : why there is no force; empty if there is one
    is_held : there is none, and force and displacement are those of the last valid period
    status : of avatar_ros/msg/ContactState
    band : that holds 90 % of what is known of the material, of the force [N]; None if not asked for
    """

    tip: np.ndarray
    force: np.ndarray
    error: float
    fraction: float
    largest: float
    missing: str = ""
    is_held: bool = False
    status: int = ContactState.STATUS_OK
    band: tuple[float, float] | None = None

    @staticmethod
    def without_force(tip: np.ndarray, missing: str) -> ShownPeriod:
        """Of a period of which nothing is known but where the tool is [m]."""
        return ShownPeriod(tip, np.zeros(3), np.nan, 1.0, np.nan, missing)

    @property
    def size(self) -> float:
        """Of the force that is felt now [N]; NaN if there is none."""
        return np.nan if self.missing else float(np.linalg.norm(self.force))


class PeriodChooser:
    """Takes each period that could be shown, and says what is.

    is_beyond : the tool is where the vademecum has no force
    """

    def __init__(self) -> None:
        self._valid: ShownPeriod | None = None  # the last with a force, while the tool is in
        self.is_beyond = False

    def forget(self) -> None:
        """Another organ: nothing of the last one is held."""
        self._valid, self.is_beyond = None, False

    def take(self, row: np.ndarray) -> bool:
        """Whether the cloud of a period is to be drawn; ``row`` as in the shared memory."""
        self.is_beyond = int(row["status"]) == ContactState.STATUS_OUT_OF_RANGE
        is_held = self.is_beyond and self._valid is not None
        if not is_held:
            self._valid = None  # until it is known what is drawn
        return not is_held

    def drawn(self, row: np.ndarray, largest: float, sent: np.ndarray) -> ShownPeriod:
        """What is shown, once the cloud was drawn or left as it was.

        largest : displacement of the cloud, if it was drawn [m]
        sent : pose that was sent last, for periods whose step did not use one [m]
        """
        used = row["tip"]
        tip = used.copy() if np.isfinite(used).all() and np.abs(used).max() < PLACE else sent
        if self.is_beyond and self._valid is not None:
            return self._valid._replace(tip=tip, missing=BEYOND, is_held=True)
        if self.is_beyond:
            return ShownPeriod.without_force(tip, BEYOND)
        touches = int(row["touches"]) > 0
        error = float(row["error"]) if touches else 0.0
        sent_fraction, status = float(row["sent_fraction"]), int(row["status"])
        now = ShownPeriod(tip, row["force"].copy(), error, sent_fraction, largest, status=status)
        if touches:
            self._valid = now
        return now
