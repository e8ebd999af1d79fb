"""No path gains energy: the work of the tools equals the energy stored in the organ.

Work along a path is integrated by the trapezoidal rule. If a contact begins or ends within a step
h, its error there is at most K h^2 / 8.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from avatar_core.contact.effects import Effect, LargeDeformation, SeveralTools
from avatar_core.contact.model import ContactData, Status
from avatar_core.contact.tool_path import inner_positions
from avatar_core.errors import SceneError
from avatar_core.fem.patch_on_plane import PATCH
from avatar_core.geometry.tip import Tip
from avatar_core.tips.profile import STIFFNESS, TAKEN
from avatar_core.vademecum.model import Vademecum
from tests.helpers.coarse_liver import RADIUS, Spot, any_spot, liver, liver_model, spots
from tests.helpers.contact import prepare, step
from tests.helpers.examples import examples
from tests.helpers.flat_organ import (
    COMPLIANCE,
    E_STAR,
    PATCH_RADIUS,
    at_depth,
    flat_organ,
    force_at_depth,
)
from tests.helpers.flat_organ import RADIUS as FLAT_RADIUS
from tests.helpers.tool_motion import AWAY, energy_slope, follow, line, polygon, refined

SPHERE = Tip("sphere", RADIUS)
LARGE = (LargeDeformation(),)
FAST = 5e-3  # way in a period at 5 m/s [m]


def stiffest(data: ContactData) -> float:
    """Return the largest stiffness K of the organ under a tip [N/m]."""
    return 1.0 / float(data.model.arrays.self_compliance[data.model.arrays.row >= 0].min())


# --- The force is the derivative of the energy ----------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("tip", "effects"),
    [
        (SPHERE, ()),
        (Tip("flat", 3e-3), ()),
        (Tip("cone", 15e-3, 60.0), ()),
        (Tip("rounded_cone", 10e-3, 60.0, 2e-3), ()),
        (Tip("sphere", 3e-3), LARGE),
    ],
)
def test_the_force_is_the_derivative_of_the_energy(
    bent: Vademecum, tip: Tip, effects: tuple[Effect, ...]
) -> None:
    """The organ is curved: its compliance beside the dent varies with position."""
    data = prepare(bent, (tip,), cloud="off", effects=effects)
    rng = np.random.default_rng(2)
    for j in rng.choice(inner_positions(bent), 5):
        centre, normal = bent.surface.centers[j], bent.surface.normals[j]
        place = centre + (tip.offset - 4e-3) * normal + rng.uniform(-1e-3, 1e-3, 3)
        data.reset()
        step(data, (centre + (tip.offset - 1e-3) * normal)[None])  # in through the surface
        assert step(data, place[None]) == Status.OK
        force = data.out.force.copy()
        slope = energy_slope(data, place[None])
        np.testing.assert_allclose(force, -slope, atol=1e-4 * np.linalg.norm(force))


@pytest.mark.parametrize("effects", [(), pytest.param(LARGE, marks=pytest.mark.long)])
@pytest.mark.parametrize("apart", [8e-3, 30e-3])
def test_tips_that_share_an_organ_conserve_energy(
    bent: Vademecum, effects: tuple[Effect, ...], apart: float
) -> None:
    data = prepare(bent, (SPHERE,) * 2, cloud="off", effects=(SeveralTools(), *effects))
    rng, n_pressed = np.random.default_rng(3), 0
    for j in rng.choice(inner_positions(bent), 4):
        aside = np.linalg.svd(bent.surface.normals[[j]])[2][1]
        low = bent.surface.centers[j] + (SPHERE.offset - 4e-3) * bent.surface.normals[j]
        tips = np.stack([low, low + apart * aside])
        data.reset()
        step(data, tips)
        if (data.state.force <= 0.0).any():
            continue
        n_pressed += 1
        force = data.out.force.copy()
        slope = energy_slope(data, tips)
        np.testing.assert_allclose(force, -slope, atol=1e-3 * np.abs(force).max())
    assert n_pressed > 0


@pytest.mark.parametrize(("nu", "depth"), [(0.1, 3e-3), (0.48, 3e-3), (0.48, 9e-3)])
def test_at_large_strain_a_change_of_stiffness_has_its_force(nu: float, depth: float) -> None:
    """Along the surface only the change of the stored energy with E* gives a force."""
    dent = PATCH / (E_STAR * PATCH_RADIUS)  # an organ whose only compliance is that of the dent
    data = flat_organ(compliance=dent, tip=SPHERE, neo_hookean=nu)
    local = data.model.arrays.law.local[STIFFNESS]
    local *= np.linspace(0.5, 1.5, len(local), dtype=np.float32)[:, None, None]
    for each in (1e-4, depth):
        force_at_depth(data, each)
    force = data.out.force.copy()
    assert abs(force[0, 0]) > 1e-3 * force[0, 2]
    slope = energy_slope(data, at_depth(depth))
    np.testing.assert_allclose(force, -slope, atol=1e-5 * force[0, 2])


# --- Closed paths ---------------------------------------------------------------------------------


def closed_path_work(v: Vademecum, data: ContactData, n_paths: int, seed: int) -> float:
    """Return the largest |work| / peak energy over loops that start and end 15 mm off the organ.

    A loop that only grazes the organ leaves it within a step or two, which the trapezoidal rule
    does not resolve. An outlier is therefore integrated again, twenty times finer. Where the organ
    folds, 15 mm above one part may lie within another. Such a loop is left out: a tip that begins
    inside has no force until it has come out.
    """
    rng = np.random.default_rng(seed)
    inner = inner_positions(v, 20e-3)
    worst, n_walked = 0.0, 0
    for _ in range(n_paths):
        path = closed_path(v, rng.choice(inner), rng)
        for times in (1, 20):
            data.reset()
            loop = follow(data, refined(path, times)[:, None])
            work, peak = abs(loop.work[-1]), loop.energy.max()
            if peak <= 1e-5 or work <= max(worst, 2e-3) * peak:
                break
        if loop.status[0, 0] == Status.OK and not loop.force[0].any():
            n_walked += 1
            worst = max(worst, work / peak if peak > 1e-5 else 0.0)
    assert n_walked > 0.8 * n_paths
    return float(worst)


def closed_path(v: Vademecum, position: int, rng: np.random.Generator) -> np.ndarray:
    """Return a path from above a load position, around it by four random corners, and back."""
    center, n = v.surface.centers[position], v.surface.normals[position]
    corners = center + RADIUS * n + rng.uniform(-12e-3, 12e-3, (4, 3))
    corners += np.outer(-((corners - center) @ n) + RADIUS, n)
    corners -= np.outer(rng.uniform(0, 6e-3, 4), n)
    start = corners[0] + n * 15e-3
    return refined(np.array([start, *corners, start]), 400)


def test_closed_paths_do_no_work(phantom_vademecum: Vademecum) -> None:
    data = prepare(phantom_vademecum, (SPHERE,), cloud="volume")
    assert closed_path_work(phantom_vademecum, data, 30, seed=0) < 0.01


@pytest.mark.long
def test_closed_paths_on_real_livers_do_no_work(real_vademecum: Vademecum) -> None:
    worst = closed_path_work(real_vademecum, prepare(real_vademecum, (SPHERE,)), 60, seed=1)
    print(f"{real_vademecum.name}: work at most {worst:.2%} of the peak stored energy")
    assert worst < 0.01


@examples(40)
@given(spot=any_spot(30e-3), turn=st.floats(0.0, 2.0 * np.pi), depth=st.floats(0.02e-3, 0.3e-3))
def test_grazing_has_no_steps_and_costs_nothing(spot: Spot, turn: float, depth: float) -> None:
    """There and back over 12 mm, 4 mm above in between: a closed path."""
    heading = np.array([np.cos(turn), np.sin(turn)])
    ends = [spot.tip(depth, *(x * heading)) for x in (-6e-3, 6e-3)]
    high = [spot.tip(-4e-3, *(x * heading)) for x in (6e-3, -6e-3)]
    data, h = liver_model(), 1e-5
    loop = follow(data, polygon([high[1], *ends, *high], h))
    assert (loop.status == Status.OK).all()
    size, stiff = np.linalg.norm(loop.force, axis=2), stiffest(data)
    jump = np.linalg.norm(np.diff(loop.force, axis=0), axis=2).max()
    # the force turns with the surface, whose radius is at least the patch's 12 mm, too
    assert jump <= stiff * h * 1.5 + size.max() * h / 3e-3
    peak = 0.5 * size.max() ** 2 / stiff
    touches = np.abs(np.diff((size > 0.0).astype(int), axis=0)).sum()
    assert abs(loop.work[-1]) <= touches * stiff * h**2 / 8.0 + 0.01 * peak


@pytest.mark.long
def test_tool_larger_than_a_small_liver() -> None:
    """40 mm across on a liver of 29 mm: forces are bounded, conservative, and end at zero."""
    scale, radius = 0.15, 20e-3
    data = liver_model(radius=radius, scale=scale)
    size = float(np.ptp(liver(scale).mesh.vertices, axis=0).max())
    assert size < 2.0 * radius
    worst = peak = 0.0
    for spot in spots(0.0, scale)[::9]:
        down, aside = spot.tip(2e-3, radius=radius), spot.tip(1e-3, along=6e-3, radius=radius)
        up, beside = spot.tip(-9e-3, radius=radius), spot.tip(-9e-3, along=6e-3, radius=radius)
        path = polygon([up, down, aside, beside, up], 2e-5)
        data.reset()
        for tip in path[::10]:
            step(data, tip)
            depth = max(0.0, -data.state.gap[0]) if data.state.active[0] else 0.0
            # no softer than a punch in contact all over
            law = data.state.law
            left = data.state.self_compliance[0] - law.value[0, TAKEN]
            left += 0.5 / (law.value[0, STIFFNESS] * radius)
            assert data.state.force[0] * left <= depth * (1.0 + 1e-12)
        data.reset()
        loop = follow(data, path)
        if loop.energy.max() > 1e-5:
            peak = max(peak, loop.energy.max())
            worst = max(worst, abs(loop.work[-1]) / loop.energy.max())
    assert peak > 1e-4
    assert worst < 0.01  # as claimed for any closed path
    with pytest.raises(SceneError, match=r"radius is 0\.025"):
        prepare(liver(scale), (Tip("sphere", 25e-3),))


# --- At 5 m/s -------------------------------------------------------------------------------------


@cache
def bare_flat_organ() -> ContactData:
    """Build the organ when a test wants it, not when tests are collected."""
    return flat_organ()


@examples(40, least=16)  # some do not touch
@given(start=st.floats(1e-4, 5e-3), slope=st.floats(-1.0, 1.0), periods=st.integers(1, 5))
@example(start=2.5e-3, slope=0.0, periods=1)
def test_push_at_5_m_per_s(start: float, slope: float, periods: int) -> None:
    """Into a flat organ at an angle, and back out."""
    data = bare_flat_organ()
    data.reset()
    way = FAST * np.array([slope, 0.0, -1.0]) / np.hypot(1.0, slope)
    inward = at_depth(-start) + np.arange(periods + 1)[:, None, None] * way
    path = np.concatenate([inward, inward[-2::-1]])
    loop = follow(data, path)
    assert (loop.status == Status.OK).all()
    depth = np.maximum(0.0, FLAT_RADIUS - path[:, 0, 2])
    pressed = loop.force[:, 0, 2]
    np.testing.assert_allclose(pressed, depth / COMPLIANCE, rtol=1e-6, atol=1e-6)
    # the slopes of the splines sum to zero except for rounding, 1.4e-12 at worst in 400
    assert np.abs(loop.force[:, 0, 0]).max() < 1e-11 * max(1.0, pressed.max())
    missed = loop.work[periods] - 0.5 * depth[periods] ** 2 / COMPLIANCE
    assert -1e-9 <= missed <= way[2] ** 2 / COMPLIANCE / 8.0 * (1.0 + 1e-6)
    # the rule's excess on the way in is returned on the way out
    assert abs(loop.work[-1]) < 1e-9
    step(data, AWAY[None])
    assert not data.out.force.any()


SLOWER = 50


@examples(40, least=16)
@given(spot=any_spot(30e-3), turn=st.floats(0.0, 2 * np.pi), depth=st.floats(1e-3, 5e-3))
def test_slide_at_5_m_per_s(spot: Spot, turn: float, depth: float) -> None:
    """Forces equal those of a slow slide and of held poses; work equals the stored energy."""
    data, heading = liver_model(), np.array([np.cos(turn), np.sin(turn)])
    ends = [spot.tip(depth, *(x * heading)) for x in (-20e-3, 20e-3)]
    h = FAST / SLOWER
    path = line(*ends, h)
    slow = follow(data, path)
    data.reset()
    fast = follow(data, path[::SLOWER])
    assume((slow.status == Status.OK).all() and (fast.status == Status.OK).all())
    np.testing.assert_array_equal(fast.force, slow.force[::SLOWER])
    data.reset()
    held = follow(data, np.repeat(path[::SLOWER], 5, axis=0))
    np.testing.assert_array_equal(held.force, np.repeat(fast.force, 5, axis=0))
    for motion, spacing in ((fast, SLOWER * h), (slow, h)):
        missed = np.abs(motion.work - (motion.energy - motion.energy[0])).max()
        assert missed <= rule_error(data, motion.force, spacing)


def rule_error(data: ContactData, force: np.ndarray, h: float) -> float:
    """Return the trapezoidal rule's error: K h^2 / 8 per touch, and h^3 / 12 F'' per step [J].

    F'' <= K / 12 mm on a surface that the patch of 12 mm rounds.
    """
    stiff = stiffest(data)
    touching = np.linalg.norm(force[:, 0], axis=1) > 0.0
    touches = np.abs(np.diff(touching.astype(int))).sum()
    return float(stiff * h**2 / 8.0 * touches + len(force) * h**3 / 12.0 * stiff / 12e-3)
