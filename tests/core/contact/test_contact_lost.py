"""Hard cases of contact: poses that are none, none for a minute, and a model that takes over.

What was in contact may go on; who came in unseen gets no force.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from avatar_core.contact.effects import Friction, Viscoelasticity
from avatar_core.contact.locate import ENTRY_DEPTH, LEAP, MAX_DEPTH
from avatar_core.contact.model import Status, make_model, step
from tests.helpers.touching import AWAY, RADIUS, enter, spots, touched

Figure = Callable[[str], None]
FRICTION = Friction(static=0.4, kinetic=0.3)
SELECTIONS = {
    "bare": (),
    "friction": (FRICTION,),
    "viscoelastic": (Viscoelasticity((0.5,), (0.2,)),),
}


@pytest.mark.parametrize("effects", SELECTIONS.values(), ids=SELECTIONS)
def test_invalid_pose_is_forgotten_at_once(effects: tuple[object, ...], figure: Figure) -> None:
    """Deep in the organ, one broken pose costs one period without force, and what stuck."""
    spot, worst, bare = spots()[0], 0.0, touched()
    enter(bare, spot, RADIUS + 10e-3)
    before = bare.out.force.copy()
    for broken in ([np.nan] * 3, [np.inf, 0, 0], [0, -np.inf, 0], [np.inf, -np.inf, np.nan]):
        model = touched(effects)  # type: ignore[arg-type]
        enter(model, spot, RADIUS + 10e-3)
        assert step(model, np.array([broken], float)) == Status.INVALID_POSE
        assert not model.out.force.any() and model.out.n_contacts[0] == 0
        assert step(model, spot.tip(RADIUS + 10e-3)[None]) == Status.OK
        off = float(np.abs(model.out.force - before).max() / np.abs(before).max())
        # without memory nothing has passed; of one, up to g / tau a second in 17 periods of entry
        assert off <= (0.5 / 0.2 * 17e-3 if effects == SELECTIONS["viscoelastic"] else 1e-6)
        assert np.isfinite(model.out.cloud).all()
        worst = max(worst, off)
    figure(f"force afterwards off by {worst:.1e}")


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_invalid_poses_open_no_door(broken: float, figure: Figure) -> None:
    """Neither to a tip that is barred, nor to one that went on into the organ unseen."""
    spot, lost = spots()[0], np.full((1, 3), broken)
    model = touched()
    for depth in (RADIUS + 10e-3, RADIUS + 3e-3):
        assert step(model, spot.tip(depth)[None]) == Status.OUT_OF_RANGE
        step(model, lost)
    assert step(model, spot.tip(RADIUS + 3e-3)[None]) == Status.OUT_OF_RANGE
    assert not model.out.force.any()
    model.reset()
    enter(model, spot, 1e-3)
    for _ in range(100):
        step(model, lost)
    assert step(model, spot.tip(RADIUS + 12e-3)[None]) == Status.OUT_OF_RANGE
    assert not model.out.force.any()
    # as deep as a contact may begin it comes in anew
    model.reset()
    enter(model, spot, 1e-3)
    step(model, lost)
    assert step(model, spot.tip(RADIUS + ENTRY_DEPTH - 1e-3)[None]) == Status.OK
    figure("barred stays barred, 16 mm deeper is barred")


@pytest.mark.parametrize("effects", SELECTIONS.values(), ids=SELECTIONS)
def test_a_minute_without_poses(effects: tuple[object, ...], figure: Figure) -> None:
    """60,000 periods without a tool: then the organ answers as on the first day."""
    model, spot = touched(effects), spots()[0]  # type: ignore[arg-type]
    step(model, spot.tip(4e-3)[None])
    first = model.out.force.copy()
    model.reset()
    enter(model, spot, RADIUS + 10e-3)
    for _ in range(60_000):
        step(model, AWAY[None])
    left = float(np.abs(model.out.cloud[:, 3:]).max())
    assert step(model, spot.tip(RADIUS + 10e-3)[None]) == Status.OUT_OF_RANGE
    step(model, AWAY[None])
    assert step(model, spot.tip(4e-3)[None]) == Status.OK
    off = float(np.abs(model.out.force - first).max() / np.abs(first).max())
    assert left < 1e-9
    assert off < 1e-7  # single precision
    figure(f"displacement left {left:.1e} m, force off by {off:.1e}")


def test_model_that_takes_over_goes_on_where_the_tip_is(figure: Figure) -> None:
    """Deep contact survives an exchange of models; a leap in the same period does not."""
    spot = spots()[0]
    other = max(spots(), key=lambda one: float(np.linalg.norm(one.center - spot.center)))
    assert np.linalg.norm(other.center - spot.center) > LEAP + MAX_DEPTH
    for place, status in ((spot, Status.OK), (other, Status.OUT_OF_RANGE)):
        model, later = touched(), touched((FRICTION,))
        enter(model, spot, RADIUS + 12e-3)
        later.resume(model)
        assert step(later, place.tip(RADIUS + 12e-3)[None]) == status
        assert later.out.force.any() == (status == Status.OK)
    fresh = make_model(touched().layout)
    fresh.resume(model)
    np.testing.assert_array_equal(fresh.state.seen, model.state.seen)
    figure("12 mm deep: force goes on, elsewhere barred")
