"""Contact at its limits: 5 m/s, a million newton a metre, release at full load, any rate of poses.

Along any path the tools' work is what the organ stores, but for the trapezoidal rule: where a
contact begins or ends within a step h it takes K h^2 / 8 for what is none, at most.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.common.splines import evaluate
from avatar_core.contact.effects import Effect, Friction, Inertia, Viscoelasticity
from avatar_core.contact.effects.friction import tangential_force
from avatar_core.contact.locate import LEAP, MAX_DEPTH
from avatar_core.contact.model import ContactModel, Status, step, stored_energy
from tests.helpers.examples import examples
from tests.helpers.flat_organ import COMPLIANCE, at_depth, flat_organ
from tests.helpers.flat_organ import RADIUS as FLAT_RADIUS
from tests.helpers.touching import (
    AWAY,
    RADIUS,
    Spot,
    any_spot,
    complementarity,
    enter,
    line,
    liver,
    spots,
    stiffened,
    touched,
    walk,
)

Figure = Callable[[str], None]
often = examples(40, least=16)  # some do not touch, or touch with one tool
PERIOD = 1e-3
FAST = 5.0  # [m/s]
FRICTION = Friction(static=0.4, kinetic=0.3)


# --- 5 m/s --------------------------------------------------------------------------------------


FLAT: dict[str, tuple[Effect, ...]] = {"bare": (), "friction": (FRICTION,)}
MISSED: list[float] = []


@cache
def _flat(effects: tuple[Effect, ...]) -> ContactModel:
    """A flat organ, compiled when a test wants it and not when tests are collected."""
    return flat_organ(effects)


@often
@given(
    start=st.floats(1e-4, 5e-3),
    slope=st.floats(-1.0, 1.0),
    periods=st.integers(1, 5),
    kind=st.sampled_from(sorted(FLAT)),
)
@example(start=2.5e-3, slope=0.0, periods=1, kind="bare")
def check_fast_push(start: float, slope: float, periods: int, kind: str) -> None:
    """Into a flat organ, aslant, and back out."""
    model = _flat(FLAT[kind])
    model.reset()
    h = FAST * PERIOD
    way = h * np.array([slope, 0.0, -1.0]) / np.hypot(1.0, slope)
    top = at_depth(-start)
    inward = np.array([top + k * way for k in range(periods + 1)])
    path = np.concatenate([inward, inward[-2::-1], [AWAY[None]]])
    loop = walk(model, path[:-1])
    assert (loop.status == Status.OK).all()
    depth = np.maximum(0.0, FLAT_RADIUS - path[:-1, 0, 2])
    pressed = loop.force[:, 0, 2]
    np.testing.assert_allclose(pressed, depth / COMPLIANCE, rtol=1e-6, atol=1e-6)
    most = (way[2] ** 2) / COMPLIANCE / 8.0
    deepest = periods
    stored = 0.5 * depth[deepest] ** 2 / COMPLIANCE
    across = np.abs(loop.force[:, 0, 0])
    if kind == "bare":
        assert across.max() < 1e-12 * max(1.0, pressed.max())
        assert -1e-9 <= loop.work[deepest] - stored <= most * (1.0 + 1e-6)
        # what the rule takes in excess on the way in, it gives back on the way out
        assert abs(loop.work[-1]) < 1e-9
        MISSED.append((loop.work[deepest] - stored) / most)
    else:
        assert (across <= FRICTION.static * pressed * (1.0 + 1e-9)).all()
        assert loop.work[-1] >= -1e-9
    step(model, AWAY[None])
    assert not model.out.force.any()


@pytest.mark.examples
def test_push_at_5_m_per_s(figure: Figure) -> None:
    MISSED.clear()
    check_fast_push()
    assert max(MISSED) > 0.5  # the bound is met, not only kept
    figure(f"{len(MISSED)} pushes: work - stored energy 0 to {max(MISSED):.2f} K h^2 / 8")


def test_push_through_the_organ_at_5_m_per_s(figure: Figure) -> None:
    """The force grows with the depth; beyond 25 mm, and once barred, it is none."""
    model, spot = touched(), spots()[0]
    stiff = 1.0 / float(model.arrays.self_compliance[model.arrays.row >= 0].min())
    path = line(spot.tip(-2e-3), spot.tip(RADIUS + 60e-3), FAST * PERIOD)
    loop = walk(model, path)
    size = np.linalg.norm(loop.force[:, 0], axis=1)
    assert size.max() < 1.5 * stiff * (RADIUS + MAX_DEPTH)
    f, unused = liver().tip_field, np.zeros(3)
    depth = [-evaluate(f.distance, f.origin, f.spacing[0], p[0], unused, 1.0) for p in path]
    assert not size[np.array(depth) > MAX_DEPTH].any()
    barred = (loop.status[:, 0] == Status.OUT_OF_RANGE) & (size == 0.0)
    assert barred.any()  # the organ is thinner than 25 mm in places, and its wall is met instead
    assert not size[barred.argmax() :].any()
    peak = size.max()
    assert peak > 10.0
    figure(f"at most {peak:.0f} N, none beyond {1e3 * MAX_DEPTH:.0f} mm")


SLOWER = 50
SLID: list[tuple[float, float]] = []


@often
@given(spot=any_spot(30e-3), turn=st.floats(0.0, 2 * np.pi), depth=st.floats(1e-3, 5e-3))
def check_fast_slide(spot: Spot, turn: float, depth: float) -> None:
    """The forces are those of a slow slide, whose work is what the organ stores."""
    model, heading = touched(), np.array([np.cos(turn), np.sin(turn)])
    ends = [spot.tip(depth, *(x * heading)) for x in (-20e-3, 20e-3)]
    h = FAST * PERIOD / SLOWER
    path = line(*ends, h)
    model.reset()
    stored = []
    for tip in path:
        step(model, tip)
        stored.append(stored_energy(model))
    change = np.array(stored) - stored[0]
    model.reset()
    slow = walk(model, path)
    model.reset()
    fast = walk(model, path[::SLOWER])
    if not ((slow.status == Status.OK).all() and (fast.status == Status.OK).all()):
        return
    np.testing.assert_array_equal(fast.force, slow.force[::SLOWER])
    off = [
        np.abs(fast.work - change[::SLOWER]).max() / rule_error(model, fast.force, SLOWER * h),
        np.abs(slow.work - change).max() / rule_error(model, slow.force, h),
    ]
    assert max(off) <= 1.0
    SLID.append((off[0], off[1]))


def rule_error(model: ContactModel, force: np.ndarray, h: float) -> float:
    """Of the trapezoidal rule: K h^2 / 8 for each touch, and h^3 / 12 F'' a step [J].

    F'' <= K / 12 mm on a surface that the patch of 12 mm rounds.
    """
    stiff = 1.0 / float(model.arrays.self_compliance[model.arrays.row >= 0].min())
    touching = np.linalg.norm(force[:, 0], axis=1) > 0.0
    touches = np.abs(np.diff(touching.astype(int))).sum()
    return float(stiff * h**2 / 8.0 * touches + len(force) * h**3 / 12.0 * stiff / 12e-3)


@pytest.mark.examples
def test_slide_at_5_m_per_s(figure: Figure) -> None:
    SLID.clear()
    check_fast_slide()
    assert len(SLID) > 10
    fast, slow = np.max(SLID, axis=0)
    figure(
        f"{len(SLID)} slides: forces of a slide at 0.1 m/s; work - stored energy at most "
        f"{fast:.2f} of the rule's bound, {slow:.2f} at 0.1 m/s"
    )


# --- A million newton a metre -------------------------------------------------------------------


STIFF: dict[float, ContactModel] = {}
CLOSED: list[tuple[float, int]] = []


@often
@given(
    spot=any_spot(),
    stiffness=st.sampled_from([1e3, 1e4, 1e5, 1e6, 1e8]),
    n_tools=st.integers(1, 8),
    spread=st.sampled_from([1e-4, 1e-3, 10e-3]),
    seed=st.integers(0, 1000),
)
@example(spot=None, stiffness=1e6, n_tools=8, spread=1e-3, seed=3)
def check_stiff(
    spot: Spot | None, stiffness: float, n_tools: int, spread: float, seed: int
) -> None:
    spot = spot or spots()[0]
    rng = np.random.default_rng(seed)
    if stiffness not in STIFF:
        soft = touched(n_tools=8)
        mean = soft.arrays.self_compliance[soft.arrays.row >= 0].mean()
        STIFF[stiffness] = stiffened(soft, stiffness * mean, several=True)
    model = STIFF[stiffness]
    model.reset()
    tips = np.tile(AWAY, (8, 1))
    for t in range(n_tools):
        tips[t] = spot.tip(rng.uniform(3e-3, 3.2e-3), *rng.uniform(-spread, spread, 2))
    assert step(model, tips) == Status.OK
    inside, apart = complementarity(model)
    assert max(inside, apart) < 2e-9
    s = model.state
    work = -0.5 * s.force @ np.where(s.active, s.gap, 0.0)
    assert stored_energy(model) == pytest.approx(work, rel=1e-5)
    # not even a million newton a metre moves more than the tip is deep
    assert np.abs(model.out.cloud[:, 3:]).max() < 3.0 * -s.gap[s.active].min()
    CLOSED.append((max(inside, apart), int((s.force > 0.0).sum())))


@pytest.mark.examples
def test_very_stiff_organs_stay_complementary(figure: Figure) -> None:
    CLOSED.clear()
    check_stiff()
    left, pressed = np.max(CLOSED, axis=0)
    assert pressed > 1  # or nothing was shared
    figure(f"1e3 to 1e8 N/m, up to {pressed:.0f} tools pressed: gaps closed within {left:.1e} m")


@pytest.mark.parametrize("compliance", [1e-6, 1e-8])
def test_friction_on_a_very_stiff_organ(compliance: float, figure: Figure) -> None:
    """A micrometre sticks, a millimetre slips: closed form, 4 kN pressed."""
    model = flat_organ((FRICTION,), compliance=compliance)
    depth = 4e-3
    for _ in range(3):
        assert step(model, at_depth(depth)) == Status.OK
    normal = depth / compliance
    assert model.out.force[0, 2] == pytest.approx(normal, rel=1e-6)
    drag = 0.5 * FRICTION.static * depth
    assert step(model, at_depth(depth, x=drag)) == Status.OK
    stuck = model.out.force[0, 0]
    assert stuck == pytest.approx(-drag / compliance, rel=1e-5)
    assert step(model, at_depth(depth, x=5.0 * drag)) == Status.OK
    slid = model.out.force[0, 0]
    assert slid == pytest.approx(-FRICTION.kinetic * normal, rel=1e-6)
    figure(f"{-stuck:.0f} N stuck, {-slid:.0f} N slipping, of {normal:.0f} N")


# --- Release at full load -----------------------------------------------------------------------


@pytest.mark.parametrize("far", [20e-3, 0.9 * LEAP, 0.5], ids=["20 mm", "45 mm", "0.5 m"])
@pytest.mark.parametrize("effects", [(), (FRICTION,)], ids=["bare", "friction"])
def test_release_at_full_load(effects: tuple[Friction, ...], far: float, figure: Figure) -> None:
    model, spot = touched(effects), spots()[0]
    enter(model, spot, RADIUS + 15e-3)
    peak, moved = np.linalg.norm(model.out.force), np.abs(model.out.cloud[:, 3:]).max()
    assert step(model, (spot.tip(0.0) + far * spot.normal)[None]) == Status.OK
    assert not model.out.force.any() and not model.out.torque.any()
    assert model.out.n_contacts[0] == 0
    assert not model.out.cloud[:, 3:].any()
    figure(f"{peak:.1f} N and {1e3 * moved:.1f} mm to exactly none in a period")


def test_viscoelastic_organ_creeps_back(figure: Figure) -> None:
    """Held until relaxed, then let go: e = g e_0 exp(- g_inf t / tau)."""
    g, tau, depth = 0.6, 0.1, 4e-3
    model = flat_organ((Viscoelasticity((g,), (tau,)),))
    for _ in range(3000):
        step(model, at_depth(depth))
    assert model.out.force[0, 2] == pytest.approx((1.0 - g) * depth / COMPLIANCE, rel=1e-6)
    held = model.effects.viscoelasticity.elastic[2]
    step(model, AWAY[None])
    assert not model.out.force.any()
    times, left = np.arange(200) * PERIOD, np.zeros(200)
    for k in range(200):
        left[k] = model.effects.viscoelasticity.elastic[2] / held
        step(model, AWAY[None])
    expected = g * np.exp(-(1.0 - g) * times / tau)
    off = np.abs(left / left[0] * g - expected).max()
    assert off < 1e-6  # exact for any period but for the first, in which the load goes
    assert left[0] == pytest.approx(g, rel=PERIOD / tau)
    for _ in range(8000):
        step(model, AWAY[None])
    assert abs(model.effects.viscoelasticity.elastic[2]) < 1e-10 * abs(held)
    figure(f"creep off by {off:.1e}, nothing left after 8 s")


def test_organ_with_mass_swings_out(figure: Figure) -> None:
    """After release the energy only falls, that of each mode as exp(- 2 zeta omega t)."""
    zeta, n = 0.05, 400
    model, spot = touched((Inertia(damping=zeta),)), spots()[0]
    enter(model, spot, RADIUS + 10e-3)
    for _ in range(3000):
        step(model, spot.tip(RADIUS + 10e-3)[None])
    step(model, AWAY[None])
    assert not model.out.force.any()
    inertia, energy = model.effects.inertia, []
    moving = slice(len(inertia.mass))  # the other modes of contact follow at once
    for _ in range(n):
        energy.append(0.5 * (inertia.mass * inertia.velocity**2 + inertia.modes[moving] ** 2))
        step(model, AWAY[None])
    modes = np.array(energy)
    total = modes.sum(axis=1)
    assert (np.diff(total) <= 1e-12 * total[0]).all()
    assert total[0] > 1e-3
    rates = []
    for k in np.argsort(-modes[0])[:5]:
        omega = 1.0 / np.sqrt(inertia.mass[k])
        # energy swings about its mean decay by zeta: over whole half periods it does not
        half = round(np.pi / omega / PERIOD)
        last = half * max(1, round(min(n - 1, 3.0 / (2.0 * zeta * omega * PERIOD)) // half))
        measured = -np.log(modes[last, k] / modes[0, k]) / (last * PERIOD)
        rates.append(measured / (2.0 * zeta * omega))
    np.testing.assert_allclose(rates, 1.0, atol=0.1)
    for _ in range(20_000):
        step(model, AWAY[None])
    left = float(np.abs(model.out.cloud[:, 3:]).max())
    assert left < 1e-9
    figure(f"decay over 2 zeta omega {min(rates):.3f} to {max(rates):.3f}, {left:.1e} m left")


# --- Any rate of poses --------------------------------------------------------------------------


def wander(spot: Spot, n: int, rate: float, seed: int, speed: float) -> np.ndarray:
    """A smooth path in and out of contact, (n, 1, 3), no faster than ``speed``."""
    rng, time = np.random.default_rng(seed), np.arange(n) / rate
    size = np.array([2e-3, 4e-3, 4e-3])
    q = np.zeros((n, 3))
    for k, a in enumerate(size):
        omega = speed / (2.0 * a) * rng.uniform(0.3, 0.6, 2)
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        q[:, k] = 0.5 * a * np.sin(omega * time[:, None] + phase).sum(axis=1)
    return np.array([spot.tip(1e-3 + d, x, y)[None] for d, x, y in q])


@pytest.mark.parametrize("seed", range(4))
def test_force_does_not_know_the_rate_of_poses(seed: int, figure: Figure) -> None:
    """Bare, 5 kHz, every fifth of them, and 10 Hz held for 100 periods: the same, to the bit."""
    model, spot = touched(), spots(30e-3)[seed]
    path = wander(spot, 20_000, 5000.0, seed, 0.05)
    fine = walk(model, path).force
    cloud = model.out.cloud.copy()
    assert (np.linalg.norm(fine[:, 0], axis=1) > 0.0).mean() > 0.1
    model.reset()
    decimated = walk(model, path[::5]).force
    np.testing.assert_array_equal(decimated, fine[::5])
    model.reset()
    held = walk(model, np.repeat(path[::500], 100, axis=0)).force
    np.testing.assert_array_equal(held, np.repeat(fine[::500], 100, axis=0))
    step(model, path[-1])
    np.testing.assert_array_equal(model.out.cloud, cloud)
    figure("5 kHz, 1 kHz, 10 Hz held: equal to the bit")


def test_held_pose_leaves_friction_as_it_is(figure: Figure) -> None:
    model, spot, worst = touched((FRICTION,)), spots(30e-3)[0], 0.0
    path = wander(spot, 100, 10.0, 5, 0.02)
    moved = 0.0
    for tip in path:
        step(model, tip)
        step(model, tip)  # a new contact sticks from its second period on
        first = model.out.force.copy()
        for _ in range(50):
            step(model, tip)
            worst = max(worst, float(np.abs(model.out.force - first).max()))
        moved = max(moved, float(tangential_force.py_func(model.state, model.effects.friction, 0)))
    assert moved > 0.1
    assert worst < 1e-5  # the tolerance of a gap, 1e-9 m, over the compliance
    figure(
        f"10 Hz held for 50 periods: force moves by {worst:.1e} N of friction up to {moved:.1f} N"
    )
