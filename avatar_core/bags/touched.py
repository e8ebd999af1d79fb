"""Touches with measured forces from a file: a bag of a sensor, or a recording of the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from avatar_core.bags.files import is_bag
from avatar_core.bags.periods import valid_tips
from avatar_core.bags.read import WRENCHES, Progress, read_bag
from avatar_core.common.arrays import FloatArray
from avatar_core.errors import StorageError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.recording import load_recording
from avatar_core.scene.replay import scene_of
from avatar_core.uncertainty.calibration import Errors, calibrated, touch_table
from avatar_core.uncertainty.calibration_report import numbers, verdict
from avatar_core.uncertainty.distributions import parse
from avatar_core.uncertainty.known import priors_of
from avatar_core.uncertainty.palpation import palpation_of
from avatar_core.vademecum.storage import load_vademecum

RADIUS = 5e-3  # of a tip of which no radius is given [m]
SENSOR = {f"{prefix}measured_cf": axes for prefix, axes in (("", "absolute"), ("body/", "body"))}
_NEXT = 0.05  # from a pose to the wrenches before and after it, at most [s]


@dataclass(frozen=True)
class TouchFile:
    """A file with touches.

    tool : of a bag of several tools, NAME of the topics NAME/measured_cp; of a recording, number of
        the tool, from 1; None: the only one
    transform : of a bag, pose of the poses' frame in the organ's: position [m] and quaternion
    radius : of a bag, of the spherical tip [m]
    """

    path: Path
    tool: str | None = None
    transform: tuple[float, ...] | None = None
    radius: float = RADIUS


class Touched(NamedTuple):
    """What a file says of a tool: its tip, where it was (n, 3) [m], the forces (n,) [N]."""

    tip: Tip
    position: FloatArray
    force: FloatArray
    notes: tuple[str, ...]


def read_touched(file: TouchFile, progress: Progress | None = None) -> Touched:
    """Read the path of a tool and the forces on it.

    Raises
    ------
    StorageError
        For a file that cannot be read, a tool that it does not have, or a bag without forces.
    """
    return measured_path(file, progress) if is_bag(file.path) else _of_recording(file)


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


def _of_recording(file: TouchFile) -> Touched:
    found = load_recording(file.path)
    tips = [one.tip for one in scene_of(found).tools]
    number = int(file.tool) if file.tool is not None and file.tool.isdecimal() else 1
    right = file.tool is None or file.tool == str(number)
    if not right or not 1 <= number <= len(tips):
        raise StorageError(
            f"tool '{file.tool}' is not in {file.path}, which has tools 1 to {len(tips)}"
        )
    periods, k = found.periods, number - 1
    return Touched(
        tips[k],
        periods.tip[:, k],
        np.linalg.norm(periods.force[:, k], axis=1),
        ("forces of a recording are those that the cell computed, unless a sensor's were put in",),
    )


def calibrated_files(
    vademecum: Path,
    recording: Path,
    tool: str | None,
    transform: tuple[float, ...] | None,
    radius: float | None,
    given: Sequence[str],
) -> dict[str, Any]:
    """What ``avatar calibrate`` writes as JSON, with the verdict on the fit as ``verdict``.

    recording, tool, transform, radius : as of :class:`TouchFile`, None for its default
    given : what is known before, as ``young=lognormal:5300:1.5``

    Raises
    ------
    AvatarError
        As of what reads the files, and :func:`avatar_core.uncertainty.calibration.touch_table`.
    """
    known = dict(parse(one) for one in given)
    touched = read_touched(TouchFile(recording, tool, transform, radius or RADIUS))
    organ = load_vademecum(vademecum)
    priors = priors_of(organ, known)
    table = touch_table(organ, touched.tip, palpation_of(touched.position, touched.force))
    found = calibrated(table, priors, Errors())
    return numbers(table, found) | {"verdict": verdict(table, found)[0]}
