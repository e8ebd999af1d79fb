"""What the planning page shows at a time: one period of the loop, or the last valid one.

A cloud and the forces that belong to it come by two ways. Shown together are those of one stamp. A
step computes no force for a tool whose poses it does not use, as they are too slow, and for a tip
beyond what the vademecum covers. The organ of that period lies as if this tool did not touch it.
The shape of the last period with a force therefore stays, marked as what it is, until the force is
known again; with it, the forces of all tools. Where there was none, where nobody answers or an
answer is of another organ, no number is written: zero is one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_core.contact.status import PLACED
from avatar_ros.loop.statuses import explanation
from avatar_ros.msg import ContactState

OTHER_UNKNOWN = "another tool's force is not known"
SILENT = "nothing comes from the contact node through the tool driver of this page"
OTHER_ORGAN = "the contact node does not use this organ: it is preparing it, or has refused it"
PLACE = 10.0  # no tool of an organ is farther off; a step without a pose has it far away [m]


class ShownPeriod(NamedTuple):
    """Numbers of one tool beside the picture.

    tip : where the tool is drawn [m]
    force : of the organ [N], before the limits for a device: the page has none
    error : of the force [N]; NaN if unknown
    largest : displacement of the organ [m]; NaN where no cloud comes
    missing : why there is no force; empty if there is one
    is_held : there is none, and force and displacement are those of the last valid period
    status : of avatar_ros/msg/ContactState
    holds : whether its jaw holds tissue
    band : that holds 90 % of what is known of the material, of the force [N]; None if not asked for
    """

    tip: np.ndarray
    force: np.ndarray
    error: float
    largest: float
    missing: str = ""
    is_held: bool = False
    status: int = ContactState.STATUS_OK
    band: tuple[float, float] | None = None
    holds: bool = False

    @staticmethod
    def without_force(tip: np.ndarray, missing: str) -> ShownPeriod:
        """Of a period of which nothing is known but where the tool is [m]."""
        return ShownPeriod(tip, np.zeros(3), np.nan, np.nan, missing)

    @property
    def size(self) -> float:
        """Of the force that is felt now [N]; NaN if there is none."""
        return np.nan if self.missing else float(np.linalg.norm(self.force))


class PeriodChooser:
    """Takes each period that could be shown, and says what is; of all tools, in their order.

    is_unknown : the step computed no force for a tool
    """

    def __init__(self) -> None:
        self._valid: tuple[ShownPeriod, ...] = ()  # the last with a force, while a tool is in
        self.is_unknown = False

    def forget(self) -> None:
        """Another organ, or other tools: nothing of the last one is held."""
        self._valid, self.is_unknown = (), False

    def take(self, rows: np.ndarray) -> bool:
        """Whether the cloud of a period is to be drawn; ``rows`` as in the shared memory."""
        self.is_unknown = not has_force(rows["status"]).all()
        is_held = self.is_unknown and bool(self._valid)
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
        if self.is_unknown:
            missing = why_missing(rows["status"])
            if self._valid:
                held = zip(self._valid, tips, missing, strict=True)
                return tuple(v._replace(tip=t, missing=why, is_held=True) for v, t, why in held)
            return tuple(map(ShownPeriod.without_force, tips, missing))
        now = tuple(_of_tool(row, tip, largest) for row, tip in zip(rows, tips, strict=True))
        if rows["touches"].any():
            self._valid = now
        return now


def has_force(status: np.ndarray) -> np.ndarray:
    """Whether the step computed the force of each tool; status : shape (n_tools,)"""
    return np.isin(status, PLACED) & (status != ContactState.STATUS_OUT_OF_RANGE)


def why_missing(status: np.ndarray) -> list[str]:
    """Why each tool shows no force where one of them has none; status : shape (n_tools,)"""
    known = zip(status.tolist(), has_force(status), strict=True)
    return [OTHER_UNKNOWN if is_known else explanation(number) for number, is_known in known]


def _of_tool(row: np.ndarray, tip: np.ndarray, largest: float) -> ShownPeriod:
    error = float(row["error"]) if int(row["touches"]) > 0 else 0.0
    status, holds = int(row["status"]), bool(row["held"])
    return ShownPeriod(tip, row["force"].copy(), error, largest, status=status, holds=holds)
