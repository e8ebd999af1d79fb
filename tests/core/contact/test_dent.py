"""The dent that is shown near a tip, against Boussinesq's, Sneddon's and resolved displacements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ellipk

from avatar_core.contact.dent import FADE, REACH, patch_dent
from avatar_core.contact.effects import SeveralTools, Viscoelasticity
from avatar_core.contact.effects.tip_law import PATCH, dent
from avatar_core.contact.effects.tip_profile import KAPPA, TAKEN, TAU
from avatar_core.contact.layout import lay_out
from avatar_core.contact.model import ContactModel, make_model, prepare, step
from avatar_core.geometry.tip import Tip
from avatar_core.offline.resolved_contact import contacts_at
from tests.helpers.box_organ import MATERIAL, PATCH_RADIUS, UP, organ, top
from tests.helpers.flat_organ import E_STAR, flat_organ

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
SPHERE, DEPTH = Tip("sphere", 3e-3), 2e-3
ALONG = np.linspace(0.0, 40e-3, 161)  # distances from a tip [m]
ASIDE = ((0.0, 0.0), (3e-3, 2e-3), (-9e-3, 7e-3), (5e-3, 5e-3))  # of the middle of a box [m]
END = REACH * PATCH_RADIUS


def ring_dent(rho: float) -> float:
    """E* R_p / F u of the patch by Boussinesq: its pressure as rings, each an elliptic integral."""

    def ring(s: float) -> float:
        whole = (rho + s) ** 2
        return float(3.0 * (1.0 - s * s) ** 2 * s / (rho + s) * ellipk(4.0 * rho * s / whole))

    return 4.0 / np.pi**2 * float(quad(ring, 0.0, 1.0, points=[min(rho, 1.0)], limit=200)[0])


def tip_dent(tip: Tip, depth: float, a: float, rho: float, more: float = 0.0) -> float:
    """u [m] of a half-space under a tip with a contact radius, by dimensionality reduction.

    more : a function of x that the tip's profile g has besides, as a factor of x^2 [1/m]
    """
    end = min(a, rho)

    def spring(angle: float) -> float:
        x = end * np.sin(angle)
        w = depth - float(tip.depth(np.array(x))) - more * x * x
        return w * (end * np.cos(angle) / np.sqrt(rho * rho - x * x) if rho > end else 1.0)

    return 2.0 / np.pi * float(quad(spring, 0.0, 0.5 * np.pi, limit=200)[0])


def fade(rho: np.ndarray) -> np.ndarray:
    left = np.clip((1.0 - (rho / END) ** 2) / (1.0 - (FADE / REACH) ** 2), 0.0, 1.0)
    return np.asarray(left**2 * (3.0 - 2.0 * left))


def without(model: ContactModel) -> ContactModel:
    """The same model, showing the dents of patches: no point is near a tip."""
    dents = model.layout.effects.dent
    effects = model.layout.effects._replace(dent=dents._replace(start=0 * dents.start))
    return make_model(replace(model.layout, effects=effects))


def pressed(
    model: ContactModel, tips: Sequence[Tip], places: np.ndarray, up: np.ndarray, depth: float
) -> np.ndarray:
    """Displacements of the cloud under tips at some depth, after an approach, (n, 3) [m]."""
    model.reset()
    for part in np.linspace(-0.2, 1.0, 13):
        height = np.array([tip.offset for tip in tips]) - part * depth
        step(model, places + height[:, None] * up)
    return np.asarray(model.out.cloud[:, 3:], float)


def test_the_patch_dents_as_boussinesq_says() -> None:
    rho = np.array([0.0, 0.1, 0.5, 0.9, 1.1, 1.5, 2.0])
    table = patch_dent(rho)
    np.testing.assert_allclose(table[1:], [ring_dent(each) for each in rho[1:]], rtol=1e-6)
    assert table[0] == pytest.approx(16.0 / (5.0 * np.pi), rel=1e-12)
    assert patch_dent(np.array(30.0)) * 30.0 * np.pi == pytest.approx(1.0, rel=1e-4)


def test_the_patch_sinks_in_the_mean_as_the_force_law_says() -> None:
    """The mean under its own pressure, 3 / pi (1 - r^2)^2; in the step's table too."""
    node, weight = np.polynomial.legendre.leggauss(40)
    r = 0.5 * (node + 1.0)
    load = 0.5 * weight * 6.0 * r * (1.0 - r * r) ** 2
    assert load.sum() == pytest.approx(1.0)
    assert load @ patch_dent(r) == pytest.approx(PATCH, rel=1e-4)
    table = flat_organ(tip=SPHERE).layout.effects.dent.patch
    part = (r / REACH) ** 2
    assert load @ np.interp(part, np.linspace(0.0, 1.0, len(table)), table) == pytest.approx(
        1.0, rel=2e-4
    )


