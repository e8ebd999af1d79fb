"""The displayed dent near a tip, against Boussinesq's, Sneddon's and resolved displacements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.optimize import brentq

from avatar_core.contact.effects import SeveralTools, Viscoelasticity
from avatar_core.contact.layout import lay_out
from avatar_core.contact.model import ContactData
from avatar_core.fem.patch_on_plane import patch_dent
from avatar_core.geometry.tip import Tip
from avatar_core.tips.dent import FADE, REACH
from avatar_core.tips.law import dent
from tests.core.fem.test_patch_on_plane import patch_rule
from tests.helpers.box_organ import PATCH_RADIUS, UP, organ, top
from tests.helpers.contact import prepare
from tests.helpers.flat_organ import E_STAR, ORIGIN, flat_organ, force_at_depth
from tests.helpers.flat_organ import UP as UPWARDS
from tests.helpers.shown_dent import (
    ASIDE,
    DEPTH,
    END,
    SPHERE,
    displaced,
    finer,
    sneddon_dent,
    tip_dent,
    with_patch_dents,
)
from tests.helpers.tool_motion import press

TIPS = [
    pytest.param(tip, id=f"{tip.shape}-{1e3 * tip.radius:g}mm")
    for tip in (
        Tip("sphere", 3e-3),
        Tip("sphere", 10e-3),
        Tip("flat", 3e-3),
        Tip("cone", 10e-3, 60.0),
        Tip("rounded_cone", 10e-3, 60.0, 2e-3),
    )
]
ALONG = np.linspace(0.0, 40e-3, 161)  # distances from a tip [m]


def fade(rho: np.ndarray) -> np.ndarray:
    left = np.clip((1.0 - (rho / END) ** 2) / (1.0 - (FADE / REACH) ** 2), 0.0, 1.0)
    return np.asarray(left**2 * (3.0 - 2.0 * left))


def test_the_table_of_the_patch_has_the_mean_that_the_force_law_takes_off() -> None:
    table = flat_organ(tip=SPHERE).model.arrays.dent.patch
    r, load = patch_rule(40)
    met = np.interp((r / REACH) ** 2, np.linspace(0.0, 1.0, len(table)), table)
    assert load @ met == pytest.approx(1.0, rel=2e-4)


@pytest.mark.parametrize("tip", TIPS)
@pytest.mark.parametrize("depth", [0.3e-3, 2e-3])
def test_a_tip_shows_its_own_dent_for_the_patchs(tip: Tip, depth: float) -> None:
    points = ALONG[:, None] * np.array([[0.6, 0.8, 0.0]])
    data = flat_organ(tip=tip, points=points)
    shown = displaced(data, (tip,), ORIGIN, UPWARDS, depth)
    delta, _, _, a = dent(data.model.arrays, data.state, 0)
    force = data.state.force[0]
    patch = force / (E_STAR * PATCH_RADIUS) * patch_dent(ALONG / PATCH_RADIUS)
    exact = fade(ALONG) * ([tip_dent(tip, delta, a, rho) for rho in ALONG] - patch)
    np.testing.assert_allclose(-shown[:, 2], exact, atol=4e-3 * delta)
    assert np.abs(exact).max() > 0.3 * delta
    assert np.abs(shown[:, :2]).max() < 1e-9 and not shown[ALONG > END].any()


def test_the_change_ends_without_a_step_or_a_kink() -> None:
    """A wide punch, most of whose dent remains there."""
    tip, rho = Tip("flat", 10e-3), np.linspace(0.70 * END, END + 1e-3, 80)
    points = rho[:, None] * np.array([[1.0, 0.0, 0.0]])
    data = flat_organ(tip=tip, points=points)
    u = displaced(data, (tip,), ORIGIN, UPWARDS, DEPTH)[:, 2]
    slope = np.diff(u) / np.diff(rho)
    assert np.abs(u).max() > 1e-3 * DEPTH
    assert np.abs(np.diff(u)).max() < 0.1 * np.abs(u).max()
    assert np.abs(np.diff(slope)).max() < 0.2 * np.abs(slope).max()


def test_below_the_surface_the_change_depends_on_the_distance() -> None:
    points = np.concatenate([ALONG[:, None] * axis for axis in ([0.6, 0.0, -0.8], [1.0, 0.0, 0.0])])
    data = flat_organ(tip=SPHERE, points=points)
    shown = displaced(data, (SPHERE,), ORIGIN, UPWARDS, DEPTH)
    below, beside = np.split(shown, 2)
    np.testing.assert_allclose(below, beside, atol=1e-7)
    assert not below[ALONG > END].any()


@pytest.mark.long
def test_a_patch_shows_what_it_did() -> None:
    assert lay_out(organ("cube"), (Tip("patch", 3e-3),)).dent is None
    assert lay_out(organ("cube"), (SPHERE,)).dent is not None


def test_a_dent_in_relaxing_tissue_keeps_its_shape() -> None:
    """Its load relaxes, but not the elastic load with the same dent."""
    points = ALONG[:, None] * np.array([[1.0, 0.0, 0.0]])
    soft = flat_organ((Viscoelasticity((0.6,), (0.02,)),), tip=SPHERE, points=points)
    elastic = flat_organ(tip=SPHERE, points=points)
    exact = displaced(elastic, (SPHERE,), ORIGIN, UPWARDS, DEPTH)
    displaced(soft, (SPHERE,), ORIGIN, UPWARDS, DEPTH)
    for _ in range(400):
        force_at_depth(soft, DEPTH)
    assert soft.state.force[0] < 0.45 * elastic.state.force[0]
    np.testing.assert_allclose(soft.out.cloud[:, 3:], exact, atol=1e-3 * DEPTH)


@pytest.mark.long
@pytest.mark.parametrize(("times", "limit"), [(0, 0.02e-3), (2, 0.03e-3)])
def test_a_cube_shows_sneddons_dent(times: int, limit: float) -> None:
    """Along the normal, within two patch radii of a tip.

    At the vertices of a coarse mesh, and between them if a finer surface is displayed.
    """
    data = prepare(finer(organ("cube"), times) if times else organ("cube"), (SPHERE,), effects=())
    patch, rest = with_patch_dents(data), data.model.arrays.rest[:, :3].astype(float)
    errors = []
    for aside in ASIDE:
        place = top("cube") + np.array([aside[0], 0.0, aside[1]])
        shown, before = (
            displaced(each, (SPHERE,), place[None], UP[None], DEPTH) for each in (data, patch)
        )
        distance = np.linalg.norm(rest - place, axis=1)
        near = (distance < END) & (np.abs(rest[:, 1] - place[1]) < 1e-6)
        exact = sneddon_dent(distance[near])
        errors.append([-each[near, 1] - exact for each in (shown, before)])
        np.testing.assert_array_equal(shown[distance > END], before[distance > END])
    found, old = np.concatenate(errors, axis=1)
    rms, rms_before = np.sqrt((found**2).mean()), np.sqrt((old**2).mean())
    print(f"rms {1e3 * rms:.3f} mm (patch: {1e3 * rms_before:.3f}) at {len(found)} vertices")
    print(f"worst {1e3 * np.abs(found).max():.3f} mm (patch: {1e3 * np.abs(old).max():.3f})")
    assert rms < limit < 0.1e-3 < rms_before
    assert times or (rms_before > 0.15e-3 and np.abs(found).max() < 0.05e-3)
    assert np.abs(old).max() > 1.4e-3


@pytest.mark.long
def test_the_changes_of_several_tips_add_up() -> None:
    """Each change equals that of the tip alone, pressed to the same force."""
    tips = (SPHERE, Tip("sphere", 5e-3))
    data = prepare(organ("cube"), tips, effects=(SeveralTools(),))
    places = top("cube") + np.array([[1e-3, 0.0, 1e-3], [12e-3, 0.0, -1e-3]])
    exact = np.zeros((len(data.out.cloud), 3))
    change = dent_change(data, tips, places, DEPTH)
    force = data.state.force.copy()
    for tip, place, bears in zip(tips, places, force, strict=True):
        one = prepare(organ("cube"), (tip,), effects=())
        depth = brentq(missing_force, 1e-5, DEPTH, args=(one, tip, place, bears), xtol=1e-9)
        exact += dent_change(one, (tip,), place[None], depth)
    np.testing.assert_allclose(change, exact, atol=4e-3 * DEPTH)
    assert force.min() > 0.0 and np.abs(exact).max() > 0.5e-3


def missing_force(
    depth: float, data: ContactData, tip: Tip, place: np.ndarray, force: float
) -> float:
    return float(press(data, (tip,), place[None], UP[None], depth)[0]) - force


def dent_change(
    data: ContactData, tips: Sequence[Tip], places: np.ndarray, depth: float
) -> np.ndarray:
    """Return the displacement of tips minus that of patches with their force, shape (n, 3) [m]."""
    up = np.tile(UP, (len(tips), 1))
    patch = displaced(with_patch_dents(data), tips, places, up, depth)
    return displaced(data, tips, places, up, depth) - patch
