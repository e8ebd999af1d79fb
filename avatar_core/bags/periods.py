"""From the tables of a bag to a recording: one period for each answer of the contact loop.

Each ``contact_state``, or without states each wrench, was sent by one period of the loop. Its stamp
is the stamp of the pose that the period used. If a bag has neither, each pose is taken for a
period, and there is nothing to compare with.

The loop does not number its messages. An answer that a recorder lost cannot be told from one that
was never sent because the loop was late. With effects that remember the path, periods count as lost
where two answers were received more than ``_GAP`` periods apart. Too little may be compared, but
nothing wrongly. Without such effects, the force follows from the present tip. Periods then count as
lost where answers are missing for longer than a pose is held, and the tip moved meanwhile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from avatar_core.bags.read import Bag
from avatar_core.bags.table import Table
from avatar_core.common.arrays import FloatArray
from avatar_core.contact.orientation import composed
from avatar_core.contact.status import FAR_AWAY, PLACED, Status
from avatar_core.errors import StorageError
from avatar_core.scene.file import parse_scene
from avatar_core.scene.recording import Clouds, Periods, Recording
from avatar_core.scene.replay import REMEMBER_FOR_EVER

ORGAN = "organ"  # the frame that the nodes call the organ's unless told otherwise
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

_GAP = 1.5  # periods
_REMEMBERING = {"friction", *REMEMBER_FOR_EVER}
_HELD = 0.02  # for which a pose is held, by default; after it a zero is sent [s]
_FOLLOWED = 5e-3  # by which a tip may move and be still in contact, however deep it is [m]
_REPEATED = 3  # times that a clock set back may give a stamp again
_UNIT = 1e-3  # by which a quaternion may differ from length 1, as in the loop


@dataclass(frozen=True, eq=False)
class BagPath:
    """A recording that was found in a bag.

    recording : its forces are zero if ``answers`` is "poses"
    answers : messages that the periods come from: "states", "wrenches" or "poses"
    received : ndarray of int, shape (n,), time of receipt of each answer [ns]
    sound : ndarray of bool, shape (n,), whether the pose was valid, as far as the bag shows
    notes : messages that were left out, one line each
    """

    recording: Recording
    answers: str
    received: np.ndarray
    sound: np.ndarray
    notes: tuple[str, ...]


def path_of(
    bag: Bag,
    scene: str,
    vademecum_id: str,
    transform: tuple[float, ...] | None = None,
    rate: float | None = None,
) -> BagPath:
    """Return the recording of one tool.

    Parameters
    ----------
    scene : str
        YAML of the scene of one tool.
    vademecum_id : str
        Id of the organ's vademecum; states of others are left out.
    transform : tuple[float, ...] or None
        Pose of the poses' frame in the organ's, x y z [m] and quaternion x y z w; None if the
        frames are equal.
    rate : float or None
        Rate of the loop [Hz]; None for the rate of the answers.

    Raises
    ------
    StorageError
        If poses are in another frame without a transform, or nothing is left.
    """
    poses, invalid, notes = _valid_poses(bag, transform)
    origin, rotation = _parts(transform or IDENTITY)
    frame = np.array((transform or IDENTITY)[3:]) / math.hypot(*(transform or IDENTITY)[3:])
    answers, table = _answers(bag, poses)
    rate = rate or (bag.about.rate if bag.about else _rate(table.received))
    row = _pose_of(poses, table, answers)
    known = row >= 0
    status, tip_kind = _placement(answers, table, known)
    kept = (tip_kind != _MISSING) & _of_organ(answers, table, vademecum_id)
    if not kept.any():
        raise StorageError(f"{bag.path}: no {_ANSWER[answers]} answers a pose of the bag")
    if missing := int((tip_kind == _MISSING).sum()):
        notes.append(f"{missing:,} {_ANSWER[answers]} answer poses that the bag lacks: left out")
    tip = np.full((len(table), 3), FAR_AWAY)
    tip[tip_kind == _NONE] = np.nan
    here = tip_kind == _AT_POSE
    tip[here] = _moved(poses.values[row[here], :3], origin, rotation)
    late = np.diff(table.received, prepend=table.received[:1]) > _HELD * 1e9
    lost = late & (_leaps(tip) | (answers == "wrenches"))  # whose status nobody knows
    effects = {effect.name for effect in parse_scene(scene, "scene of the bag").effects}
    if bag.about is not None or effects & _REMEMBERING:  # a recording's receipts count the periods
        lost = np.ones(len(table), bool)
    number = _numbers(table.received, rate, lost)
    orientation = np.where(here[:, None], _turned(poses.values[row, 3:], frame), 0.0)
    force = _forces(bag, answers, table, poses, row, rotation)
    recording = Recording(
        vademecum_id=vademecum_id,
        vademecum_name=bag.about.vademecum_name if bag.about else bag.path.name,
        scene=scene,
        rate=rate,
        from_rest=bag.about is not None and bag.about.from_rest and bool(kept.all()),
        periods=Periods(
            number=number[kept],
            stamp=table.stamp[kept],
            tip=tip[kept, None],
            orientation=orientation[kept, None],
            status=status[kept, None],
            force=force[kept, None],
            error=_column(answers, table, 4)[kept, None],
            sent_fraction=_column(answers, table, 5)[kept, None],
        ),
        clouds=Clouds(np.zeros(0, np.int64), np.zeros((0, 0, 3), np.float32)),
    )
    sound = here & ~late & ~_spoilt(table.received, invalid)
    return BagPath(recording, answers, table.received[kept], sound[kept], tuple(notes))


def valid_tips(
    bag: Bag, transform: tuple[float, ...] | None = None
) -> tuple[Table, FloatArray, list[str]]:
    """Return the valid poses, their tips in the organ's frame (n, 3) [m], and notes.

    For transform and errors see :func:`path_of`.
    """
    poses, _, notes = _valid_poses(bag, transform)
    tip = _moved(poses.values[:, :3], *_parts(transform or IDENTITY))
    return poses, tip, notes


_ANSWER = {"states": "contact_state", "wrenches": "wrenches", "poses": "poses"}
_AT_POSE, _AWAY, _NONE, _MISSING = range(4)  # where the tip of a period was


def _valid_poses(
    bag: Bag, transform: tuple[float, ...] | None
) -> tuple[Table, np.ndarray, list[str]]:
    """Return accepted poses, times of receipt of refused ones, and notes."""
    if not len(bag.poses):
        raise StorageError(f"{bag.path}: {bag.tool}/measured_cp is empty; record it again")
    frames, labels = bag.poses.label, bag.poses.labels
    counts = np.bincount(frames, minlength=len(labels))
    organ = labels.index(ORGAN) if transform is None and ORGAN in labels else -1
    frame = organ if organ >= 0 else int(counts.argmax())
    name = labels[frame]
    if transform is None and name != ORGAN:
        raise StorageError(
            f"{bag.path}: poses are in the frame '{name}', not in '{ORGAN}'; give --tool-transform "
            "(0,0,0,0,0,0,1 if they are the same)"
        )
    values = bag.poses.values
    with np.errstate(over="ignore"):
        norm = (values[:, 3:] ** 2).sum(axis=1)
    whole = np.isfinite(values).all(axis=1) & (np.abs(norm - 1.0) < 2.0 * _UNIT)
    valid = whole & (frames == frame)
    notes = []
    if others := int((frames != frame).sum()):
        notes.append(f"{others:,} poses are in other frames than '{name}': refused, as by the loop")
    if spoilt := int((~whole).sum()):
        notes.append(f"{spoilt:,} poses are invalid: refused, as by the loop")
    if not valid.any():
        raise StorageError(f"{bag.path}: no pose of {bag.tool} is valid")
    return bag.poses.where(valid), bag.poses.received[~valid], notes


def _answers(bag: Bag, poses: Table) -> tuple[str, Table]:
    if bag.states is not None and len(bag.states):
        return "states", bag.states
    if bag.wrenches is not None and len(bag.wrenches):
        return "wrenches", bag.wrenches
    return "poses", poses


def _rate(received: np.ndarray) -> float:
    """Return the rate of the answers, to three digits [Hz].

    Raises
    ------
    StorageError
        If it is out of any range.
    """
    if len(received) < 2:
        return 1000.0
    between = float(np.median(np.diff(received)))
    rate = float(f"{1e9 / between:.3g}") if between > 0.0 else math.inf
    if not 1.0 <= rate <= 10_000.0:
        raise StorageError(f"the answers in the bag come at {rate:g} Hz; give --rate")
    return rate


def _leaps(tip: FloatArray) -> np.ndarray:
    """Return where the tip moved farther than a contact is followed, or was unknown, shape (n,)."""
    with np.errstate(invalid="ignore", over="ignore"):
        moved = np.linalg.norm(np.diff(tip, axis=0, prepend=tip[:1]), axis=1)
        return np.asarray(~(moved <= _FOLLOWED))


def _numbers(received: np.ndarray, rate: float, lost: np.ndarray) -> np.ndarray:
    """Return the numbers of the periods, shape (n,); a gap counts if it ends in a ``lost`` one."""
    periods = np.diff(received, prepend=received[:1]) * (rate * 1e-9)
    steps = np.where((periods > _GAP) & lost, np.rint(periods), 1.0).astype(np.int64)
    return np.cumsum(steps)


def _pose_of(poses: Table, answered: Table, answers: str) -> np.ndarray:
    """Return the pose of each answer's stamp, the last received before it, or -1."""
    if answers == "poses":
        return np.arange(len(poses))
    order = np.argsort(poses.stamp, kind="stable")  # and so by the time of receipt
    sorted_stamp, stamp = poses.stamp[order], answered.stamp
    at = np.searchsorted(sorted_stamp, stamp, side="right") - 1
    found = (at >= 0) & (sorted_stamp[np.maximum(at, 0)] == stamp)
    for _ in range(_REPEATED):
        later = found & (poses.received[order[at]] > answered.received)
        at = at - (later & (at > 0) & (sorted_stamp[at - 1] == stamp))
    return np.where(found, order[np.maximum(at, 0)], -1)


