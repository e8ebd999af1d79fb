"""The contact law of tips, against closed forms and its own energy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from avatar_core.contact.effects import (
    Effect,
    Friction,
    LargeDeformationEffect,
    SeveralTools,
    Viscoelasticity,
)
from avatar_core.contact.effects.large_dent import evaluate_large_dent
from avatar_core.contact.effects.tip_law import ANISOTROPY, KAPPA, PATCH, STIFFNESS, TAU
from avatar_core.contact.model import ContactModel, Status, prepare, step, stored_energy
from avatar_core.contact.tool_path import inner_positions
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.flat_organ import COMPLIANCE, E_STAR, MATERIAL, PATCH_RADIUS, flat_organ

SPHERE, ROUNDED = Tip("sphere", 5e-3), Tip("rounded_cone", 10e-3, 60.0, 2e-3)
REST = COMPLIANCE - PATCH / (E_STAR * PATCH_RADIUS)  # of the organ beside the dent [m/N]


def sneddon(shape: str, radius: float, depth: float) -> float:
    """Force on a tip that presses into a half-space (Sneddon 1965) [N]."""
    if shape == "flat":
        return 2.0 * E_STAR * radius * depth
    if shape == "cone":  # of 60 degrees
        return 2.0 / np.pi * E_STAR * np.tan(np.radians(60.0)) * depth**2
    a = brentq(
        lambda a: 0.5 * a * np.log((radius + a) / (radius - a)) - depth, 0, radius * (1 - 1e-12)
    )
    return E_STAR * (0.5 * (a * a + radius**2) * np.log((radius + a) / (radius - a)) - a * radius)


def pressed(model: ContactModel, tip: Tip, depth: float, x: float = 0.0) -> float:
    """Normal force at a depth below the flat organ [N]."""
    step(model, np.array([[x, 0.0, tip.offset - depth]]))
    return float(model.out.force[0, 2])


def pressed_in(model: ContactModel, tip: Tip, depth: float) -> float:
    """The same after a touch, so that the tip's centre may be below the surface."""
    pressed(model, tip, 1e-4)
    return pressed(model, tip, depth)


@pytest.mark.parametrize(
    "tip",
    [
        SPHERE,
        Tip("sphere", 1e-3),
        Tip("sphere", 10e-3),
        Tip("flat", 3e-3),
        Tip("cone", 15e-3, 60.0),
    ],
)
@pytest.mark.parametrize("depth", [0.2e-3, 1e-3, 4e-3])
def test_a_dent_and_the_organ_share_the_depth(tip: Tip, depth: float) -> None:
    force = pressed(flat_organ(tip=tip), tip, depth)

    def left(dent: float) -> float:
        return dent + REST * sneddon(tip.shape, tip.radius, dent) - depth

    expected = sneddon(tip.shape, tip.radius, brentq(left, 1e-12, depth, xtol=1e-15))
    assert force == pytest.approx(expected, rel=2e-3 if tip.shape == "sphere" else 1e-6)


# Our axisymmetric finite elements, F / (E R^2) at depths [R]: ``avatar study indentation``.
ELEMENTS = {
    0.3: {0.2: 0.13266, 0.5: 0.51482, 1.0: 1.38411},
    0.48: {0.2: 0.14872, 0.5: 0.55922, 1.0: 1.45022},
}
ALONE = PATCH / (E_STAR * PATCH_RADIUS)  # an organ whose only compliance is that of the dent


@pytest.mark.parametrize("radius", [3e-3, 10e-3])
@pytest.mark.parametrize("nu", ELEMENTS)
def test_a_sphere_in_a_neo_hookean_half_space_is_that_of_finite_elements(
    nu: float, radius: float
) -> None:
    tip = Tip("sphere", radius)
    model = flat_organ(compliance=ALONE, tip=tip, neo_hookean=nu)
    for depth, force in ELEMENTS[nu].items():
        expected = force * (1.0 - nu**2) * E_STAR * radius**2
        assert pressed(model, tip, depth * radius) == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("nu", [0.1, 0.48])
