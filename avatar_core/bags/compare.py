"""Choice of the periods of a bag that can be compared with a replay.

A ``contact_state`` holds the computed force. A wrench holds the force after the force guard. It is
compared only where the guard passes the replayed force unchanged. Some periods of margin are left
out, because a bag knows only times of receipt.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar_core.bags.periods import BagPath
from avatar_core.common.arrays import FloatArray
from avatar_core.haptics.force_guard import ForceGuard, ForceLimits
from avatar_core.scene.replay import REMEMBER_FOR_EVER, Replayed, known_periods, scene_of
from avatar_core.scene.replay import why_not as why_not_recorded

_MARGIN = 10  # periods around those that the guard alters


def comparable(path: BagPath, found: Replayed, limits: ForceLimits) -> Replayed:
    """Return a replay of a bag, its ``known`` reduced to what the bag allows to compare.

    Parameters
    ----------
    limits : ForceLimits
        Limits of the force guard of the loop that answered.
    """
    if path.answers == "states":
        return found
    if path.answers == "poses":
        return replace(found, known=np.zeros(len(found.known), bool))
    recording = path.recording
    # A wrench may be zero although the tip is inside; the replay shows that.
    either = np.abs(recording.periods.force) + np.abs(found.force)
    inside = replace(recording.periods, force=either)
    known = known_periods(inside, scene_of(recording), recording.from_rest)
    passed = _passed(found.force[:, 0], path.received, path.sound, limits)
    return replace(found, known=known & passed)


def why_not(path: BagPath) -> str:
    """Return the reason why no period of a bag can be compared, and the remedy."""
    if not path.recording.from_rest:
        effects = {effect.name for effect in scene_of(path.recording).effects}
        if held := sorted(effects & set(REMEMBER_FOR_EVER)):
            return (
                f"a bag does not say how the organ was at its start, which {' and '.join(held)} "
                "remembers; record on the planning page"
            )
    if path.answers == "states":
        return why_not_recorded(path.recording)
    return (
        "no wrench is known to be the force as it was computed; give the --device whose limits it "
        "kept, start with the tool off the organ, or record contact_state too"
    )


def _passed(
    force: FloatArray, received: np.ndarray, sound: np.ndarray, limits: ForceLimits
) -> np.ndarray:
    """Return whether the guard passes each force as it is, shape (n,)."""
    guard, torque = ForceGuard(limits), np.zeros(3)
    altered = np.ones(len(force), bool)
    for k, one in enumerate(force):
        guard.update(float(received[k]) * 1e-9, bool(sound[k]), one.copy(), torque)
        altered[k] = not guard.engaged or guard.limited
    near = np.convolve(altered, np.ones(2 * _MARGIN + 1), mode="same") > 0.5
    return np.asarray(~near[: len(force)])
