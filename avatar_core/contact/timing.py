"""Times of an accuracy curve, measured on the machine that builds it.

They are processor times: a loop whose thread nothing interrupts, by real-time priority, waits that
long. Wall time would measure the other processes of the moment instead.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from avatar_core.common.machine import processor
from avatar_core.contact.layout import Shape, lay_out
from avatar_core.contact.model import ContactData, ContactModel, step
from avatar_core.contact.tool_path import slide
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.accuracy import AccuracyCurve, Detail
from avatar_core.vademecum.model import Vademecum

_TIP, _DEPTH = Tip("sphere", 10e-3), 5e-3  # [m] of the slide that is timed
_STEPS, _WARM, _ROUNDS = 200, 50, 5


def timed(
    vademecum: Vademecum,
    curve: AccuracyCurve,
    progress: Callable[[float], None] = lambda fraction: None,
) -> AccuracyCurve:
    """Return the curve with processor times of steps on this machine, one tool 5 mm deep.

    Each point has the median over rounds of its p50 and p99. All points take their turn in a round.
    A neighbor that disturbs this machine's memory for a second then disturbs one round of each
    point, not all rounds of some.
    """
    path = slide(vademecum, _TIP.offset, _DEPTH, _STEPS * 1e-4)[:, None]
    shape, n_modes = Shape.of(vademecum, (_TIP,)), vademecum.n_modes
    models = {
        cloud: ContactModel(lay_out(vademecum, (_TIP,), Detail(n_modes, cloud), shape=shape)).data()
        for cloud in dict.fromkeys(point.detail.cloud for point in curve.points)
    }
    found = np.empty((_ROUNDS, len(curve.points), 2))
    for k in range(_ROUNDS):
        progress(k / _ROUNDS)
        for i, point in enumerate(curve.points):
            data = models[point.detail.cloud]
            data.show(point.detail.modes)
            times = _step_times(data, path)[_WARM:]
            found[k, i] = np.median(times), np.quantile(times, 0.99)
    pairs = zip(curve.points, np.median(found, axis=0), strict=True)
    points = tuple(replace(point, p50=float(p50), p99=float(p99)) for point, (p50, p99) in pairs)
    progress(1.0)
    return replace(curve, points=points, machine=processor())


def _step_times(data: ContactData, path: np.ndarray) -> np.ndarray:
    """Return the processor time of each step of a path [s]."""
    data.reset()
    times = np.empty(len(path))
    for k, tips in enumerate(path):
        start = time.thread_time()
        step(data.model, data, tips)
        times[k] = time.thread_time() - start
    return times