@pytest.mark.parametrize("depth", [1e-3, 4e-3, 9e-3])
@pytest.mark.parametrize("compliance", [ALONE, COMPLIANCE])
def test_large_strain_shares_the_depth_with_the_organ(
    nu: float, depth: float, compliance: float
) -> None:
    """Deeper than 1.5 R too, where the added depth goes on as its tangent."""
    large = flat_organ(compliance=compliance, tip=SPHERE, neo_hookean=nu)
    small = flat_organ(compliance=compliance, tip=SPHERE)
    force = pressed_in(large, SPHERE, depth)
    added = evaluate_large_dent(large.effects.tip_law, 0, force / E_STAR)[0]
    assert force == pytest.approx(pressed_in(small, SPHERE, depth - added), rel=1e-6)
    assert abs(added) > 1e-3 * depth
    assert (added > 0.0) == (nu == 0.48)


def bent_organ(tip: Tip, kappa: float, tau: float = 0.0, anisotropy: float = 0.0) -> ContactModel:
    """A half-space whose surface falls away around every place in the same way."""
    model = flat_organ(compliance=ALONE, tip=tip)
    local = model.effects.tip_law.local
    local[KAPPA], local[TAU], local[ANISOTROPY] = kappa, tau, anisotropy
    return model


@pytest.mark.parametrize(("kappa", "tau"), [(60.0, -4e3), (-40.0, 5e3), (20.0, 0.0)])
@pytest.mark.parametrize("depth", [0.5e-3, 3e-3])
def test_a_sphere_on_a_bent_surface_is_a_tip_of_another_profile(
    kappa: float, tau: float, depth: float
) -> None:
    """Sneddon's integrals over f'(r) + kappa r + tau r^2 / 2."""
    radius = SPHERE.radius

    def integral(a: float, power: int) -> float:
        def inner(angle: float) -> float:
            r = a * np.sin(angle)
            slope = r / np.sqrt(radius**2 - r**2) + kappa * r + 0.5 * tau * r**2
            return float(r**power * slope)

        return float(quad(inner, 0.0, 0.5 * np.pi)[0])

    a = brentq(lambda a: a * integral(a, 0) - depth, 0.0, 0.999 * radius)
    force = pressed(bent_organ(SPHERE, kappa, tau), SPHERE, depth)
    assert force == pytest.approx(2.0 * E_STAR * integral(a, 2), rel=2e-3)


@pytest.mark.parametrize("ratio", [2.0, 4.0, 7.0])
def test_a_sphere_on_a_tube_touches_over_an_ellipse(ratio: float) -> None:
    """Hertz's elliptic contact (Johnson, Contact Mechanics, 1985, eqs. 4.26 to 4.32).

    ``ratio`` is that of the relative curvatures across and along the tube.
    """
    tip, depth = Tip("sphere", 10e-3), 0.1e-3
    tube = (ratio - 1.0) / tip.radius  # its curvature

    def curvatures(m: float) -> tuple[float, float]:
        """A and B times E* / p0 and the longer half axis, over an ellipse with m = e^2."""
        short, whole, second = np.sqrt(1.0 - m), ellipk(m), ellipe(m)
        return short / m * (whole - second), short / m * (second / (1.0 - m) - whole)

    def missed(m: float) -> float:
        along, across = curvatures(m)
        return float(across / along) - ratio

    m = brentq(missed, 1e-4, 0.999)
    # A = 1 / (2 R) = curvatures p0 / (E* a), depth = p0 / E* b K
    pressure_over_a = 0.5 / tip.radius / curvatures(m)[0]  # p0 / (E* a)
    a = np.sqrt(depth / (pressure_over_a * np.sqrt(1.0 - m) * ellipk(m)))
    exact = 2.0 / 3.0 * np.pi * a**2 * np.sqrt(1.0 - m) * pressure_over_a * a * E_STAR
    force = pressed(bent_organ(tip, 0.5 * tube, anisotropy=(0.5 * tube) ** 2), tip, depth)
    assert force == pytest.approx(exact, rel=0.015)
    round_one = pressed(bent_organ(tip, 0.5 * tube), tip, depth)
    assert round_one < 0.98 * exact


