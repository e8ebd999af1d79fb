"""The contact law of tips on a flat organ, against closed forms and finite elements.

Energy balance is in test_energy.py, friction and relaxation of tips with these effects.
"""

from __future__ import annotations

from functools import partial

import pytest

from avatar_core.contact.model import ContactData
from avatar_core.fem.patch_on_plane import PATCH
from avatar_core.geometry.tip import Tip
from tests.helpers.flat_organ import COMPLIANCE, E_STAR, PATCH_RADIUS, flat_organ, force_at_depth
from tests.helpers.half_space import on_soft_base, sneddon

SPHERE, CONE = Tip("sphere", 5e-3), Tip("cone", 15e-3, 60.0)
DENT = PATCH / (E_STAR * PATCH_RADIUS)  # compliance of an organ that has only that of the dent
BASE = COMPLIANCE - DENT  # compliance of the organ beside the dent [m/N]


def force_after_touch(data: ContactData, depth: float) -> float:
    """Return the force; the tip's centre may be below the surface, after a touch [N]."""
    force_at_depth(data, 1e-4)
    return force_at_depth(data, depth)


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
    """The organ may also give way as a whole."""
    data = flat_organ(compliance=DENT + base, tip=Tip("sphere", radius), neo_hookean=nu)
    for depth, force in ELEMENTS[nu].items():
        expected = force * (1.0 - nu**2) * E_STAR * radius**2
        found = force_after_touch(data, depth * radius + base * expected)
        assert found == pytest.approx(expected, rel=5e-3)


def test_another_tip_is_pressed_at_small_strain() -> None:
    bent = force_at_depth(flat_organ(tip=CONE, neo_hookean=0.48), 3e-3)
    assert bent == force_at_depth(flat_organ(tip=CONE), 3e-3)