@pytest.mark.parametrize("tip", TIPS)
@pytest.mark.parametrize("depth", [0.3e-3, 2e-3])
def test_a_tip_shows_its_own_dent_for_the_patchs(tip: Tip, depth: float) -> None:
    points = ALONG[:, None] * np.array([[0.6, 0.8, 0.0]])
    model = flat_organ(tip=tip, points=points)
    up = np.array([[0.0, 0.0, 1.0]])
    shown = pressed(model, (tip,), np.zeros((1, 3)), up, depth)
    delta, _, _, a = dent(model.effects.tip_law, 0)
    force = model.state.force[0]
    patch = force / (E_STAR * PATCH_RADIUS) * patch_dent(ALONG / PATCH_RADIUS)
    exact = fade(ALONG) * ([tip_dent(tip, delta, a, rho) for rho in ALONG] - patch)
    np.testing.assert_allclose(-shown[:, 2], exact, atol=4e-3 * delta)
    assert np.abs(exact).max() > 0.3 * delta
    assert np.abs(shown[:, :2]).max() < 1e-9 and not shown[ALONG > END].any()


def test_the_change_ends_without_a_step_or_a_kink() -> None:
    """A wide punch, of whose dent most is left there."""
    tip, rho = Tip("flat", 10e-3), np.linspace(0.70 * END, END + 1e-3, 80)
    points = rho[:, None] * np.array([[1.0, 0.0, 0.0]])
    model = flat_organ(tip=tip, points=points)
    u = pressed(model, (tip,), np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), DEPTH)[:, 2]
    slope = np.diff(u) / np.diff(rho)
    assert np.abs(u).max() > 1e-3 * DEPTH
    assert np.abs(np.diff(u)).max() < 0.1 * np.abs(u).max()
    assert np.abs(np.diff(slope)).max() < 0.2 * np.abs(slope).max()


def test_below_the_surface_the_change_depends_on_the_distance() -> None:
    points = np.concatenate([ALONG[:, None] * axis for axis in ([0.6, 0.0, -0.8], [1.0, 0.0, 0.0])])
    model = flat_organ(tip=SPHERE, points=points)
    shown = pressed(model, (SPHERE,), np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), DEPTH)
    below, beside = np.split(shown, 2)
    np.testing.assert_allclose(below, beside, atol=1e-7)
    assert not below[ALONG > END].any()


def test_a_patch_shows_what_it_did() -> None:
    assert lay_out(organ("cube"), (Tip("patch", 3e-3),)).effects.dent is None
    assert lay_out(organ("cube"), (SPHERE,)).effects.dent is not None


def test_a_dent_in_relaxing_tissue_keeps_its_shape() -> None:
    """Its load relaxes, and the elastic load that dents alike does not."""
    points = ALONG[:, None] * np.array([[1.0, 0.0, 0.0]])
    up, place = np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3))
    soft = flat_organ((Viscoelasticity((0.6,), (0.02,)),), tip=SPHERE, points=points)
    elastic = flat_organ(tip=SPHERE, points=points)
    exact = pressed(elastic, (SPHERE,), place, up, DEPTH)
    pressed(soft, (SPHERE,), place, up, DEPTH)
    for _ in range(400):
        step(soft, (place[0] + (SPHERE.offset - DEPTH) * up[0])[None])
    assert soft.state.force[0] < 0.45 * elastic.state.force[0]
    np.testing.assert_allclose(soft.out.cloud[:, 3:], exact, atol=1e-3 * DEPTH)