@pytest.mark.parametrize("tip", [SPHERE, Tip("flat", 3e-3), Tip("cone", 15e-3, 60.0)])
@pytest.mark.parametrize(
    ("kappa", "tau"), [(-500.0, 0.0), (100.0, -1e6), (-500.0, -1e6), (-500.0, 1e4)]
)
def test_no_hollow_makes_a_contact_shrink_as_it_deepens(tip: Tip, kappa: float, tau: float) -> None:
    model = bent_organ(tip, kappa, tau)
    force = [pressed_in(model, tip, depth) for depth in np.linspace(0.2e-3, 6e-3, 30)]
    assert (np.diff(force) > 0.0).all()


def test_another_tip_feels_small_strain() -> None:
    tip = Tip("cone", 15e-3, 60.0)
    bent = pressed(flat_organ(tip=tip, neo_hookean=0.48), tip, 3e-3)
    assert bent == pressed(flat_organ(tip=tip), tip, 3e-3)


@pytest.mark.parametrize("nu", [0.1, 0.48])
@pytest.mark.parametrize("depth", [3e-3, 9e-3])
def test_large_strain_is_felt_where_the_stiffness_changes(nu: float, depth: float) -> None:
    """Along the surface only the change of the stored energy with E* is felt."""
    model = flat_organ(compliance=ALONE, tip=SPHERE, neo_hookean=nu)
    local = model.effects.tip_law.local[STIFFNESS]
    local *= np.linspace(0.5, 1.5, len(local), dtype=np.float32)[:, None, None]
    tip = np.array([[0.0, 0.0, SPHERE.offset - depth]])
    pressed_in(model, SPHERE, depth)
    force = model.out.force[0].copy()
    assert abs(force[0]) > 1e-3 * force[2]
    np.testing.assert_allclose(force, -energy_slope(model, tip), atol=1e-5 * force[2])


@pytest.mark.parametrize("tip", [SPHERE, Tip("flat", 3e-3), Tip("cone", 15e-3, 60.0), ROUNDED])
def test_the_force_is_the_derivative_of_the_energy(straight: Vademecum, tip: Tip) -> None:
    """On a curved organ, where the compliance beside the dent changes from place to place."""
    force_is_the_slope(straight, tip)


def test_at_large_strain_the_force_is_the_derivative_of_the_energy(bent: Vademecum) -> None:
    force_is_the_slope(bent, Tip("sphere", 3e-3), (LargeDeformationEffect(),))


def force_is_the_slope(straight: Vademecum, tip: Tip, effects: tuple[Effect, ...] = ()) -> None:
    model = prepare(straight, (tip,), cloud="off", effects=effects)
    rng = np.random.default_rng(2)
    for j in rng.choice(inner_positions(straight), 5):
        centre, normal = straight.surface.centers[j], straight.surface.normals[j]
        place = centre + (tip.offset - 4e-3) * normal + rng.uniform(-1e-3, 1e-3, 3)
        model.reset()
        step(model, (centre + (tip.offset - 1e-3) * normal)[None])  # in through the surface
        assert step(model, place[None]) == Status.OK
        force = model.out.force[0].copy()
        slope = energy_slope(model, place[None])
        np.testing.assert_allclose(force, -slope, atol=1e-4 * np.linalg.norm(force))


