"""Stick and slip against closed forms, and the energy that friction takes."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.contact.effects import Friction
from avatar_core.contact.model import Status, prepare, step
from avatar_core.contact.tool_path import inner_positions, middle_of_access
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.effect_cases import SPHERE, TIP, forces, push_and_drag
from tests.helpers.flat_organ import COMPLIANCE, RADIUS, at_depth, flat_organ


def test_a_dragged_tip_sticks_up_to_the_static_limit_and_slips_with_the_kinetic_force() -> None:
    """On the flat organ: tau = x / C until mu_s F_n, then mu_k F_n, against the motion."""
    mu_s, mu_k, depth = 0.5, 0.3, 4e-3
    model = flat_organ((Friction(mu_s, mu_k),))
    normal = depth / COMPLIANCE
    step(model, at_depth(depth))
    tangential = []
    ways = np.linspace(0.0, 4e-3, 401)
    for x in ways:
        assert step(model, at_depth(depth, x)) == Status.OK
        assert model.out.force[0, 2] == pytest.approx(normal, rel=1e-6)
        assert abs(model.out.force[0, 1]) < 1e-6
        tangential.append(-model.out.force[0, 0])
    tangential = np.array(tangential)
    sticks = ways < (1.0 - 1e-6) * mu_s * depth  # x / C < mu_s depth / C
    np.testing.assert_allclose(
        tangential[sticks], ways[sticks] / COMPLIANCE, rtol=1e-6, atol=1e-6 * normal
    )
    np.testing.assert_allclose(tangential[~sticks][1:], mu_k * normal, rtol=1e-6)


def test_friction_turns_back_elastically() -> None:
    """After slip the force falls by dx / C on the way back: the tip sticks again."""
    depth, model = 4e-3, flat_organ((Friction(0.3, 0.3),))
    step(model, at_depth(depth))
    for x in np.linspace(0.0, 3e-3, 100):
        step(model, at_depth(depth, x))
    slipping = model.out.force[0, 0]
    step(model, at_depth(depth, 2.9e-3))
    assert model.out.force[0, 0] - slipping == pytest.approx(0.1e-3 / COMPLIANCE, rel=1e-3)


def test_friction_has_its_moment_about_the_tip() -> None:
    model = flat_organ((Friction(0.5, 0.5),))
    step(model, at_depth(4e-3))
    step(model, at_depth(4e-3, 1e-3))
    arm = np.array([0.0, 0.0, -RADIUS])
    np.testing.assert_allclose(model.out.torque[0], np.cross(arm, model.out.force[0]), atol=1e-12)


def test_a_turning_tool_drags_the_tissue_along() -> None:
    """A turn by theta about y moves the contact point by theta x (0, 0, -r)."""
    model = flat_organ((Friction(1.0, 1.0),))
    step(model, at_depth(4e-3))
    model.effects.friction.spin[0] = (0.0, 0.1, 0.0)
    step(model, at_depth(4e-3))
    moved = np.cross((0.0, 0.1, 0.0), (0.0, 0.0, -RADIUS))
    assert model.out.force[0, 0] == pytest.approx(-moved[0] / COMPLIANCE, rel=1e-5)


def test_without_coefficients_friction_is_none(phantom_vademecum: Vademecum) -> None:
    """mu = 0 gives the frictionless force, found in another way, to single precision."""
    path = push_and_drag(phantom_vademecum)
    bare = forces(prepare(phantom_vademecum, (SPHERE,), cloud="off", effects=()), path)
    smooth = forces(
        prepare(phantom_vademecum, (SPHERE,), cloud="off", effects=(Friction(0.0, 0.0),)), path
    )
    np.testing.assert_allclose(smooth, bare, atol=2e-5 * np.abs(bare).max())


def test_what_sticks_gives_back_what_it_got(phantom_vademecum: Vademecum) -> None:
    """The force of a patch that never slips is the derivative of the energy, to 1 in 1,000.

    A contact that grows and shrinks under a tangential force loses some of it, as Mindlin's does.
    """
    v = phantom_vademecum
    gained, moved = work_on_a_circle(v, Tip("patch", TIP))
    assert abs(gained) < 1e-3 * moved
    gained, moved = work_on_a_circle(v, SPHERE)
    assert -0.01 * moved < gained < 0.0


def work_on_a_circle(v: Vademecum, tip: Tip) -> tuple[float, float]:
    """Work on a tool that sticks, on the way round, and the sum of its parts' sizes [J]."""
    model = prepare(v, (tip,), cloud="off", effects=(Friction(1.0, 1.0),))
    j = middle_of_access(v)
    center, normal = v.surface.centers[j], v.surface.normals[j]
    one, other = np.linalg.svd(normal[None])[2][1:]
    low = center + (TIP - 4e-3) * normal
    t = np.linspace(0.0, 2 * np.pi, 400)[:, None]
    circle = (
        low
        + 0.6e-3 * (np.sin(t) * one + (1.0 - np.cos(t)) * other)
        + 0.3e-3 * np.sin(2 * t) * normal
    )
    step(model, low[None])
    step(model, low[None])
    felt = []
    for place in circle:
        step(model, place[None])
        assert model.effects.friction.slipped[0] == 0.0
        felt.append(model.out.force[0].copy())
    each = (0.5 * (np.array(felt[1:]) + felt[:-1]) * np.diff(circle, axis=0)).sum(axis=1)
    return float(each.sum()), float(np.abs(each).sum())


def random_loop(v: Vademecum, rng: np.random.Generator, n: int) -> np.ndarray:
    """Starts and ends above the organ; goes 1 to 5 mm deep and up to 8 mm to all sides."""
    j = int(rng.choice(inner_positions(v)))
    normal = v.surface.normals[j]
    one, other = np.linalg.svd(normal[None])[2][1:]
    t = np.linspace(0.0, 2.0 * np.pi, n)[:, None]
    depth = -1.5e-3 + (1.5e-3 + rng.uniform(1e-3, 5e-3)) * np.sin(t / 2.0) ** 2
    a = rng.uniform(-8e-3, 8e-3, 4)
    x, y = a[0] * np.sin(t) + a[1] * np.sin(2 * t), a[2] * np.sin(t) + a[3] * np.sin(3 * t)
    return np.asarray(v.surface.centers[j] + (TIP - depth) * normal + x * one + y * other)


def least_dissipation(v: Vademecum, n_loops: int, n: int) -> float:
    """Smallest work lost on a loop, over the work that went to and fro."""
    model = prepare(v, (SPHERE,), cloud="off", effects=(Friction(0.3, 0.2),))
    rng, least = np.random.default_rng(0), np.inf
    for _ in range(n_loops):
        path = random_loop(v, rng, n)
        felt = forces(model, path)
        each = -(0.5 * (felt[1:] + felt[:-1]) * np.diff(path, axis=0)).sum(axis=1)
        if np.abs(each).sum() > 1e-6:
            least = min(least, each.sum() / np.abs(each).sum())
    return float(least)


def test_friction_takes_energy_on_every_loop(phantom_vademecum: Vademecum) -> None:
    assert least_dissipation(phantom_vademecum, 100, 150) > 0.0


@pytest.mark.long
def test_friction_takes_energy_on_two_thousand_loops(phantom_vademecum: Vademecum) -> None:
    assert least_dissipation(phantom_vademecum, 2_000, 150) > 0.0
