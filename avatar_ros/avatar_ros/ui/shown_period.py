"""What the planning page shows at a time: one period of the loop, or the last valid one.

A cloud and the forces that belong to it come by two ways. Shown together are those of one stamp. A
tip that is pressed beyond what the vademecum covers has no force any more, and the organ of that
period lies as if this tool did not touch it. Nothing says what it would look like, so that the
shape of the last period with a force stays, marked as what it is, until the tool is lifted; with
it, the forces of all tools. Where there was none, where nobody answers or an answer is of another
organ, no number is written: zero is one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_ros.msg import ContactState

BEYOND = "the tool is beyond what the vademecum covers, too deep or off the accessible surface"
OTHER_BEYOND = "another tool is beyond what the vademecum covers"
SILENT = "the contact node does not answer"
OTHER_ORGAN = "the contact node does not use this organ: it is preparing it, or has refused it"
PLACE = 10.0  # no tool of an organ is farther off; a step without a pose has it far away [m]


class ShownPeriod(NamedTuple):
    """Numbers of one tool beside the picture.

    tip : where the tool is drawn [m]
    force : of the organ [N]; fraction : of it, that the device gets
    error : of the force [N]; NaN if unknown
    largest : displacement of the organ [m]; NaN where no cloud comes
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
    """Takes each period that could be shown, and says what is; of all tools, in their order.

    is_beyond : a tool is where the vademecum has no force
    """

    def __init__(self) -> None:
        self._valid: tuple[ShownPeriod, ...] = ()  # the last with a force, while a tool is in
        self.is_beyond = False

    def forget(self) -> None:
        """Another organ, or other tools: nothing of the last one is held."""
        self._valid, self.is_beyond = (), False

    def take(self, rows: np.ndarray) -> bool:
        """Whether the cloud of a period is to be drawn; ``rows`` as in the shared memory."""
        self.is_beyond = bool((rows["status"] == ContactState.STATUS_OUT_OF_RANGE).any())
        is_held = self.is_beyond and bool(self._valid)
        if not is_held:
            self._valid = ()  # until it is known what is drawn
        return not is_held

    def drawn(self, rows: np.ndarray, largest: float, sent: np.ndarray) -> tuple[ShownPeriod, ...]:
        """What is shown, once the cloud was drawn or left as it was.

        largest : displacement of the cloud, if it was drawn [m]
        sent : poses that were sent last, for periods whose step did not use one, (n_tools, 3) [m]
        """
        used = rows["tip"]
        is_placed = np.isfinite(used).all(axis=1) & (np.abs(used) < PLACE).all(axis=1)
        tips = np.where(is_placed[:, None], used, sent)
        if self.is_beyond:
            missing = why_missing(rows["status"])
            if self._valid:
                held = zip(self._valid, tips, missing, strict=True)
                return tuple(v._replace(tip=t, missing=why, is_held=True) for v, t, why in held)
            return tuple(map(ShownPeriod.without_force, tips, missing))
        now = tuple(_of_tool(row, tip, largest) for row, tip in zip(rows, tips, strict=True))
        if rows["touches"].any():
            self._valid = now
        return now


def why_missing(status: np.ndarray) -> list[str]:
    """Why each tool has no force where one is beyond what is covered; status : shape (n_tools,)"""
    beyond = status == ContactState.STATUS_OUT_OF_RANGE
    return [BEYOND if one else OTHER_BEYOND for one in beyond.tolist()]


def _of_tool(row: np.ndarray, tip: np.ndarray, largest: float) -> ShownPeriod:
    error = float(row["error"]) if int(row["touches"]) > 0 else 0.0
    fraction, status = float(row["sent_fraction"]), int(row["status"])
    return ShownPeriod(tip, row["force"].copy(), error, fraction, largest, status=status)
