"""No closed path gains energy: the force is the derivative of what is stored."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.contact.model import ContactModel, Status, prepare, step, stored_energy
from avatar_core.contact.tool_path import inner_positions
from avatar_core.vademecum.model import Vademecum
from tests.core.contact.test_contact import RADIUS, SPHERE, refined


def test_closed_paths_do_no_work(phantom_vademecum: Vademecum) -> None:
    model = prepare(phantom_vademecum, (SPHERE,), cloud="volume")
    worst = closed_path_work(phantom_vademecum, model, 30, seed=0)
    assert worst < 0.01


@pytest.mark.long
def test_closed_paths_on_real_livers_do_no_work(real_vademecum: Vademecum) -> None:
    worst = closed_path_work(real_vademecum, prepare(real_vademecum, (SPHERE,)), 60, seed=1)
    print(f"{real_vademecum.name}: work at most {worst:.2%} of the peak stored energy")
    assert worst < 0.01


def closed_path_work(v: Vademecum, model: ContactModel, n_paths: int, seed: int) -> float:
    """Largest |work| / peak energy over loops that start and end 15 mm above the organ.

    A loop that only grazes the organ leaves it within a step or two, which the trapezoidal rule
    does not resolve; a loop that stands out is integrated again, twenty times finer. Where the
    organ folds, 15 mm above one part may lie within another: such a loop is left out, since a tip
    that begins inside has no force until it has come out.
    """
    rng = np.random.default_rng(seed)
    inner = inner_positions(v, 20e-3)
    worst, n_walked = 0.0, 0
    for _ in range(n_paths):
        path = closed_path(v, rng.choice(inner), rng)
        if not begins_outside(model, path):
            continue
        n_walked += 1
        work, peak = work_along(model, path)
        if peak > 1e-5 and work > max(worst, 2e-3) * peak:
            work, peak = work_along(model, refined(path, 20))
        if peak > 1e-5:
            worst = max(worst, work / peak)
    assert n_walked > 0.8 * n_paths
    return worst


def begins_outside(model: ContactModel, path: np.ndarray) -> bool:
    """Whether the tip touches nothing where the path begins."""
    model.reset()
    return step(model, path[:1].copy()) == Status.OK and not model.out.force[0].any()


def closed_path(v: Vademecum, position: int, rng: np.random.Generator) -> np.ndarray:
    """Down from above a load position, along four random corners around it, and back up."""
    center, n = v.surface.centers[position], v.surface.normals[position]
    corners = center + RADIUS * n + rng.uniform(-12e-3, 12e-3, (4, 3))
    corners += np.outer(-((corners - center) @ n) + RADIUS, n)
    corners -= np.outer(rng.uniform(0, 6e-3, 4), n)
    start = corners[0] + n * 15e-3
    return refined(np.array([start, *corners, start]), 400)


def work_along(model: ContactModel, path: np.ndarray) -> tuple[float, float]:
    """|Work| of the force along a path, by the trapezoidal rule, and peak stored energy [J]."""
    model.reset()
    force, peak = np.zeros_like(path), 0.0
    for k, tip in enumerate(path):
        step(model, tip[None].copy())
        force[k] = model.out.force[0]
        if force[k].any():
            peak = max(peak, stored_energy(model))
    work = 0.5 * ((force[1:] + force[:-1]) * np.diff(path, axis=0)).sum()
    return abs(float(work)), peak
