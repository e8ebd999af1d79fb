"""Stick and slip against closed forms, and the energy that friction dissipates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from avatar_core.contact.effects import Friction
from avatar_core.contact.effects.friction import tangential_force
from avatar_core.contact.model import ContactData, Status
from avatar_core.fem.patch_on_plane import PATCH
from avatar_core.geometry.tip import Tip
from tests.helpers.coarse_liver import Spot, liver_model, spots
from tests.helpers.contact import step
from tests.helpers.flat_organ import (
    COMPLIANCE,
    E_STAR,
    MATERIAL,
    PATCH_RADIUS,
    RADIUS,
    at_depth,
    flat_organ,
    force_at_depth,
)
from tests.helpers.tool_motion import follow


@pytest.mark.long
@pytest.mark.parametrize("compliance", [COMPLIANCE, 1e-6, 1e-8])
def test_a_dragged_tip_sticks_up_to_the_static_limit_and_slips_with_the_kinetic_force(
    compliance: float,
) -> None:
    """On the flat organ tau = x / C up to mu_s F_n, then mu_k F_n against the motion.

    On the way back the tip sticks again.
    """
    mu_s, mu_k, depth = 0.5, 0.3, 4e-3
    data = flat_organ((Friction(mu_s, mu_k),), compliance=compliance)
    normal = depth / compliance
    step(data, at_depth(depth))
    tangential = []
    ways = np.linspace(0.0, 4e-3, 401)
    for x in ways:
        assert step(data, at_depth(depth, x)) == Status.OK
        assert data.out.force[0, 2] == pytest.approx(normal, rel=1e-6)
        assert abs(data.out.force[0, 1]) < 1e-7 * normal
        tangential.append(-data.out.force[0, 0])
    sticks = ways < (1.0 - 1e-6) * mu_s * depth  # x / C < mu_s depth / C
    exact = np.where(sticks, ways / compliance, mu_k * normal)
    exact[np.argmin(sticks)] = tangential[
        np.argmin(sticks)
    ]  # the period in which it starts to slip
    np.testing.assert_allclose(tangential, exact, rtol=1e-6, atol=1e-6 * normal)
    step(data, at_depth(depth, 3.9e-3))
    assert tangential[-1] + data.out.force[0, 0] == pytest.approx(0.1e-3 / compliance, rel=1e-3)


def test_friction_has_its_moment_about_the_tip() -> None:
    data = flat_organ((Friction(0.5, 0.5),))
    step(data, at_depth(4e-3))
    step(data, at_depth(4e-3, 1e-3))
    arm = np.array([0.0, 0.0, -RADIUS])
    np.testing.assert_allclose(data.out.torque[0], np.cross(arm, data.out.force[0]), atol=1e-12)


def test_a_turning_tool_drags_the_tissue_along() -> None:
    """A turn by theta about y moves the contact point by theta x (0, 0, -r)."""
    data = flat_organ((Friction(1.0, 1.0),))
    for angle in (0.0, 0.01):
        step(data, at_depth(4e-3), Rotation.from_rotvec([[0.0, angle, 0.0]]).as_quat())
    moved = np.cross((0.0, 0.01, 0.0), (0.0, 0.0, -RADIUS))
    assert data.out.force[0, 0] == pytest.approx(-moved[0] / COMPLIANCE, rel=1e-5)


def test_a_small_contact_gives_way_sideways_as_mindlins() -> None:
    """Compare tau / shift of a sticking sphere with the organ's compliance plus 1 / (8 G a)."""
    tip = Tip("sphere", RADIUS)
    data, depth, shift = flat_organ((Friction(1.0, 1.0),), tip=tip), 2e-3, 1e-5
    for _ in range(3):
        force = force_at_depth(data, depth)
    force_at_depth(data, depth, shift)
    tau = -float(data.out.force[0, 0])
    patch = PATCH / (E_STAR * PATCH_RADIUS)  # the compliance that the dent replaces
    dent = depth - (COMPLIANCE - patch) * force
    a = brentq(lambda a: a * np.arctanh(a / RADIUS) - dent, 1e-9, RADIUS * 0.999)
    rho = (2.0 - MATERIAL.poisson_ratio) / (2.0 * (1.0 - MATERIAL.poisson_ratio))
    side = COMPLIANCE + rho * (1.0 / (2.0 * E_STAR * a) - patch)
    assert tau == pytest.approx(shift / side, rel=1e-3)


