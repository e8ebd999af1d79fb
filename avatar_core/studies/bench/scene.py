"""Time of a scene's step on this machine, beside the bare step of the same vademecum."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.contact.layout import PERIOD
from avatar_core.contact.model import ContactData, ContactModel, step
from avatar_core.contact.tool_path import push_and_slide, starts_apart
from avatar_core.scene.model import Scene
from avatar_core.scene.prepare import scene_spec
from avatar_core.studies.bench.methods import PASSES, one_pass
from avatar_core.vademecum.model import Vademecum

PUSH, DEPTH = 10e-3, 5e-3  # [m] how deep the tools push, and slide
STEPS = 3600  # steps of one pass

Waiting = Callable[[str], AbstractContextManager[object]]


@dataclass(frozen=True)
class StepCost:
    """The step of one scene.

    p50_us, p99_us : times of the whole step, forces and cloud, medians over the passes [us]; NaN if
        the tools never touch at once
    n_steps : number of timed steps, those in which all tools touch
    bytes : size of the model
    layout_seconds : time to lay out the model
    """

    name: str
    p50_us: float
    p99_us: float
    n_steps: int
    bytes: int
    layout_seconds: float


def time_scene(
    vademecum: Vademecum, scene: Scene, waiting: Waiting = lambda text: nullcontext()
) -> tuple[StepCost, ...]:
    """Time the bare step, of the first tool without any effect, and the scene's own, in turn.

    The tools push 10 mm deep, then slide 5 mm deep; with a breath they follow the organ.

    Parameters
    ----------
    vademecum : Vademecum
        Vademecum that ``scene.require`` accepts.
    scene : Scene
        Scene; a bare scene is timed once.
    waiting : Waiting
        Context manager, entered with a text during long work.
    """
    bare = replace(scene, tools=scene.tools[:1], effects=())
    chosen = {"bare": bare, "scene": scene}
    if not scene.effects:
        del chosen["scene"]
    prepared = []
    for name, one in chosen.items():
        with waiting(f"preparing the step, {name}"):
            prepared.append(_prepared(vademecum, one, name))
    with waiting("timing"):
        passes = [[ready.timed() for ready in prepared] for _ in range(PASSES)]
    return tuple(
        ready.cost(times) for ready, times in zip(prepared, zip(*passes, strict=True), strict=True)
    )


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Data of a model and the paths of its tools, shape (n, n_tools, 3)."""

    name: str
    data: ContactData
    tips: np.ndarray
    layout_seconds: float

    def timed(self) -> np.ndarray:
        """Return the times of one pass from rest [us]."""
        data = self.data
        data.reset()
        return one_pass(data, self.tips, lambda tips: step(data.model, data, tips))[0]

    def cost(self, times: Sequence[np.ndarray]) -> StepCost:
        """Return the medians over the passes."""
        touched = [micro for micro in times if len(micro)]
        p50, p99 = (
            float(np.median([np.quantile(micro, q) for micro in touched] or [np.nan]))
            for q in (0.5, 0.99)
        )
        return StepCost(
            self.name, p50, p99, sum(map(len, times)), self.data.model.nbytes, self.layout_seconds
        )


def _prepared(vademecum: Vademecum, scene: Scene, name: str) -> _Prepared:
    start = time.perf_counter()
    spec = scene_spec(vademecum, scene)
    layout = spec.layout(spec.finest, PERIOD)
    laid_out = time.perf_counter()
    data = ContactModel(layout).data()
    starts = starts_apart(vademecum, len(spec.tips))
    paths = [
        push_and_slide(vademecum, tip.offset, PUSH, DEPTH, STEPS, at)
        for tip, at in zip(spec.tips, starts, strict=True)
    ]
    tips = _followed(data, np.ascontiguousarray(np.stack(paths, axis=1)))
    return _Prepared(name, data, tips, laid_out - start)


def _followed(data: ContactData, tips: np.ndarray) -> np.ndarray:
    """Return the same paths on an organ that breathes: its place in each period, from rest."""
    respiration = data.state.respiration
    if respiration is None:
        return tips
    data.reset()
    out = tips.copy()
    for k in range(len(tips)):
        step(data.model, data, tips[k])
        out[k] += respiration.shift
    return out
