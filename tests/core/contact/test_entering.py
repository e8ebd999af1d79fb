"""Tips that come into contact, leave it, leap or have no pose.

A contact returns the energy that went into it. So a tip that did not come in through the surface
gets no force, and after a leap a tip must come in again.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from avatar_core.common.splines import evaluate
from avatar_core.contact.effects import Effect, Friction, Viscoelasticity
from avatar_core.contact.locate import BARRED, ENTRY_DEPTH, LEAP, MAX_DEPTH
from avatar_core.contact.model import Status
from tests.helpers.coarse_liver import RADIUS, Spot, any_spot, liver, liver_model, press_in, spots
from tests.helpers.contact import step
from tests.helpers.examples import examples
from tests.helpers.tool_motion import follow, line

FRICTION = Friction(static=0.4, kinetic=0.3)
SELECTIONS: dict[str, tuple[Effect, ...]] = {
    "bare": (),
    "friction": (FRICTION,),
    "viscoelastic": (Viscoelasticity((0.5,), (0.2,)),),
}
FAST = 5.0  # [m/s]


def farthest(spot: Spot) -> Spot:
    return max(spots(), key=lambda other: float(np.linalg.norm(other.center - spot.center)))


# --- In through the surface -----------------------------------------------------------------------


@examples(40)
@given(spot=any_spot(), depth=st.floats(8e-3, 20e-3), aside=st.floats(-3e-3, 3e-3))
def test_tip_that_starts_inside_gets_no_force_before_it_has_left(
    spot: Spot, depth: float, aside: float
) -> None:
    data = liver_model()
    outside = spot.tip(-2e-3, along=aside)
    out = follow(data, line(spot.tip(RADIUS + depth), outside, 0.5e-3))
    assert set(out.status.ravel()) == {Status.OK, Status.OUT_OF_RANGE}
    assert out.status[0] == Status.OUT_OF_RANGE and out.status[-1] == Status.OK
    assert not out.force.any()
    back = follow(data, line(outside, spot.tip(4e-3), 0.5e-3))
    assert (back.status == Status.OK).all()
    fresh = liver_model()
    step(fresh, spot.tip(4e-3)[None])
    np.testing.assert_array_equal(back.force[-1], fresh.out.force)
    assert np.linalg.norm(back.force[-1]) > 1.0


@pytest.mark.long
def test_push_through_the_organ_at_5_m_per_s() -> None:
    """The force grows with the depth; beyond 25 mm, and once barred, there is none."""
    data, spot = liver_model(), spots()[0]
    stiff = 1.0 / float(data.model.arrays.self_compliance[data.model.arrays.row >= 0].min())
    path = line(spot.tip(-2e-3), spot.tip(RADIUS + 60e-3), FAST * 1e-3)
    push = follow(data, path)
    size = np.linalg.norm(push.force[:, 0], axis=1)
    assert 10.0 < size.max() < 1.5 * stiff * (RADIUS + MAX_DEPTH)
    f, unused = liver().tip_field, np.zeros(3)
    depth = [-evaluate(f.distance, f.origin, f.spacing[0], p[0], unused, 1.0) for p in path]
    assert not size[np.array(depth) > MAX_DEPTH].any()
    barred = (push.status[:, 0] == Status.OUT_OF_RANGE) & (size == 0.0)
    # the organ is thinner than 25 mm in places, and the tip meets its other wall
    assert barred.any()
    assert not size[barred.argmax() :].any()


@pytest.mark.parametrize("far", [20e-3, 0.9 * LEAP, 0.5], ids=["20 mm", "45 mm", "0.5 m"])
@pytest.mark.parametrize("effects", [(), (FRICTION,)], ids=["bare", "friction"])
def test_release_at_full_load(effects: tuple[Effect, ...], far: float) -> None:
    """After one period no force, contact or displacement is left, to the bit."""
    data, spot = liver_model(effects), spots()[0]
    press_in(data, spot, RADIUS + 15e-3)
    cloud, rest = data.out.cloud, data.model.arrays.rest[:, :3]
    assert data.out.force.any() and cloud[:, 3:].any()
    np.testing.assert_allclose(cloud[:, :3], rest + cloud[:, 3:], atol=1e-7)
    assert step(data, (spot.tip(0.0) + far * spot.normal)[None]) == Status.OK
    assert not data.out.force.any() and not data.out.torque.any()
    assert data.out.n_contacts[0] == 0
    assert not cloud[:, 3:].any()


# --- Leaps ----------------------------------------------------------------------------------------


@examples(40)
@given(one=any_spot(), other=any_spot(), deep=st.floats(8e-3, 18e-3))
def test_tip_that_leaps_into_the_organ_is_barred(one: Spot, other: Spot, deep: float) -> None:
    inside = other.tip(RADIUS + deep)
    assume(np.linalg.norm(inside - one.tip(RADIUS + 4e-3)) > LEAP)
    data = liver_model()
    press_in(data, one, RADIUS + 4e-3)
    assert data.out.force.any()
    assert step(data, inside[None]) == Status.OUT_OF_RANGE
    assert not data.out.force.any() and data.state.passage[0] == BARRED
    out = follow(data, line(inside, other.tip(-3e-3), 1e-3))
    assert not out.force.any()


def test_a_leap_between_two_touches_drags_nothing_along() -> None:
    data, spot = liver_model((FRICTION,)), spots()[0]
    other = farthest(spot).tip(4e-3)[None]
    press_in(data, spot, 4e-3)
    assert step(data, other) == Status.OK
    leapt = data.out.force[0].copy()
    data.reset()
    step(data, other)
    np.testing.assert_allclose(leapt, data.out.force[0], rtol=1e-9, atol=1e-9)


# --- Poses that are none --------------------------------------------------------------------------


@pytest.mark.parametrize("effects", SELECTIONS.values(), ids=SELECTIONS)
def test_invalid_pose_is_forgotten_at_once(effects: tuple[Effect, ...]) -> None:
    """Deep in the organ, one broken pose costs one period without force, and the sticking point."""
    spot, bare = spots()[0], liver_model()
    press_in(bare, spot, RADIUS + 10e-3)
    before = bare.out.force.copy()
    for broken in ([np.nan] * 3, [np.inf, 0, 0], [0, -np.inf, 0], [np.inf, -np.inf, np.nan]):
        data = liver_model(effects)
        press_in(data, spot, RADIUS + 10e-3)
        assert step(data, np.array([broken], float)) == Status.INVALID_POSE
        assert not data.out.force.any() and data.out.n_contacts[0] == 0
        assert step(data, spot.tip(RADIUS + 10e-3)[None]) == Status.OK
        off = float(np.abs(data.out.force - before).max() / np.abs(before).max())
        # without memory nothing has passed; with it, up to g / tau per second in 17 periods of
        # entry
        assert off <= (0.5 / 0.2 * 17e-3 if effects == SELECTIONS["viscoelastic"] else 1e-6)
        assert np.isfinite(data.out.cloud).all()


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_invalid_poses_open_no_door(broken: float) -> None:
    """They open none for a barred tip, nor for one that went on into the organ unseen."""
    spot, lost = spots()[0], np.full((1, 3), broken)
    data = liver_model()
    for depth in (RADIUS + 10e-3, RADIUS + 3e-3):
        assert step(data, spot.tip(depth)[None]) == Status.OUT_OF_RANGE
        step(data, lost)
    assert step(data, spot.tip(RADIUS + 3e-3)[None]) == Status.OUT_OF_RANGE
    assert not data.out.force.any()
    data.reset()
    press_in(data, spot, 1e-3)
    for _ in range(100):
        step(data, lost)
    assert step(data, spot.tip(RADIUS + 12e-3)[None]) == Status.OUT_OF_RANGE
    assert not data.out.force.any()
    # as deep as a contact may begin, it comes in again
    data.reset()
    press_in(data, spot, 1e-3)
    step(data, lost)
    assert step(data, spot.tip(RADIUS + ENTRY_DEPTH - 1e-3)[None]) == Status.OK


def test_each_tool_has_its_own_status() -> None:
    two = liver_model(n_tools=2)
    assert step(two, np.array([spots()[0].tip(3e-3), [np.nan, 0.0, 0.0]])) == Status.INVALID_POSE
    assert two.out.status.tolist() == [Status.OK, Status.INVALID_POSE]
    assert two.out.force[0].any() and not two.out.force[1].any()


def test_model_that_takes_over_goes_on_where_the_tip_is() -> None:
    """Deep contact survives an exchange of models; a leap in the same period does not."""
    spot = spots()[0]
    other = farthest(spot)
    assert np.linalg.norm(other.center - spot.center) > LEAP + MAX_DEPTH
    for place, status in ((spot, Status.OK), (other, Status.OUT_OF_RANGE)):
        data, later = liver_model(), liver_model((FRICTION,))
        press_in(data, spot, RADIUS + 12e-3)
        later.resume(data)
        assert step(later, place.tip(RADIUS + 12e-3)[None]) == status
        assert later.out.force.any() == (status == Status.OK)
    fresh = data.model.data()
    fresh.resume(data)
    np.testing.assert_array_equal(fresh.state.seen, data.state.seen)
