"""From a bag to the path of a tip and the sizes of the forces that a sensor measured on it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar_core.bags.periods import valid_tips
from avatar_core.bags.read import WRENCHES, Progress, read_bag
from avatar_core.common.arrays import FloatArray
from avatar_core.errors import StorageError

SENSOR = {f"{prefix}measured_cf": axes for prefix, axes in (("", "absolute"), ("body/", "body"))}
_NEXT = 0.05  # from a pose to the wrenches before and after it, at most [s]


@dataclass(frozen=True, eq=False)
class MeasuredPath:
    """A path of a tip and the forces on it.

    tip : ndarray, shape (n, 3), in the organ's frame [m]
    force : ndarray, shape (n,), sizes, between wrenches linear in time; NaN far from any [N]
    notes : what was left out, and where the forces come from, one line each
    """

    tip: FloatArray
    force: FloatArray
    notes: tuple[str, ...]


def measured_path(
    path: str | Path,
    tool: str | None = None,
    transform: tuple[float, ...] | None = None,
    progress: Progress | None = None,
) -> MeasuredPath:
    """Read ``measured_cp`` and ``measured_cf`` of a tool; ``servo_cf`` where there is no sensor.

    Parameters
    ----------
    tool, progress : as of :func:`avatar_core.bags.read.read_bag`
    transform : as of :func:`avatar_core.bags.periods.path_of`

    Raises
    ------
    StorageError
        If the bag holds no poses or no wrenches of the tool.
    """
    bag = read_bag(path, tool, progress, SENSOR | WRENCHES)
    wrenches = bag.wrenches
    if wrenches is None or len(wrenches) == 0:
        raise StorageError(
            f"{path} has no {bag.tool}/measured_cf and no {bag.tool}/servo_cf; record the force"
        )
    received, tip, notes = valid_tips(bag, transform)
    size = np.linalg.norm(wrenches.values, axis=1)
    force = np.interp(received, wrenches.received, size, np.nan, np.nan)
    after = np.clip(np.searchsorted(wrenches.received, received), 1, len(wrenches) - 1)
    gap = wrenches.received[after] - wrenches.received[after - 1]
    force[gap > 2.0 * _NEXT * 1e9] = np.nan
    if bag.wrench not in SENSOR:
        notes.append(f"forces are those of {bag.wrench}, which the cell computed, not a sensor's")
    return MeasuredPath(tip, force, (*bag.notes, *notes))
