"""Touches of a sphere on an organ, and a recording of them."""

from __future__ import annotations

import numpy as np

from avatar_core.contact.model import FAR_AWAY
from avatar_core.contact.tool_path import palpation as push
from avatar_core.contact.tool_path import starts_apart
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import write_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.recording import Clouds, Periods, Recording
from avatar_core.vademecum.model import Vademecum
from tests.helpers.contact import prepare, step

RADIUS = 5e-3
SPHERE = Tip("sphere", RADIUS)
DEPTH = 5e-3


def path_over(organ: Vademecum, n: int) -> np.ndarray:
    """Return pushes at n places, the tool far away between them, shape (periods, 3)."""
    parts = [push(organ, RADIUS, DEPTH, 120, j) for j in starts_apart(organ, n)]
    away = np.full((5, 3), FAR_AWAY)
    return np.concatenate([row for part in parts for row in (away, part)] + [away])


def felt(organ: Vademecum, tips: np.ndarray) -> np.ndarray:
    """Return the computed force on the tip, shape (n, 3)."""
    data = prepare(organ, (SPHERE,), cloud="off")
    force = np.empty(tips.shape)
    for k, tip in enumerate(tips):
        step(data, tip[None])
        force[k] = data.out.force[0]
    return force


def recording_of(organ: Vademecum, tips: np.ndarray, forces: np.ndarray) -> Recording:
    n = len(tips)
    periods = Periods(
        number=np.arange(n),
        stamp=np.arange(n) * 1_000_000,
        tip=tips[:, None],
        orientation=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1, 1)),
        status=np.zeros((n, 1), np.uint8),
        force=forces[:, None],
        error=np.zeros((n, 1)),
        sent_fraction=np.ones((n, 1)),
    )
    clouds = Clouds(np.zeros(0, np.int64), np.zeros((0, 0, 3), np.float32))
    return Recording("", organ.name, write_scene(Scene()), 1e3, True, periods, clouds)
