"""Passivity control: silent when nothing is to be done, exact otherwise, always finite."""

from __future__ import annotations

import math

import numpy as np
import pytest

from avatar_core.contact.layout import PERIOD
from avatar_core.errors import ContactError
from avatar_core.haptics.passivity import Passivity, limit, make_passivity, reset

STIFFNESS = 1000.0  # [N/m]


def pushed(passivity: Passivity, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return forces of a spring along z and the sent ones, (n,), for a path into it (n,)."""
    organ, sent = STIFFNESS * np.maximum(depth, 0.0), np.zeros(len(depth))
    for k, into in enumerate(depth):
        force = np.array([[0.0, 0.0, organ[k]]])
        limit(passivity, np.array([[0.0, 0.0, -into]]), force)
        sent[k] = force[0, 2]
    return organ, sent


@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("resolution", [0.0, 1e-5])
def test_forces_of_a_slow_tool_are_unchanged_to_the_bit(delay: int, resolution: float) -> None:
    """1 mm in and out in 8 s: hold and delay make K (1/2 + delay) |d|^2 a period, 3 uJ in all."""
    depth = -2e-4 + 1.2e-3 * np.sin(np.linspace(0.0, np.pi, 8000)) ** 2
    if resolution:
        depth = np.rint(depth / resolution) * resolution
    passivity = make_passivity(1, delay, resolution)
    organ, sent = pushed(passivity, depth)
    assert np.array_equal(organ, sent)
    assert passivity.created[0] <= passivity.tolerance


def test_a_tool_at_rest_and_a_free_tool_are_left_alone() -> None:
    """Without motion no force works; without force no motion works."""
    rng = np.random.default_rng(0)
    passivity = make_passivity(2, 1, 1e-5)
    for k in range(200):
        meant = np.array([0.3 * rng.standard_normal(3), np.zeros(3)])
        force = meant.copy()
        limit(passivity, np.array([[0.1, 0.2, 0.3], 1e-3 * rng.standard_normal(3)]), force)
        assert np.array_equal(force, meant) or k == 0  # no velocity yet, no force
    np.testing.assert_array_equal(passivity.energy, 0.0)


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_the_bounding_is_not_felt_up_to_its_stiffness_and_speed(delay: int) -> None:
    """In and out at 0.1 m/s: the same to the bit as without it; out at 0.5 m/s it acts."""
    way = 1e-4 * np.concatenate([np.arange(-5.0, 50.0), np.full(20, 50.0)])
    for speed, felt in ((0.1, False), (0.5, True)):
        path = np.concatenate([way, np.arange(50e-4, -10e-4, -speed * PERIOD)])
        bounded = make_passivity(1, delay, 0.0, stiffness=STIFFNESS)
        free = make_passivity(1, delay, 0.0, stiffness=math.inf)
        same = np.array_equal(pushed(bounded, path)[1], pushed(free, path)[1])
        assert same is not felt


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_the_missing_energy_is_dissipated_exactly(delay: int) -> None:
    """Into a spring and out at constant speed the forecast is exact: G stays at the tolerance."""
    passivity = make_passivity(1, delay, 0.0)
    speed, n = 0.05, 100
    step = speed * PERIOD
    created = []
    for k in range(n):
        force = np.array([[0.0, 0.0, STIFFNESS * (2e-3 + step * k)]])
        limit(passivity, np.array([[0.0, 0.0, -2e-3 - step * k]]), force)
        created.append(passivity.created[0])
    late = np.array(created[2 * delay + 20 :])
    # sums of 100 terms of 1e-4 J in double precision
    np.testing.assert_allclose(late, passivity.tolerance, atol=1e-15)
    # it adds the damping of the border, K (T / 2 + delay T)
    added = force[0, 2] - STIFFNESS * (2e-3 + step * (n - 1))
    border = STIFFNESS * PERIOD * (0.5 + delay)
    assert added == pytest.approx(border * speed, rel=1e-9)


def test_added_damping_is_bounded_and_against_the_motion() -> None:
    """An organ drives the tool on, in all directions, without another bound."""
    rng = np.random.default_rng(1)
    passivity = make_passivity(1, 1, 0.0, stiffness=math.inf, damping=7.0)
    tip, worst = np.zeros((1, 3)), 0.0
    for k in range(500):
        moved = 2e-4 * rng.standard_normal((1, 3))
        tip += moved
        meant = 1e4 * moved + 3.0 * rng.standard_normal((1, 3))
        force = meant.copy()
        limit(passivity, tip, force)
        if k == 0:  # no velocity yet, no force
            continue
        c = -((force - meant) @ moved.T)[0, 0] / (moved @ moved.T)[0, 0]
        np.testing.assert_allclose(force - meant, -c * moved, atol=1e-12)
        assert -1e-9 <= c <= 7.0 / PERIOD * (1.0 + 1e-9)
        worst = max(worst, c * PERIOD)
    assert worst == pytest.approx(7.0)


def test_a_surplus_is_not_saved_up_for_later() -> None:
    """An organ that softens while the tool goes in takes 0.4 mJ too much; then a spring leaks."""
    passivity = make_passivity(1, 0, 0.0, stiffness=math.inf)
    step = 5e-5
    for k in range(100):
        force = np.array([[0.0, 0.0, 20.0 - 0.16 * k]])
        limit(passivity, np.array([[0.0, 0.0, -step * k]]), force)
    assert passivity.created[0] == -passivity.tolerance
    leak = 0.5 * STIFFNESS * step**2  # a period
    for k in range(100, 140):
        meant = 4.16 + STIFFNESS * step * (k - 99)
        force = np.array([[0.0, 0.0, meant]])
        limit(passivity, np.array([[0.0, 0.0, -step * k]]), force)
        left = 2.0 * passivity.tolerance / leak - (k - 99)  # periods until it is used up, 16 in all
        if abs(left) >= 1.0:
            assert (force[0, 2] > meant) == (left < 0.0)


def test_two_tools_do_not_know_of_each_other() -> None:
    rng = np.random.default_rng(2)
    tips = np.cumsum(2e-4 * rng.standard_normal((300, 2, 3)), axis=0)
    meant = 2.0 * rng.standard_normal((300, 2, 3))
    both = make_passivity(2, 2, 1e-5)
    separate = [make_passivity(1, 2, 1e-5) for _ in range(2)]
    changed = np.zeros(2, bool)
    for k in range(300):
        force = meant[k].copy()
        limit(both, tips[k], force)
        for t in range(2):
            single = meant[k, t : t + 1].copy()
            limit(separate[t], tips[k, t : t + 1], single)
            assert np.array_equal(single[0], force[t])
            changed[t] |= not np.array_equal(single[0], meant[k, t])
    assert changed.all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("of", ["tip", "force"])
def test_what_is_not_finite_gets_no_force_and_leaves_no_trace(value: float, of: str) -> None:
    """The tool itself goes on from where it is found again; the other one is served meanwhile."""
    passivity = make_passivity(2, 1, 0.0, tolerance=1e-3)
    for k in range(60):
        tips = np.full((2, 3), -1e-5 * k)
        force = np.tile([0.0, 0.0, 1e-2 * k], (2, 1))
        if 20 <= k < 25:
            (tips if of == "tip" else force)[0, 1] = value
        before = passivity.energy[0]
        limit(passivity, tips, force)
        if 20 <= k < 25:
            np.testing.assert_array_equal(force[0], 0.0)
            assert passivity.energy[0] == before
        elif k > 25:
            assert force[0, 2] == 1e-2 * k
        assert force[1, 2] == 1e-2 * k
    assert all(np.isfinite(array).all() for array in passivity[6:])
    # 60 periods less the gap, which is not counted
    assert 0.0 < passivity.energy[0] < passivity.energy[1]


def test_a_tool_put_elsewhere_does_no_work() -> None:
    """For the step, a tool without a pose is 1 km away."""
    passivity = make_passivity(1, 0, 0.0, tolerance=1e-3)
    organ, sent = pushed(passivity, np.linspace(0.0, 3e-3, 300))
    assert sent[-1] == organ[-1] > 0.0
    energy = passivity.energy[0]
    limit(passivity, np.full((1, 3), 1e3), np.zeros((1, 3)))
    assert passivity.energy[0] == energy
    reset(passivity)
    assert not any(array.any() for array in passivity[6:])


@pytest.mark.parametrize(
    "wrong",
    [
        {"delay": -1},
        {"delay": 9},
        {"resolution": -1e-5},
        {"resolution": math.nan},
        {"period": 0.0},
        {"stiffness": -1.0},
        {"speed": math.nan},
        {"acceleration": 0.0},
        {"tolerance": 0.0},
        {"damping": -2.0},
    ],
)
def test_bad_numbers_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ContactError, match=next(iter(wrong))):
        make_passivity(1, **{"delay": 1, "resolution": 0.0, **wrong})  # type: ignore[arg-type]
