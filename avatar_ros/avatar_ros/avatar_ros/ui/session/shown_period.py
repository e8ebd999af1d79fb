"""Choice of the period that the planning page shows: one of the loop, or the last valid one.

A cloud and its forces come on two topics. They are shown together if they have the same stamp. A
step computes no force for a tool whose poses it does not use, e.g. because they are too slow, nor
for a tip beyond the vademecum's range. The organ of that period lies as if this tool did not touch
it. The shape of the last period with a force then stays, in grey, with the forces of all tools,
until the force is known again. Without such a period, without an answer, or for another organ, no
number is written: zero would be a number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_core.contact.status import PLACED
from avatar_interfaces.msg import ContactState
from avatar_ros.loop.statuses import explanation

OTHER_UNKNOWN = "another tool's force is not known"
SILENT = "nothing comes from the contact node through the tool driver of this page"
OTHER_ORGAN = "the contact node does not use this organ: it is preparing it, or has refused it"
PLACE = 10.0  # no tool of an organ is farther off; a step without a pose has it far away [m]


class ShownPeriod(NamedTuple):
    """Numbers of one tool beside the picture.

    tip : position of the drawn tool [m]
    force : force of the organ [N], before the limits for a device: the page has none
    error : error of the force [N]; NaN if unknown
    largest : largest displacement of the organ [m]; NaN where no cloud comes
    missing : why there is no force; empty if there is one
    is_held : whether force and displacement are those of the last valid period, for lack of new
    ones
    status : status of avatar_interfaces/msg/ContactState
    holds : whether its jaw holds tissue
    band : 90 % band of the force from the material's distributions [N]; None if not requested
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
        """Return numbers of a period in which only the tool's position is known [m]."""
        return ShownPeriod(tip, np.zeros(3), np.nan, np.nan, missing)

    @property
    def size(self) -> float:
        """Return the size of the present force [N]; NaN if there is none."""
        return np.nan if self.missing else float(np.linalg.norm(self.force))


class PeriodChooser:
    """Chooser of the period to show, for all tools in their order.

    is_unknown : whether the step computed no force for a tool
    """

    def __init__(self) -> None:
        # the last period with a force, while a tool is in contact
        self._valid: tuple[ShownPeriod, ...] = ()
        self.is_unknown = False

    def forget(self) -> None:
        """Forget the last organ or tools."""
        self._valid, self.is_unknown = (), False

    def take(self, rows: np.ndarray) -> bool:
        """Return whether the cloud of a period is to be drawn; ``rows`` as in the shared memory."""
        self.is_unknown = not has_force(rows["status"]).all()
        is_held = self.is_unknown and bool(self._valid)
        if not is_held:
            self._valid = ()  # until the drawn period is known
        return not is_held

    def drawn(self, rows: np.ndarray, largest: float, sent: np.ndarray) -> tuple[ShownPeriod, ...]:
        """Return the numbers to show, once the cloud was drawn or left as it was.

        largest : largest displacement of the cloud, if it was drawn [m]
        sent : poses sent last, (n_tools, 3) [m], for periods whose step did not use one
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
    """Return whether the step computed the force of each tool; status : shape (n_tools,)."""
    return np.isin(status, PLACED) & (status != ContactState.STATUS_OUT_OF_RANGE)


def why_missing(status: np.ndarray) -> list[str]:
    """Return why each tool shows no force where one has none; status : shape (n_tools,)."""
    known = zip(status.tolist(), has_force(status), strict=True)
    return [OTHER_UNKNOWN if is_known else explanation(number) for number, is_known in known]


def _of_tool(row: np.ndarray, tip: np.ndarray, largest: float) -> ShownPeriod:
    error = float(row["error"]) if int(row["touches"]) > 0 else 0.0
    status, holds = int(row["status"]), bool(row["held"])
    return ShownPeriod(tip, row["force"].copy(), error, largest, status=status, holds=holds)
