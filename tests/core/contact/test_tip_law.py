"""The contact law of tips on a flat organ, against closed forms and finite elements.

Energy balance is in test_energy.py, friction and relaxation of tips with these effects.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from avatar_core.contact.effects.tip_law import ANISOTROPY, KAPPA, PATCH, TAU
from avatar_core.contact.model import ContactModel
from avatar_core.geometry.tip import Tip
from tests.helpers.flat_organ import COMPLIANCE, E_STAR, PATCH_RADIUS, flat_organ, force_at_depth
from tests.helpers.half_space import on_soft_base, sneddon

SPHERE, CONE = Tip("sphere", 5e-3), Tip("cone", 15e-3, 60.0)
DENT = PATCH / (E_STAR * PATCH_RADIUS)  # compliance of an organ that has but that of the dent
BASE = COMPLIANCE - DENT  # of the organ beside the dent [m/N]


def force_after_touch(model: ContactModel, depth: float) -> float:
    """The tip's centre may be below the surface, after a touch [N]."""
    force_at_depth(model, 1e-4)
    return force_at_depth(model, depth)


@pytest.mark.parametrize(
    "tip", [SPHERE, Tip("sphere", 1e-3), Tip("sphere", 10e-3), Tip("flat", 3e-3), CONE]
)
@pytest.mark.parametrize("depth", [0.2e-3, 1e-3, 4e-3])
def test_a_dent_and_the_organ_share_the_depth(tip: Tip, depth: float) -> None:
    expected = on_soft_base(partial(sneddon, tip, modulus=E_STAR), depth, BASE)
    force = force_at_depth(flat_organ(tip=tip), depth)
    assert force == pytest.approx(expected, rel=2e-3 if tip.shape == "sphere" else 1e-6)


# Our axisymmetric finite elements, F / (E R^2) at depths [R]: ``avatar study indentation``.
ELEMENTS = {
    0.3: {0.2: 0.13266, 0.5: 0.51482, 1.0: 1.38411},
    0.48: {0.2: 0.14872, 0.5: 0.55922, 1.0: 1.45022},
}


@pytest.mark.parametrize("radius", [3e-3, 10e-3])
@pytest.mark.parametrize("nu", ELEMENTS)
@pytest.mark.parametrize("base", [0.0, BASE])
def test_a_sphere_in_a_neo_hookean_half_space_is_that_of_finite_elements(
    nu: float, radius: float, base: float
) -> None:
    """Where the organ gives way besides, too."""
    model = flat_organ(compliance=DENT + base, tip=Tip("sphere", radius), neo_hookean=nu)
    for depth, force in ELEMENTS[nu].items():
        expected = force * (1.0 - nu**2) * E_STAR * radius**2
        found = force_after_touch(model, depth * radius + base * expected)
        assert found == pytest.approx(expected, rel=5e-3)


def test_another_tip_is_pressed_at_small_strain() -> None:
    bent = force_at_depth(flat_organ(tip=CONE, neo_hookean=0.48), 3e-3)
    assert bent == force_at_depth(flat_organ(tip=CONE), 3e-3)


# --- Surfaces that fall away in the same way around every place -----------------------------------


def bent_organ(tip: Tip, kappa: float, tau: float = 0.0, anisotropy: float = 0.0) -> ContactModel:
    """A half-space whose surface falls away by kappa r + tau r^2 / 2 a distance."""
    model = flat_organ(compliance=DENT, tip=tip)
    local = model.effects.tip_law.local
    local[KAPPA], local[TAU], local[ANISOTROPY] = kappa, tau, anisotropy
    return model


@pytest.mark.parametrize(("kappa", "tau"), [(60.0, -4e3), (-40.0, 5e3), (20.0, 0.0)])
@pytest.mark.parametrize("depth", [0.5e-3, 3e-3])
def test_a_sphere_on_a_bent_surface_is_a_tip_of_another_profile(
    kappa: float, tau: float, depth: float
) -> None:
    force = force_at_depth(bent_organ(SPHERE, kappa, tau), depth)
    exact = sneddon(SPHERE, depth, E_STAR, lambda r: kappa * r + 0.5 * tau * r**2)
    assert force == pytest.approx(exact, rel=2e-3)


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
    force = force_at_depth(bent_organ(tip, 0.5 * tube, anisotropy=(0.5 * tube) ** 2), depth)
    assert force == pytest.approx(exact, rel=0.015)
    assert force_at_depth(bent_organ(tip, 0.5 * tube), depth) < 0.98 * exact  # were it round


@pytest.mark.parametrize("tip", [SPHERE, Tip("flat", 3e-3), CONE])
@pytest.mark.parametrize(
    ("kappa", "tau"), [(-500.0, 0.0), (100.0, -1e6), (-500.0, -1e6), (-500.0, 1e4)]
)
def test_no_hollow_makes_a_contact_shrink_as_it_deepens(tip: Tip, kappa: float, tau: float) -> None:
    model = bent_organ(tip, kappa, tau)
    force = [force_after_touch(model, depth) for depth in np.linspace(0.2e-3, 6e-3, 30)]
    assert (np.diff(force) > 0.0).all()