# --- On the liver ---------------------------------------------------------------------------------


def drag(spot: Spot, n: int = 60) -> np.ndarray:
    """Return a path into the liver and along it, shape (n, 1, 3)."""
    t = np.linspace(0.0, 1.0, n)
    return np.array([spot.tip(6e-3 * min(2 * each, 1.0), 4e-3 * each)[None] for each in t])


def test_without_coefficients_friction_is_none() -> None:
    """mu = 0 gives the frictionless force by another solver, to single precision."""
    path = drag(spots()[0])
    bare = follow(liver_model(), path).force
    smooth = follow(liver_model((Friction(0.0, 0.0),)), path).force
    np.testing.assert_allclose(smooth, bare, atol=2e-5 * np.abs(bare).max())


@pytest.mark.parametrize(
    ("shape", "least", "most"), [("patch", -1e-3, 1e-3), ("sphere", -0.01, 0.0)]
)
def test_what_sticks_gives_back_what_it_got(shape: str, least: float, most: float) -> None:
    """The force of a patch that never slips is the derivative of the energy, to 1 in 1,000.

    A contact that grows and shrinks under a tangential force loses some of its energy, as
    Mindlin's does.
    """
    data = liver_model((Friction(1.0, 1.0),), radius=10e-3, shape=shape)  # type: ignore[arg-type]
    spot, angle = spots()[len(spots()) // 2], np.linspace(0.0, 2 * np.pi, 400)
    circle = [
        spot.tip(4e-3 - 0.3e-3 * np.sin(2 * t), 0.6e-3 * np.sin(t), 0.6e-3 * (1 - np.cos(t)), 10e-3)
        for t in angle
    ]
    for _ in range(2):
        step(data, circle[0][None])
    forces = []
    for place in circle:
        step(data, place[None])
        assert data.state.friction.slipped[0] == 0.0
        forces.append(data.out.force[0].copy())
    gained = (0.5 * (np.array(forces[1:]) + forces[:-1]) * np.diff(circle, axis=0)).sum(axis=1)
    assert least < gained.sum() / np.abs(gained).sum() < most


@pytest.mark.parametrize("n_loops", [100, pytest.param(2_000, marks=pytest.mark.long)])
def test_friction_takes_energy_on_every_loop(n_loops: int) -> None:
    data, rng = liver_model((Friction(0.3, 0.2),), radius=10e-3), np.random.default_rng(0)
    n_touched = 0
    for _ in range(n_loops):
        data.reset()
        work = follow(data, random_loop(rng)).work
        there_and_back = np.abs(np.diff(work)).sum()
        if there_and_back > 1e-6:
            n_touched += 1
            assert work[-1] > 0.0
    assert n_touched > 0.5 * n_loops


def random_loop(rng: np.random.Generator, n: int = 150) -> np.ndarray:
    """Return a loop from above the organ, 1 to 5 mm deep, with up to 8 mm to all sides."""
    spot, t = spots()[rng.integers(len(spots()))], np.linspace(0.0, 2.0 * np.pi, n)
    depth = -1.5e-3 + (1.5e-3 + rng.uniform(1e-3, 5e-3)) * np.sin(t / 2.0) ** 2
    a = rng.uniform(-8e-3, 8e-3, 4)
    x, y = a[0] * np.sin(t) + a[1] * np.sin(2 * t), a[2] * np.sin(t) + a[3] * np.sin(3 * t)
    return np.array([spot.tip(*each, 10e-3)[None] for each in zip(depth, x, y, strict=True)])


def test_held_pose_leaves_friction_as_it_is() -> None:
    data: ContactData = liver_model((Friction(0.4, 0.3),))
    spot, moved, k = spots(30e-3)[0], 0.0, np.arange(100)
    depth, x, y = 3e-3 + 2e-3 * np.sin(0.5 * k), 4e-3 * np.sin(0.3 * k), 4e-3 * np.sin(0.4 * k)
    for tip in zip(depth, x, y, strict=True):
        at = spot.tip(*tip)[None]
        step(data, at)
        step(data, at)  # a new contact sticks from its second period on
        first = data.out.force.copy()
        for _ in range(50):
            step(data, at)
            # the tolerance of a gap, 1e-9 m, over the compliance
            assert np.abs(data.out.force - first).max() < 1e-5
        moved = max(moved, float(tangential_force.py_func(data.state, 0)))
    assert moved > 0.1
