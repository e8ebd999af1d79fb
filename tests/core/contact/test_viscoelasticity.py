"""Relaxation and creep against closed forms, and a fading dent."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.contact.effects import Effect, Inertia, Viscoelasticity
from avatar_core.contact.model import deform
from avatar_core.contact.tool_path import slide
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.coarse_liver import RADIUS, liver, spots
from tests.helpers.contact import prepare, step
from tests.helpers.flat_organ import COMPLIANCE, at_depth, flat_organ, force_at_depth
from tests.helpers.tool_motion import AWAY

PRONY = Viscoelasticity((0.3, 0.2), (0.05, 0.7))


def relaxed_force(times: np.ndarray, depths: np.ndarray, t: float) -> float:
    """Integrate f(t) = int g(t - t') d(depth)/C for a motion that is linear between corners."""
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


@pytest.mark.long
@pytest.mark.parametrize("period", [0.1e-3, 1e-3, 10e-3])
def test_relaxation_is_exact_for_motion_in_straight_lines(period: float) -> None:
    """Down, hold, further down, half back: the closed form to 1e-6 for any step."""
    times = np.array([0.0, 0.1, 0.5, 0.6, 0.9, 1.0])
    depths = 1e-3 * np.array([0.0, 3.0, 3.0, 4.0, 4.0, 2.0])
    data = flat_organ((PRONY,), period)
    worst, peak = 0.0, 0.0
    for k in range(1, round(1.0 / period) + 1):
        t = k * period
        force = force_at_depth(data, float(np.interp(t, times, depths)))
        exact = relaxed_force(times, depths, t)
        worst, peak = max(worst, abs(force - exact)), max(peak, exact)
    assert worst < 1e-6 * peak


RAMP = 0.02  # time in which the force of the creep test grows [s]


def creep(t: float) -> float:
    """Return depth over C f of the flat organ, t after the start of a ramp to a constant force.

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
    """Return the depth under a force that grows in RAMP and stays, by moving the tip."""
    data = flat_organ((PRONY,), period)
    depth = 0.0
    for k in range(1, round(end / period) + 1):
        wanted = force * min(1.0, k * period / RAMP)
        # the next step is affine in the depth: two trials, which the memory does not note
        found = []
        for trial in (depth + 1e-3, depth + 2e-3):
            before = [array.copy() for array in data.state.viscoelasticity]
            found.append(force_at_depth(data, trial))
            for array, earlier in zip(data.state.viscoelasticity, before, strict=True):
                array[...] = earlier
        depth += 1e-3 + 1e-3 * (wanted - found[0]) / (found[1] - found[0])
        step(data, at_depth(depth))
    return depth


def test_creep_under_a_held_force_is_of_second_order() -> None:
    """1e-3 at a tenth of the shortest relaxation time, and four times less at half of that."""
    end, force, shortest = 0.2, 5.0, min(PRONY.tau)
    exact = creep(end) * COMPLIANCE * force
    errors = [abs(crept(part * shortest, force, end) / exact - 1.0) for part in (0.2, 0.1, 0.05)]
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.15)


def test_an_organ_that_is_let_go_creeps_back() -> None:
    """Held until relaxed, then released: e = g e_0 exp(- g_inf t / tau)."""
    g, tau, period, depth = 0.6, 0.1, 1e-3, 4e-3
    data = flat_organ((Viscoelasticity((g,), (tau,)),))
    first = force_at_depth(data, depth)
    for _ in range(2999):
        force = force_at_depth(data, depth)
    assert force == pytest.approx((1.0 - g) * depth / COMPLIANCE, rel=1e-6)
    elastic = data.state.viscoelasticity.elastic
    held, left = elastic[2], []
    for _ in range(8200):
        step(data, AWAY[None])
        assert not data.out.force.any()
        left.append(elastic[2] / held)
    expected = g * np.exp(-(1.0 - g) * np.arange(200) * period / tau)
    # exact for any period except the first, in which the load ends
    np.testing.assert_allclose(np.array(left[:200]) / left[0] * g, expected, atol=1e-6)
    assert left[0] == pytest.approx(g, rel=period / tau)
    assert abs(left[-1]) < 1e-10
    assert force_at_depth(data, depth) == pytest.approx(first, rel=1e-7)


def test_a_sphere_relaxes_as_the_tissue_does() -> None:
    """In the end the force is that on elastic tissue of the relaxed modulus (Lee & Radok)."""
    soft, sphere = Viscoelasticity((0.6,), (0.02,)), Tip("sphere", 5e-3)
    data = flat_organ((soft,), tip=sphere)
    elastic = force_at_depth(flat_organ(tip=sphere), 3e-3)
    forces = [force_at_depth(data, 3e-3) for _ in range(401)]
    assert forces[0] == pytest.approx(elastic, rel=0.03)  # a period has relaxed a little
    assert forces[-1] == pytest.approx(0.4 * elastic, rel=1e-6)


def test_a_history_moves_the_cloud_as_its_loads_do(phantom_vademecum: Vademecum) -> None:
    """Soft tissue was stroked across more regions than are shown in full."""
    v, tip = phantom_vademecum, Tip("patch", 8e-3)
    data = prepare(v, (tip,), cloud="volume", effects=(Viscoelasticity((0.9,), (5.0,)),))
    mass, errors = np.repeat(v.mesh.vertex_volumes, 3), []
    for k, at in enumerate(slide(v, tip.offset, 4e-3, 0.15)):
        step(data, at[None].copy())
        if k % 100 == 99:
            past = data.state.viscoelasticity
            exact = np.zeros(len(mass))
            for m in range(past.count[0]):
                at_one = v.displacement(past.position[m : m + 1], np.ones(1))
                exact += at_one @ past.near_elastic[m]
            wrong = data.out.cloud[:, 3:].ravel() - exact
            errors.append(np.sqrt((mass * wrong**2).sum() / (mass * exact**2).sum()))
    assert np.mean(errors) < 1e-2


@pytest.mark.parametrize("effects", [(PRONY,), (PRONY, Inertia())])
def test_another_model_of_the_same_material_goes_on_with_the_history(
    effects: tuple[Effect, ...],
) -> None:
    """Force and cloud go on; another relaxation begins at rest, with all of the force."""
    spot, tip = spots()[0], Tip("sphere", RADIUS)
    data = prepare(liver(), (tip,), effects=effects)
    for depth in [*np.linspace(-1e-3, 3e-3, 50), *[3e-3] * 3000]:
        step(data, spot.tip(depth)[None])
    deform(data.model, data)
    force, cloud = data.out.force.copy(), data.out.cloud.copy()
    later = prepare(liver(), (tip,), effects=effects)
    later.resume(data)
    step(later, spot.tip(3e-3)[None])
    deform(later.model, later)
    np.testing.assert_allclose(later.out.force, force, rtol=1e-3)
    np.testing.assert_allclose(later.out.cloud, cloud, atol=1e-6)
    other = prepare(liver(), (tip,), effects=(Viscoelasticity((0.5,), (0.1,)), *effects[1:]))
    other.resume(data)
    for _ in range(5):
        step(other, spot.tip(3e-3)[None])
    assert np.linalg.norm(other.out.force) > 1.3 * np.linalg.norm(force)
