"""Steps per second of many loops on one organ: in one call, and one after the other in Python."""

from __future__ import annotations

import time

import numpy as np

from avatar_core.contact.many import step_many
from avatar_core.contact.model import model_of, step
from avatar_core.contact.tool_path import inner_positions
from avatar_core.studies.bench.methods import SPHERE, shown_cloud
from avatar_core.vademecum.model import Vademecum

LOOPS, PERIODS = 256, 100


def steps_per_second(organ: Vademecum) -> dict[str, float]:
    """Return both rates, as medians over pushes of a sphere that both do in turn [1/s]."""
    model = model_of(organ, (SPHERE,), cloud=shown_cloud(organ))
    chosen = np.resize(inner_positions(organ), LOOPS)
    centers, normals = organ.surface.centers[chosen], organ.surface.normals[chosen]
    together, alone = ([model.data() for _ in range(LOOPS)] for _ in range(2))
    seconds = np.empty((PERIODS, 2))
    for period, depth in enumerate(np.linspace(-2e-3, 5e-3, PERIODS)):
        tips = centers + (SPHERE.offset - depth) * normals
        start = time.perf_counter()
        step_many(model, together, tips)
        middle = time.perf_counter()
        for data, tip in zip(alone, tips, strict=True):
            step(model, data, tip)
        seconds[period] = middle - start, time.perf_counter() - middle
    many, one = LOOPS / np.median(seconds, axis=0)
    return {"steps_per_second_many": float(many), "steps_per_second_loop": float(one)}