@pytest.mark.parametrize(
    "effects", [(), pytest.param((LargeDeformationEffect(),), marks=pytest.mark.long)]
)
def test_tips_that_share_an_organ_conserve_energy(
    bent: Vademecum, effects: tuple[Effect, ...]
) -> None:
    model = prepare(bent, (SPHERE,) * 2, cloud="off", effects=(SeveralTools(), *effects))
    rng = np.random.default_rng(3)
    for j in rng.choice(inner_positions(bent), 4):
        aside = np.linalg.svd(bent.surface.normals[[j]])[2][1]
        low = bent.surface.centers[j] + (SPHERE.offset - 4e-3) * bent.surface.normals[j]
        tips = np.stack([low, low + 8e-3 * aside])
        model.reset()
        step(model, tips)
        if (model.state.force <= 0.0).any():
            continue
        force = model.out.force[0].copy()
        slope = energy_slope(model, tips)
        np.testing.assert_allclose(force, -slope, atol=2e-3 * np.linalg.norm(force))


def energy_slope(model: ContactModel, tips: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Gradient of the stored energy by the place of the first tip, central differences [N]."""
    energy = np.empty((2, 3))
    for side, sign in enumerate((1.0, -1.0)):
        for d in range(3):
            moved = tips.copy()
            moved[0, d] += sign * h
            step(model, moved)
            energy[side, d] = stored_energy(model)
    return (energy[0] - energy[1]) / (2.0 * h)


def test_a_dent_relaxes_as_the_tissue_does() -> None:
    """In the end the force is that on elastic tissue of the relaxed modulus (Lee & Radok)."""
    soft = Viscoelasticity((0.6,), (0.02,))
    model, elastic = flat_organ((soft,), tip=SPHERE), flat_organ(tip=SPHERE)
    fast = pressed(elastic, SPHERE, 3e-3)
    first = pressed(model, SPHERE, 3e-3)
    for _ in range(400):
        last = pressed(model, SPHERE, 3e-3)
    assert first == pytest.approx(fast, rel=0.03)  # a period of 1 ms has relaxed a little
    assert last == pytest.approx(0.4 * fast, rel=1e-6)


def test_a_small_contact_gives_way_sideways_as_mindlins() -> None:
    """tau / shift of a sticking sphere: the organ's compliance beside the dent, and 1 / (8 G a)."""
    model, depth, shift = flat_organ((Friction(1.0, 1.0),), tip=SPHERE), 2e-3, 1e-5
    for _ in range(3):
        force = pressed(model, SPHERE, depth)
    pressed(model, SPHERE, depth, shift)
    tau = -float(model.out.force[0, 0])
    dent = depth - REST * force
    a = brentq(lambda a: a * np.arctanh(a / SPHERE.radius) - dent, 1e-9, SPHERE.radius * 0.999)
    rho = (2.0 - MATERIAL.poisson_ratio) / (2.0 * (1.0 - MATERIAL.poisson_ratio))
    side = COMPLIANCE + rho * (1.0 / (2.0 * E_STAR * a) - PATCH / (E_STAR * PATCH_RADIUS))
    assert tau == pytest.approx(shift / side, rel=1e-3)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"radius": 0.0}, "tip: radius is 0.0; it must lie in 0.001 to 0.02 m"),
        ({"radius": float("nan")}, "tip: radius is nan"),
        ({"shape": "cone"}, "tip: shape cone needs half_angle"),
        ({"shape": "cone", "half_angle": 90.0}, "half_angle is 90.0; it must lie in 10 to 85 deg"),
        ({"shape": "flat", "half_angle": 30.0}, "tip: shape flat does not use half_angle"),
        ({"shape": "needle"}, "'needle' is unknown; choose sphere, flat, cone, rounded_cone"),
        (
            {"shape": "rounded_cone", "half_angle": 30.0, "rounding": 9e-3},
            "hides the cone of radius 0.005 m",
        ),
    ],
)
def test_a_bad_tip_is_refused_in_one_line(given: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError) as refusal:
        Tip(**given)
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)
