"""Closed haptic loops: a tool in a hand, the organ's 1 kHz step, its force late and held.

The tool is a linear device, and its motion is exact within each period. So the energy through the
port, E = - sum F . (x' - x), is exact too.

The quantisation bound. The controller sees readings x^ = x - e, |e| <= h = sqrt(3) q / 2, q their
step. Its observed energy E^ differs from E by the work of F on the errors, summed by parts. In
periods in which no coordinate's reading changed by more than q, it counts the organ's own mean
force m = (f + f') / 2 instead of F:

    E - E^ = - sum F_k . (e_k+1 - e_k) - sum_slow (F_k - m_k) . (x^_k+1 - x^_k)
           = - F_n . e_n+1 + sum (F_k - F_k-1) . e_k - sum_slow (F_k - m_k) . (x^_k+1 - x^_k),

so |E - E^| <= Q = h |F_n| + h sum |F_k - F_k-1| + 2 h sum_slow |F_k - m_k|. The controller holds
only forces that keep E^ + (E' - E) >= - bound for any motion of the tool until they end. Hence
E >= - bound - max Q for any organ, if the tool's acceleration stays below the assumed one. Reading
errors of a moving tool average out, and the tests find E >= - bound itself.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.contact.layout import PERIOD
from avatar_core.contact.model import ContactData, Status
from avatar_core.haptics.haptic_loop import Device, Loop, run_loop
from avatar_core.haptics.passivity import Passivity, limit, make_passivity
from avatar_core.studies.passivity import HANDS, hand_push
from tests.helpers.contact import step
from tests.helpers.examples import examples
from tests.helpers.flat_organ import BALL, RADIUS, flat_organ

RESOLUTION = 1e-5  # [m]
ACCELERATION = 100.0  # acceleration that the controller assumes [m/s^2]
STIFFNESSES = (400.0, 1000.0, 2500.0)  # [N/m]
MASSES, DAMPINGS, GRIPS = (0.1, 0.3, 1.0), (0.1, 0.5, 5.0), (0.0, 100.0, 1000.0)
DELAYS = (1, 2)  # periods


class Run(NamedTuple):
    """x before each period and after the last, its readings, f and F, and E after each period."""

    position: np.ndarray
    reading: np.ndarray
    organ: np.ndarray
    held: np.ndarray
    energy: np.ndarray

    @property
    def given(self) -> float:
        """Return the largest energy that the port has given [J]."""
        return max(0.0, -float(self.energy.min()))

    @property
    def acceleration(self) -> float:
        """Return the largest change of a period's mean velocity per period [m/s^2]."""
        change = np.linalg.norm(np.diff(self.position, 2, axis=0), axis=1)
        return float(change.max()) / PERIOD**2

    def quantisation(self, q: float) -> float:
        """Return Q after the last period [J]; its sums only grow."""
        h = 0.5 * np.sqrt(3.0) * q
        steps = np.diff(self.held, axis=0, prepend=np.zeros((1, 3)))
        slow = (np.abs(np.diff(self.reading, axis=0)) < 1.5 * q).all(axis=1)
        mean = 0.5 * (self.organ + np.vstack([self.organ[1:], self.organ[-1:]]))
        off = np.linalg.norm(self.held - mean, axis=1)[:-1][slow[: len(mean) - 1]]
        largest = np.linalg.norm(self.held, axis=1).max()
        return float(h * (largest + np.linalg.norm(steps, axis=1).sum() + 2.0 * off.sum()))


