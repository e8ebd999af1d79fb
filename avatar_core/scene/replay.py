"""Replay of a recording: the same tool path through the same step, and a comparison of the forces.

The force in a period depends on the tips in it and on the state of the model. The state is whether
a tip entered through the surface, the previous force, anchors of friction, relaxation, modal
velocities, and phase of the breath. A period is *known* if this state follows from the recording:

- Without effects, or with friction, large deformation, self-weight, several tools and tilt, the
  state is reset whenever no tip touches. It is known from the first such period on, and again after
  lost periods.
- With viscoelasticity or inertia, only in a recording from rest, up to the first lost period.
- With respiration never: the phase of the breath is not recorded.

Forces in known periods are identical to the last bit on the machine that recorded them. They are
compared before the force guard, whose state (limits, ramps, engagement) is not recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.contact import model as contact
from avatar_core.contact.model import ContactModel, Status
from avatar_core.errors import SceneError, StorageError
from avatar_core.scene.file import parse_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.prepare import scene_spec
from avatar_core.scene.recording import Periods, Recording
from avatar_core.vademecum.model import Vademecum

REMEMBER_FOR_EVER = ("viscoelasticity", "inertia")
_RECORDED_NOWHERE = {"respiration": "phase of the breath", "grasp": "jaw"}
_STEP = 500  # periods from one call of ``progress`` to the next
_MAY_BE_INSIDE = (int(Status.OUT_OF_RANGE), int(Status.INVALID_POSE))


@dataclass(frozen=True, eq=False)
class Replayed:
    """Forces of the organ on the recorded tips.

    Attributes
    ----------
    force : ndarray, shape (n, n_tools, 3)
        Force [N].
    known : ndarray of bool, shape (n,)
        Whether the force must equal the recorded one.
    """

    force: np.ndarray
    known: np.ndarray

    def difference(self, recording: Recording) -> float:
        """Return the largest force difference in known periods [N]; NaN if no period is known."""
        if not self.known.any():
            return float("nan")
        gap = self.force[self.known] - recording.periods.force[self.known]
        return float(np.linalg.norm(gap, axis=2).max())


def replay(
    recording: Recording, vademecum: Vademecum, progress: Callable[[int, int], None] | None = None
) -> Replayed:
    """Compute the forces along the path of a recording with a new model.

    Parameters
    ----------
    progress : Callable[[int, int], None] or None
        Called with the number of computed periods, and of all.

    Raises
    ------
    StorageError
        If the recording was made with another vademecum, or by another version of avatar.
    SceneError, ContactError, CoordinateError
        If the scene in it does not fit the vademecum.
    """
    if vademecum.id != recording.vademecum_id:
        raise StorageError(
            f"the recording is of {recording.vademecum_name!r} ({recording.vademecum_id[:12]}), "
            f"this is {vademecum.name!r} ({vademecum.id[:12]}); give the file it was made with"
        )
    scene = scene_of(recording)
    periods = recording.periods
    if len(scene.tools) != periods.tip.shape[1]:
        raise StorageError(
            f"the recording has {periods.tip.shape[1]} tools, its scene {len(scene.tools)}; "
            "record again"
        )
    spec = scene_spec(vademecum, replace(scene, cloud="off"))
    model = ContactModel(spec.layout(spec.finest, 1.0 / recording.rate))
    data, force = model.data(), np.empty(periods.force.shape)
    for k in range(len(periods)):
        contact.solve(model, data, periods.tip[k], periods.orientation[k])
        force[k] = data.out.force
        if progress is not None and k % _STEP == 0:
            progress(k, len(periods))
    if progress is not None:
        progress(len(periods), len(periods))
    return Replayed(force, known_periods(periods, scene, recording.from_rest))


def scene_of(recording: Recording) -> Scene:
    """Return the scene in a recording.

    Raises
    ------
    StorageError
        If this version of avatar does not accept the scene.
    """
    try:
        return parse_scene(recording.scene, "scene of the recording")
    except SceneError as error:
        cause, _, _ = str(error).partition(";")
        raise StorageError(
            f"{cause}; record again, or replay with the version of avatar that recorded"
        ) from error


def known_periods(periods: Periods, scene: Scene, from_rest: bool) -> np.ndarray:
    """Return whether each period's model state follows from the recording, shape (n,)."""
    names = {effect.name for effect in scene.effects}
    known = np.zeros(len(periods), bool)
    if names & set(_RECORDED_NOWHERE):
        return known
    forgets = not names & set(REMEMBER_FOR_EVER)
    inside = periods.force.any(axis=2) | np.isin(periods.status, _MAY_BE_INSIDE)
    free, lost = np.logical_not(inside.any(axis=1)), periods.lost > 0
    sure = from_rest
    for k in range(len(periods)):
        sure = (sure and not lost[k]) or bool(forgets and free[k])
        known[k] = sure
    return known


def why_not(recording: Recording) -> str:
    """Return the reason why no period of a recording is known, and the remedy."""
    names = {effect.name for effect in parse_scene(recording.scene, "scene").effects}
    for name, what in _RECORDED_NOWHERE.items():
        if name in names:
            return f"the {what} is not recorded; record without {name}"
    if names & set(REMEMBER_FOR_EVER):
        return "the state of the organ at the start is not recorded; start with the tool off it"
    return "the tool was never off the organ; start with the tool off it"
