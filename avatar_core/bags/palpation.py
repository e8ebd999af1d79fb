"""From a bag to the path of a tip and the sizes of the forces that a sensor measured on it."""

from __future__ import annotations

import numpy as np

from avatar_core.bags.periods import valid_tips
from avatar_core.bags.read import WRENCHES, Progress, read_bag
from avatar_core.bags.touched import Touched, TouchFile
from avatar_core.errors import StorageError
from avatar_core.geometry.tip import Tip

SENSOR = {f"{prefix}measured_cf": axes for prefix, axes in (("", "absolute"), ("body/", "body"))}
_NEXT = 0.05  # from a pose to the wrenches before and after it, at most [s]


def measured_path(file: TouchFile, progress: Progress | None = None) -> Touched:
    """Read ``measured_cp`` and ``measured_cf`` of a tool; ``servo_cf`` where there is no sensor.

    Forces are linear in time between wrenches, and NaN far from any. Notes say what was left out,
    and where the forces come from.

    Raises
    ------
    StorageError
        If the bag holds no poses or no wrenches of the tool.
    """
    bag = read_bag(file.path, file.tool, progress, SENSOR | WRENCHES)
    wrenches = bag.wrenches
    if wrenches is None or len(wrenches) == 0:
        raise StorageError(
            f"{bag.path} has no {bag.tool}/measured_cf and no {bag.tool}/servo_cf; record the force"
        )
    received, tip, notes = valid_tips(bag, file.transform)
    size = np.linalg.norm(wrenches.values, axis=1)
    force = np.interp(received, wrenches.received, size, np.nan, np.nan)
    after = np.clip(np.searchsorted(wrenches.received, received), 1, len(wrenches) - 1)
    gap = wrenches.received[after] - wrenches.received[after - 1]
    force[gap > 2.0 * _NEXT * 1e9] = np.nan
    if bag.wrench not in SENSOR:
        notes.append(f"forces are those of {bag.wrench}, which the cell computed, not a sensor's")
    return Touched(Tip("sphere", file.radius), tip, force, (*bag.notes, *notes))