def closed_loop(
    organ: ContactData,
    device: Device,
    delay: int,
    push: np.ndarray,
    start: np.ndarray,
    passivity: Passivity | None,
    q: float = RESOLUTION,
) -> Run:
    """Run the loop with the organ's step from rest at ``start``; push (n, 3) of the hand [N]."""
    a, b = device.transition()
    organ.reset()
    n = len(push)
    run = Run(*(np.zeros((n + extra, 3)) for extra in (1, 1, 0, 0)), energy=np.zeros(n))
    x, v, energy = start.copy(), np.zeros(3), 0.0
    sent = np.zeros((n + delay, 3))
    force = np.zeros((1, 3))
    for k in range(n):
        run.position[k] = x
        run.reading[k] = np.rint(x / q) * q if q > 0.0 else x
        status = step(organ, run.reading[k : k + 1])
        assert status == Status.OK or passivity is None  # out of range, if it flies off
        run.organ[k] = force[0] = organ.out.force[0]
        if passivity is not None:
            limit(passivity, run.reading[k : k + 1], force)
        sent[k + delay] = force[0]
        total = sent[k] + push[k]
        new = a[0, 0] * (x - start) + a[0, 1] * v + b[0] * total + start
        v = a[1, 0] * (x - start) + a[1, 1] * v + b[1] * total
        energy -= float(sent[k] @ (new - x))
        x = new
        run.energy[k] = energy
    run.position[n], run.reading[n] = x, np.rint(x / q) * q if q > 0.0 else x
    return run._replace(held=sent[:n])


def controller(delay: int, q: float = RESOLUTION) -> Passivity:
    return make_passivity(1, delay, q, stiffness=STIFFNESSES[-1], acceleration=ACCELERATION)


# --- Passive with control -----------------------------------------------------------------------


@pytest.mark.parametrize("delay", DELAYS)
def test_port_is_passive_for_every_tool_and_grip(delay: int) -> None:
    """The organ is the study's spring, whose forces equal those of the organ's step (below)."""
    free, bound = 0.0, controller(delay).bound
    cases = itertools.product(HANDS, MASSES, DAMPINGS, GRIPS, STIFFNESSES)
    for hand, mass, damping, grip, stiffness in cases:
        loop = Loop(Device(mass, damping, grip), stiffness, delay, RESOLUTION)
        push = hand_push(hand, grip, 3000)
        given_ = -run_loop(loop, push, 1e-3, controller(delay)).energy.min()
        assert given_ <= bound, f"K {stiffness}, m {mass}, b {damping}, k {grip}, {hand}"
        free = max(free, -run_loop(loop, push, 1e-3).energy.min())
    assert free > 1.0


def test_the_loop_of_the_study_is_that_of_the_step() -> None:
    stiffness, start, n = 1000.0, 1e-3, 600
    organ, device = flat_organ(compliance=1.0 / stiffness), Device(0.3, 2.0)
    push = np.zeros((n, 3))
    push[:, 2] = -1.0
    for passivity, again in ((None, None), (controller(2, 0.0), controller(2, 0.0))):
        at = np.array([0.0, 0.0, RADIUS + start])
        mine = closed_loop(organ, device, 2, push, at, passivity, q=0.0)
        other = run_loop(Loop(device, stiffness, 2), push[:, 2], start, again)
        # the organ's fields are single precision: 1e-2 m to 1e-9 m, times K
        assert np.abs(mine.held[:, 2] - other.held).max() < 1e-5


@pytest.mark.parametrize("delay", DELAYS)
def test_port_is_passive_on_a_ball(delay: int) -> None:
    """Pushed in beside its top, the tool slides off: the force turns with the surface."""
    organ, n = flat_organ(compliance=1.0 / 1500.0, is_ball=True), 1200
    start = np.array([4e-3, 1e-3, BALL + RADIUS + 1e-3])
    push = np.tile([0.0, 0.3, -2.0], (n, 1))
    device = Device(0.1, 0.2, 150.0)
    passivity = controller(delay)
    run = closed_loop(organ, device, delay, push, start, passivity)
    free = closed_loop(organ, device, delay, push, start, None)
    assert np.ptp(run.position[:, 0]) > 2e-3
    assert run.given <= passivity.bound < free.given
    assert run.acceleration < ACCELERATION
    # the controller's account equals the energy through the port
    assert abs(passivity.energy[0] - run.energy[-2]) <= run.quantisation(RESOLUTION)


# --- Any hand and organ -------------------------------------------------------------------------


