"""The times of an accuracy curve, measured on the machine that will keep them.

They are the processor's: what a loop waits for whose thread nothing interrupts, which real-time
priority gives it. Wall time would measure the other processes of the moment instead.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from avatar_core.common.machine import processor
from avatar_core.contact.effects.base import Effect
from avatar_core.contact.layout import PERIOD, lay_out_details
from avatar_core.contact.model import ContactModel, deform, make_model, solve, step
from avatar_core.contact.tool_path import slide, starts_apart
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.accuracy import AccuracyCurve, CurvePoint, Detail
from avatar_core.vademecum.model import Vademecum

_TIP, _DEPTH = Tip("sphere", 10e-3), 5e-3  # [m] of the slide that is timed
_STEPS, _WARM, _ROUNDS = 200, 50, 5


def timed(
    vademecum: Vademecum,
    curve: AccuracyCurve,
    tips: Sequence[Tip] = (_TIP,),
    effects: Sequence[Effect] | None = None,
    period: float = PERIOD,
    halves: bool = False,
    progress: Callable[[float], None] = lambda fraction: None,
) -> AccuracyCurve:
    """The same curve with the processor's time of steps on this machine, all tools 5 mm deep.

    halves : time :func:`avatar_core.contact.model.solve` and ``deform``, as a node calls them
    """
    paths = slides(vademecum, tips)
    pairs: list[tuple[ContactModel, CurvePoint]] = []
    groups = _same_arrays(curve)
    details = [replace(group[0].detail, modes=vademecum.n_modes) for group in groups]
    layouts = lay_out_details(vademecum, tips, details, effects, period)
    for group, layout in zip(groups, layouts, strict=True):
        model = make_model(layout, halves)
        pairs += [(model, point) for point in group]
        progress(0.5 * len(pairs) / len(curve.points))
    points = _timed(pairs, paths, lambda fraction: progress(0.5 + 0.5 * fraction))
    return replace(curve, points=tuple(points), machine=processor())


def timed_points(
    model: ContactModel,
    points: Sequence[CurvePoint],
    paths: np.ndarray,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[CurvePoint]:
    """Points that differ in modes alone, timed on a model that has all of these."""
    found = _timed([(model, point) for point in points], paths, progress)
    model.show(model.n_modes)
    model.reset()
    return found


def slides(vademecum: Vademecum, tips: Sequence[Tip]) -> np.ndarray:
    """Ways of tips that start far apart, 5 mm deep, shape (n, n_tools, 3) [m]."""
    starts = starts_apart(vademecum, len(tips))
    paths = [
        slide(vademecum, tip.offset, min(_DEPTH, tip.radius), _STEPS * 1e-4, position=start)
        for tip, start in zip(tips, starts, strict=True)
    ]
    return np.ascontiguousarray(np.stack(paths, axis=1))


def _same_arrays(curve: AccuracyCurve) -> list[list[CurvePoint]]:
    """Points grouped by everything but the number of modes."""
    groups: dict[Detail, list[CurvePoint]] = {}
    for point in curve.points:
        groups.setdefault(replace(point.detail, modes=0), []).append(point)
    return list(groups.values())


def _timed(
    pairs: Sequence[tuple[ContactModel, CurvePoint]],
    paths: np.ndarray,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[CurvePoint]:
    """Each point with the median over rounds of its p50 and p99.

    All points take their turn in a round, so that a neighbour who disturbs this machine's memory
    for a second disturbs one round of each, not all rounds of some.
    """
    found = np.empty((_ROUNDS, len(pairs), 2))
    for k in range(_ROUNDS):
        for i, (model, point) in enumerate(pairs):
            model.show(point.detail.modes)
            times = _step_times(model, paths)[_WARM:]
            found[k, i] = np.median(times), np.quantile(times, 0.99)
        progress((k + 1) / _ROUNDS)
    medians = np.median(found, axis=0)
    return [
        replace(point, p50=float(p50), p99=float(p99))
        for (_, point), (p50, p99) in zip(pairs, medians, strict=True)
    ]


def _step_times(model: ContactModel, paths: np.ndarray) -> np.ndarray:
    """Of the processor, for each step of a path [s]."""
    model.reset()
    whole = model.compiled.step is not None
    times = np.empty(len(paths))
    for k, tips in enumerate(paths):
        start = time.thread_time()
        if whole:
            step(model, tips)
        else:
            solve(model, tips)
            deform(model)
        times[k] = time.thread_time() - start
    return times
