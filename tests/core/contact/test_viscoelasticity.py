"""Relaxation and creep against closed forms, and a dent that fades."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.contact.effects import Viscoelasticity
from avatar_core.contact.model import prepare, step
from avatar_core.contact.tool_path import middle_of_access, slide
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.effect_cases import SPHERE, push_and_drag
from tests.helpers.flat_organ import COMPLIANCE, at_depth, flat_organ

PRONY = Viscoelasticity((0.3, 0.2), (0.05, 0.7))


def relaxed_force(times: np.ndarray, depths: np.ndarray, t: float) -> float:
    """f(t) = int g(t - t') d(depth)/C for a motion that is linear between its corners."""
    g, tau = np.array(PRONY.g), np.array(PRONY.tau)
    force = 0.0
    for t0, t1, d0, d1 in zip(times[:-1], times[1:], depths[:-1], depths[1:], strict=True):
        end = min(t1, t)
        if end <= t0:
            break
        rate = (d1 - d0) / (t1 - t0) / COMPLIANCE
        decay = np.exp(-(t - end) / tau) - np.exp(-(t - t0) / tau)
        force += rate * ((1.0 - g.sum()) * (end - t0) + float(g * tau @ decay))
    return force


@pytest.mark.parametrize("period", [0.1e-3, 0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3])
def test_relaxation_is_exact_for_motion_in_straight_lines(period: float) -> None:
    """Down, hold, further down, half back: the closed form to 1e-6 whatever the step."""
    times = np.array([0.0, 0.1, 0.5, 0.6, 0.9, 1.0])
    depths = 1e-3 * np.array([0.0, 3.0, 3.0, 4.0, 4.0, 2.0])
    model = flat_organ((PRONY,), period)
    worst, peak = 0.0, 0.0
    for k in range(1, round(1.0 / period) + 1):
        t = k * period
        step(model, at_depth(float(np.interp(t, times, depths))))
        exact = relaxed_force(times, depths, t)
        worst, peak = max(worst, abs(model.out.force[0, 2] - exact)), max(peak, exact)
    assert worst < 1e-6 * peak


RAMP = 0.02  # [s] in which the force of the creep test grows


def creep(t: float) -> float:
    """Depth over C f of the flat organ, t after the start of a ramp to a constant force.

    The compliance J(s) = 1 / (s^2 g(s)) of two Maxwell terms by partial fractions, integrated over
    the ramp.
    """
    (g0, g1), (tau0, tau1) = PRONY.g, PRONY.tau
    rest, p = 1.0 - g0 - g1, np.poly1d([1.0, 0.0])
    a, b = np.poly1d([tau0, 1.0]), np.poly1d([tau1, 1.0])
    numerator = a * b * rest + p * b * (g0 * tau0) + p * a * (g1 * tau1)
    value = 1.0 / rest
    for root in numerator.roots:
        part = (a * b)(root) / (root * numerator.deriv()(root))
        value += part * (np.exp(root * t) - np.exp(root * (t - RAMP))) / (root * RAMP)
    return float(value)


def crept(period: float, force: float, end: float) -> float:
    """Depth at the end of a force that grows in RAMP and stays, the tip moved to hold it."""
    model = flat_organ((PRONY,), period)
    depth = 0.0
    for k in range(1, round(end / period) + 1):
        wanted = force * min(1.0, k * period / RAMP)
        # the next step is affine in the depth: two trials, of which the memory knows nothing
        found = []
        for trial in (depth + 1e-3, depth + 2e-3):
            kept = [array.copy() for array in model.effects.viscoelasticity]
            step(model, at_depth(trial))
            found.append(model.out.force[0, 2])
            for array, before in zip(model.effects.viscoelasticity, kept, strict=True):
                array[...] = before
        depth += 1e-3 + 1e-3 * (wanted - found[0]) / (found[1] - found[0])
        step(model, at_depth(depth))
    return depth


def test_creep_under_a_held_force_is_of_second_order() -> None:
    """1e-3 at a tenth of the shortest relaxation time, and four times less at half of that."""
    end, force, shortest = 0.2, 5.0, min(PRONY.tau)
    exact = creep(end) * COMPLIANCE * force
    errors = [abs(crept(part * shortest, force, end) / exact - 1.0) for part in (0.2, 0.1, 0.05)]
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.15)


def test_tissue_comes_back_slowly_where_a_tool_has_been(phantom_vademecum: Vademecum) -> None:
    """The cloud keeps a dent after release, which fades with the relaxation times."""
    v = phantom_vademecum
    model = prepare(v, (SPHERE,), cloud="surface", effects=(Viscoelasticity((0.5,), (0.1,)),))
    path = push_and_drag(v)
    for _ in range(5):
        for tip in path:
            step(model, tip[None])
    deep = np.abs(model.out.cloud[:, 3:]).max()
    away = path[-1] + 50e-3 * v.surface.normals[middle_of_access(v)]
    dents = []
    for _ in range(3):
        step(model, away[None])
        dents.append(np.abs(model.out.cloud[:, 3:]).max())
        for _ in range(299):
            step(model, away[None])
    assert model.out.force[0].any() == False  # noqa: E712
    assert 0.1 * deep < dents[0] < deep
    assert dents[1] < 0.5 * dents[0]
    assert dents[2] < 0.5 * dents[1]


def test_a_history_moves_the_cloud_as_its_loads_do(phantom_vademecum: Vademecum) -> None:
    """Of soft tissue that was stroked across more regions than are shown in full."""
    v, tip = phantom_vademecum, Tip("patch", 8e-3)
    model = prepare(v, (tip,), cloud="volume", effects=(Viscoelasticity((0.9,), (5.0,)),))
    mass, errors = np.repeat(v.mesh.vertex_volumes, 3), []
    for k, at in enumerate(slide(v, tip.offset, 4e-3, 0.15)):
        step(model, at[None].copy())
        if k % 100 == 99:
            past = model.effects.viscoelasticity
            exact = np.zeros(len(mass))
            for m in range(past.count[0]):
                at_one = v.displacement(past.position[m : m + 1], np.ones(1))
                exact += at_one @ past.near_elastic[m]
            wrong = model.out.cloud[:, 3:].ravel() - exact
            errors.append(np.sqrt((mass * wrong**2).sum() / (mass * exact**2).sum()))
    assert np.mean(errors) < 1e-2


def test_fresh_tissue_is_stiffer_than_tissue_that_was_held(phantom_vademecum: Vademecum) -> None:
    """A long hold relaxes the force to the part that is left, 1 - sum g."""
    v = phantom_vademecum
    model = prepare(v, (SPHERE,), cloud="off", effects=(Viscoelasticity((0.4,), (0.02,)),))
    bare = prepare(v, (SPHERE,), cloud="off", effects=())
    tip = push_and_drag(v)[20]
    step(bare, tip[None])
    elastic = np.linalg.norm(bare.out.force[0])
    for _ in range(400):
        step(model, tip[None])
    assert np.linalg.norm(model.out.force[0]) == pytest.approx(0.6 * elastic, rel=1e-4)
