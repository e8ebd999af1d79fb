"""Touches with measured forces from a file: a bag of a sensor, or a recording of the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from avatar_core.bags.files import is_bag
from avatar_core.bags.periods import valid_tips
from avatar_core.bags.read import WRENCHES, Progress, read_bag
from avatar_core.bags.table import Table
from avatar_core.common.arrays import FloatArray
from avatar_core.errors import StorageError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.recording import load_recording
from avatar_core.scene.replay import scene_of
from avatar_core.uncertainty.calibration import TouchErrors, calibrated, touch_table
from avatar_core.uncertainty.calibration_report import numbers, verdict
from avatar_core.uncertainty.distributions import parse
from avatar_core.uncertainty.known import priors_of
from avatar_core.uncertainty.palpation import Palpation, palpation_of
from avatar_core.uncertainty.sensor import sensed
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum

RADIUS = 5e-3  # radius of a tip without a given one [m]
SENSOR = {f"{prefix}measured_cf": axes for prefix, axes in (("", "absolute"), ("body/", "body"))}
_NEXT = 0.05  # from a pose to the wrenches before and after it, at most [s]
_DIFFER = 0.9  # part of the stamps that are others than those before them, at least
_BACK = 100_000_000  # by which a stamp may be before the one before it [ns]
_ONE_CLOCK = 1_000_000_000  # largest difference of the delays of two topics on one clock [ns]


@dataclass(frozen=True)
class TouchFile:
    """A file with touches.

    Attributes
    ----------
    tool : str or None
        Name of the tool, as in NAME/measured_cp, for a bag with several tools. For a recording,
        number of the tool, from 1. None: the only tool.
    transform : tuple[float, ...] or None
        Pose of a bag's frame in the organ's: position [m] and quaternion.
    radius : float
        Radius of a bag's spherical tip [m].
    """

    path: Path
    tool: str | None = None
    transform: tuple[float, ...] | None = None
    radius: float = RADIUS


class Touched(NamedTuple):
    """Tip of a tool, times (n,) [s], positions (n, 3) [m] and forces from a file.

    vector : ndarray, shape (n, 3), forces in the sensor's axes [N]
    """

    tip: Tip
    time: FloatArray
    position: FloatArray
    vector: FloatArray
    notes: tuple[str, ...]

    @property
    def force(self) -> FloatArray:
        """Size of the forces, shape (n,) [N]."""
        return np.asarray(np.linalg.norm(self.vector, axis=1))


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

    Forces are linear in time between wrenches, and NaN far from any. Times are those of the
    headers. If these do not tell when something was measured, times are those of receipt. Notes
    name left-out messages and the source of the forces.

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
    poses, tip, notes = valid_tips(bag, file.transform)
    by_stamps = _stamps_tell(poses, wrenches)
    if not by_stamps:
        notes.append(
            "stamps do not tell when poses and forces were measured: times of receipt are taken"
        )
    when, measured = (one.stamp if by_stamps else one.received for one in (poses, wrenches))
    order, rising = np.argsort(when, kind="stable"), np.argsort(measured, kind="stable")
    when, measured, values = when[order], measured[rising], wrenches.values[rising]
    begin = min(when[0], measured[0])  # floats hold no nanoseconds since 1970
    vector = np.column_stack(
        [np.interp(when - begin, measured - begin, one, np.nan, np.nan) for one in values.T]
    )
    after = np.clip(np.searchsorted(measured, when), 1, len(measured) - 1)
    vector[measured[after] - measured[after - 1] > 2.0 * _NEXT * 1e9] = np.nan
    if bag.wrench not in SENSOR:
        notes.append(f"forces are those of {bag.wrench}, which the cell computed, not a sensor's")
    time = 1e-9 * (when - begin)
    return Touched(Tip("sphere", file.radius), time, tip[order], vector, (*bag.notes, *notes))


def _stamps_tell(poses: Table, wrenches: Table) -> bool:
    """Return whether the headers of both topics hold times of one clock."""
    late = []
    for one in (poses, wrenches):
        differ = np.diff(one.stamp) != 0
        if one.stamp.min() <= 0 or differ.mean() < _DIFFER or np.diff(one.stamp).min() < -_BACK:
            return False
        late.append(np.median(one.received - one.stamp))
    return bool(abs(late[0] - late[1]) < _ONE_CLOCK)


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
        periods.number / found.rate,
        periods.tip[:, k],
        periods.force[:, k],
        ("forces of a recording are those that the cell computed, unless a sensor's were put in",),
    )


def palpated(
    organ: Vademecum, touched: Touched, errors: TouchErrors
) -> tuple[Palpation, TouchErrors, tuple[str, ...]]:
    """Return the touches of a file without the sensor's zero and lag, their errors, and all notes.

    Raises
    ------
    StorageError
        If nothing was touched, or the sensor's zero is not known.
    """
    found = sensed(organ, touched.tip, touched.time, touched.position, touched.vector)
    palpation = palpation_of(touched.position, found.size)
    errors = replace(errors, mesh=math.hypot(errors.mesh, found.lost / 2.0))  # common to all forces
    return palpation, errors, (*touched.notes, *found.notices)


def calibrated_files(
    vademecum: Path,
    recording: Path,
    tool: str | None,
    transform: tuple[float, ...] | None,
    radius: float | None,
    given: Sequence[str],
) -> dict[str, Any]:
    """Return the JSON of ``avatar calibrate``, with the verdict on the fit as ``verdict``.

    recording, tool, transform, radius : see :class:`TouchFile`, None for its default
    given : prior knowledge, e.g. ``young=lognormal:5300:1.5``

    Raises
    ------
    AvatarError
        From reading the files, and from :func:`avatar_core.uncertainty.calibration.touch_table`.
    """
    known = dict(parse(one) for one in given)
    touched = read_touched(TouchFile(recording, tool, transform, radius or RADIUS))
    organ = load_vademecum(vademecum)
    priors = priors_of(organ, known)
    palpation, errors, _ = palpated(organ, touched, TouchErrors())
    table = touch_table(organ, touched.tip, palpation)
    found = calibrated(table, priors, errors)
    return numbers(table, found) | {"verdict": verdict(table, found)[0]}