def sneddon_dent(rho: np.ndarray) -> np.ndarray:
    """Of the sphere at the depth, on a half-space (Segedin, Sneddon) [m]."""
    radius = SPHERE.radius
    a = brentq(lambda a: a * np.arctanh(a / radius) - DEPTH, 1e-6, radius * (1.0 - 1e-9))
    return np.array([tip_dent(SPHERE, DEPTH, a, each) for each in rho])


def test_a_cube_shows_sneddons_dent() -> None:
    """Along the normal, at the vertices of a coarse mesh, within two patch radii of a tip."""
    model = prepare(organ("cube"), (SPHERE,), effects=())
    patch, rest = without(model), model.arrays.rest[:, :3].astype(float)
    errors = []
    for aside in ASIDE:
        place = top("cube") + np.array([aside[0], 0.0, aside[1]])
        shown, before = (
            pressed(each, (SPHERE,), place[None], UP[None], DEPTH) for each in (model, patch)
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
    assert rms < 0.02e-3 < 0.15e-3 < rms_before
    assert np.abs(found).max() < 0.05e-3 < 1.4e-3 < np.abs(old).max()


def test_the_changes_of_several_tips_add_up() -> None:
    tips = (SPHERE, Tip("sphere", 5e-3))
    model = prepare(organ("cube"), tips, effects=(SeveralTools(),))
    patch, rest = without(model), model.arrays.rest[:, :3].astype(float)
    places = top("cube") + np.array([[1e-3, 0.0, 1e-3], [12e-3, 0.0, -1e-3]])
    up = np.tile(UP, (2, 1))
    change = pressed(patch, tips, places, up, DEPTH) - pressed(model, tips, places, up, DEPTH)
    law, exact = model.effects.tip_law, np.zeros_like(rest)
    for t, tip in enumerate(tips):
        delta, _, _, a = dent(law, t)
        assert abs(law.value[t, TAU]) < 1e-3  # it is flat there
        rho = np.linalg.norm(rest - model.state.point[t], axis=1)
        near = np.flatnonzero(rho < END)
        taken = law.elastic[t] * law.value[t, TAKEN] / PATCH * patch_dent(rho[near] / PATCH_RADIUS)
        own = [tip_dent(tip, delta, a, each, law.value[t, KAPPA]) for each in rho[near]]
        exact[near] += (fade(rho[near]) * (own - taken))[:, None] * model.state.normal[t]
    np.testing.assert_allclose(change, exact, atol=4e-3 * DEPTH)
    assert model.state.force.min() > 0.0 and np.abs(exact).max() > 0.5e-3


@pytest.mark.long
def test_a_column_shows_a_resolved_dent() -> None:
    body, place = organ("column"), top("column") + np.array([2e-3, 0.0, 1e-3])
    truth = contacts_at(None, body.mesh, body.regions, MATERIAL, place, UP, [SPHERE], [DEPTH])
    model = prepare(body, (SPHERE,), effects=())
    points = model.arrays.rest[:, :3].astype(float)
    vertices = body.mesh.surface_vertices
    exact = truth.condensed.displacements(truth.contacts[0])[0, vertices]
    distance = np.linalg.norm(points - place, axis=1)
    near = (distance < END) & (np.abs(points[:, 1] - place[1]) < 1e-6)
    error, before = (
        pressed(each, (SPHERE,), place[None], UP[None], DEPTH)[near, 1] - exact[near, 1]
        for each in (model, without(model))
    )
    rms, rms_before = np.sqrt((error**2).mean()), np.sqrt((before**2).mean())
    print(f"rms {1e3 * rms:.3f} mm (patch: {1e3 * rms_before:.3f}) at {near.sum()} vertices")
    assert rms < 0.2 * rms_before