def shaken(seed: int, active: str, delay: int, q: float, n: int = 300) -> tuple[Run, Passivity]:
    """Throw a tool about, on an organ that pushes it at will."""
    rng = np.random.default_rng(seed)
    passivity = make_passivity(1, delay, q)
    turn = rng.standard_normal((n, 3))
    turn *= rng.uniform(0.0, 1.0, (n, 1)) ** 0.2 / np.linalg.norm(turn, axis=1, keepdims=True)
    calm = rng.uniform(0.0, 1.0, n) < 0.5  # slow motion too
    push = 100.0 * turn * np.where(calm, 0.1, 1.0)[:, None]
    x, v, energy = np.zeros(3), rng.uniform(-0.1, 0.1, 3), 0.0
    run = Run(*(np.zeros((n + extra, 3)) for extra in (1, 1, 0, 0)), energy=np.zeros(n))
    sent, force = np.zeros((n + delay, 3)), np.zeros((1, 3))
    for k in range(n):
        run.position[k] = x
        run.reading[k] = np.rint(x / q) * q if q > 0.0 else x
        if active == "along":  # always with the tool
            force[0] = 5.0 * v / (np.linalg.norm(v) + 1e-9)
        elif active == "random":
            force[0] = rng.uniform(0.0, 20.0) * rng.standard_normal(3)
        else:  # a spring that pushes back later than it was pushed, harder
            force[0] = -1500.0 * run.reading[k - min(k, 5)] + 10.0 * v
        run.organ[k] = force[0]
        limit(passivity, run.reading[k : k + 1], force)
        sent[k + delay] = force[0]
        if active == "along":  # the worst of hands: towards the held force
            push[k] = 100.0 * sent[k] / (np.linalg.norm(sent[k]) + 1e-12) * rng.uniform(-1.0, 1.0)
        at = PERIOD * np.array([0.25, 0.5, 0.75, 1.0])[:, None]  # between the samples too
        way = at * v + 0.5 * at**2 * push[k]
        run.energy[k] = energy - (way @ sent[k]).max()
        energy -= float(way[-1] @ sent[k])
        x, v = x + way[-1], np.clip(v + PERIOD * push[k], -2.0, 2.0)
    run.position[n], run.reading[n] = x, np.rint(x / q) * q if q > 0.0 else x
    return run._replace(held=sent[:n]), passivity


@examples(60)
@given(
    seed=st.integers(0, 10**6),
    active=st.sampled_from(["along", "random", "late spring"]),
    delay=st.integers(0, 2),
    q=st.sampled_from([0.0, RESOLUTION]),
)
@example(seed=0, active="along", delay=2, q=0.0)
def test_bound_holds_for_any_force_and_any_motion(
    seed: int, active: str, delay: int, q: float
) -> None:
    """An active organ spends the energy that the bound allows, and no more."""
    run, passivity = shaken(seed, active, delay, q)
    exact = passivity.bound * (1.0 + 1e-9)  # sums of 300 terms
    assert run.given <= exact + (run.quantisation(q) if q > 0.0 else 0.0)
    if seed == 0 and active == "along" and delay == 2:
        assert run.given > 0.5 * passivity.bound


# --- Without control ----------------------------------------------------------------------------


def test_control_takes_what_the_loop_made_and_no_more() -> None:
    """Pressed into the organ, an oscillating tool decays as on an organ without delay.

    Its oscillations have the envelope exp(- b t / 2 m), all energy being the tool's own to lose.
    """
    mass, damping, stiffness, depth, swing, n = 0.3, 1.0, 800.0, 5e-3, 2e-3, 1500
    push = np.full(n, -stiffness * depth)
    lasts = {}
    for name, delay, passivity in (
        ("without", 2, None),
        ("with", 2, make_passivity(1, 2, RESOLUTION)),
        ("no hold", 0, None),
    ):
        loop = Loop(Device(mass, damping), stiffness, delay, RESOLUTION)
        position = run_loop(loop, push, swing - depth, passivity).position
        lasts[name] = float(np.abs(position[-200:] + depth).max())
    ideal = swing * np.exp(-damping * PERIOD * (n - 200) / (2.0 * mass))
    energy = {name: 0.5 * stiffness * last**2 for name, last in lasts.items()}
    tolerance = make_passivity(1, 2, RESOLUTION).tolerance
    assert lasts["without"] > swing
    assert energy["with"] <= 0.5 * stiffness * ideal**2 + 2.0 * tolerance
    # nor does it brake the tool's own motion
    assert lasts["with"] == pytest.approx(ideal, rel=0.05)