def _placement(answers: str, table: Table, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the status of each period, and the place of its tip."""
    n = len(table)
    if answers == "states":
        status = table.values[:, 0].astype(np.uint8)
        placed = np.isin(status, PLACED)
        where = np.where(placed, np.where(known, _AT_POSE, _MISSING), _AWAY)
        where[status == int(Status.INVALID_POSE)] = _NONE
        return status, where
    status = np.zeros(n, np.uint8)
    where = np.where(known, _AT_POSE, _MISSING)
    if answers == "wrenches":
        where[(table.stamp == 0) & ~known] = _AWAY  # before the first pose
        where[_is_stale(table)] = _AWAY
    return status, where


def _is_stale(wrenches: Table) -> np.ndarray:
    """Return whether a wrench is zero because its pose is too old, shape (n,)."""
    first = np.r_[True, np.diff(wrenches.stamp) != 0]
    since = wrenches.received[first][np.cumsum(first) - 1]
    old: np.ndarray = wrenches.received - since > _HELD * 1e9
    return old & ~wrenches.values.any(axis=1)


def _of_organ(answers: str, table: Table, vademecum_id: str) -> np.ndarray:
    """Return whether periods answered for that organ, shape (n,); true if the bag does not say."""
    if answers != "states":
        return np.ones(len(table), bool)
    mine = [name == vademecum_id for name in table.labels]
    return np.array(mine, bool)[table.label]


def _spoilt(received: np.ndarray, invalid: np.ndarray) -> np.ndarray:
    """Return whether a refused pose came between an answer and the one before it, shape (n,)."""
    came = np.searchsorted(np.sort(invalid), received, side="right")
    return np.diff(came, prepend=0) > 0


def _parts(transform: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the origin and rotation matrix of a pose.

    Raises
    ------
    StorageError
        If it is not seven finite numbers with a quaternion of length 1.
    """
    numbers = np.array(transform, float)
    length = math.hypot(*numbers[3:]) if numbers.shape == (7,) else math.nan
    if not (np.isfinite(numbers).all() and abs(length - 1.0) < _UNIT):
        raise StorageError(
            "a transform is x,y,z [m] and a quaternion x,y,z,w of length 1, as 0,0,0.1,0,0,0,1"
        )
    return numbers[:3], Rotation.from_quat(numbers[3:]).as_matrix()


def _moved(points: FloatArray, origin: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return points in the organ's frame; bit by bit the same if both frames are one."""
    turned = points if np.array_equal(rotation, np.eye(3)) else points @ rotation.T
    return turned + origin


def _turned(orientations: FloatArray, frame: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) in the organ's frame, computed like in the loop.

    They are bit by bit the same if both frames are one.
    """
    if np.array_equal(frame, IDENTITY[3:]):
        return orientations
    return np.stack(composed(frame, orientations.T), axis=1)


def _forces(
    bag: Bag, answers: str, table: Table, poses: Table, row: np.ndarray, rotation: FloatArray
) -> FloatArray:
    """Return forces on the tool in the organ's frame, (n, 3) [N]; zero if the bag has none."""
    if answers == "states":
        return table.values[:, 1:4]
    if answers == "poses":
        return np.zeros((len(table), 3))
    force = table.values
    if bag.axes == "body":
        force = Rotation.from_quat(poses.values[np.maximum(row, 0), 3:]).apply(force)
    return force if np.array_equal(rotation, np.eye(3)) else force @ rotation.T


def _column(answers: str, table: Table, column: int) -> FloatArray:
    """Return a column of the states; NaN, unknown, without them."""
    return table.values[:, column] if answers == "states" else np.full(len(table), np.nan)
