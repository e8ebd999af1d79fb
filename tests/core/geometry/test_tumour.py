"""A tumour under a tip: its part of the stored energy, and its effect on the stiffness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar_core.contact.model import ContactData
from avatar_core.fem.elasticity import Elasticity, Inclusion
from avatar_core.fem.patch_loads import load_surface
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.geometry.tumour import strained_fraction, volume_fraction_inside
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.resolved_contact import contacts_at
from avatar_core.offline.rule import BuildRule
from avatar_core.tips.profile import STIFFNESS
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Provenance
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from avatar_core.vademecum.tip_field import with_tumour
from tests.core.offline.test_coordinates import ball
from tests.helpers.box_organ import MATERIAL, PATCH_RADIUS, UP, body_mesh, organ, top
from tests.helpers.contact import prepare, step
from tests.helpers.disk_cache import cached_on_disk
from tests.helpers.tool_motion import press

CONTRAST, SIZE, GAP = 5.0, 10e-3, 2e-3  # a ball under the middle of a cube's top
RADIUS, REACH = 3e-3, 24e-3
ORIGIN, Z = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])


def tumour(gap: float = GAP) -> SurfaceMesh:
    return ball(top("cube") - (gap + SIZE) * UP, SIZE)


def fraction(body: SurfaceMesh) -> float:
    return float(strained_fraction(body, ORIGIN, Z, RADIUS, REACH)[0])


def test_a_body_around_all_of_it_stores_all_energy() -> None:
    assert fraction(ball(np.zeros(3), 50e-3)) == pytest.approx(1.0)


def test_a_body_out_of_reach_stores_none() -> None:
    assert fraction(ball(np.array([0.0, 0.0, -40e-3]), 10e-3)) == 0.0
    assert fraction(ball(np.array([0.0, 0.0, 10e-3]), 9e-3)) == 0.0  # above the surface


def test_half_of_the_tissue_stores_half_of_the_energy() -> None:
    assert fraction(ball(np.array([0.1, 0.0, 0.0]), 0.1)) == pytest.approx(0.5, abs=0.07)


@pytest.mark.parametrize("depth", [4e-3, 8e-3, 12e-3])
def test_energy_falls_with_the_distance(depth: float) -> None:
    """Within r it is 1 - 3 a / (4 r) of the total, with a the contact radius."""
    within = fraction(ball(np.zeros(3), depth))
    total = 1.0 - 0.75 * RADIUS / REACH
    assert within == pytest.approx((1.0 - 0.75 * RADIUS / depth) / total, abs=0.06)


@cached_on_disk
def _cube_with_tumour() -> Vademecum:
    mesh, _ = body_mesh("cube")
    plain = organ("cube")
    inclusion = Inclusion(volume_fraction_inside(mesh, tumour()), CONTRAST)
    return build_vademecum(
        "cube",
        Elasticity(mesh, MATERIAL, plain.regions.clamped, inclusion=inclusion),
        plain.regions,
        load_surface(mesh, plain.regions, PATCH_RADIUS),
        with_tumour(plain.tip_field, tumour(), PATCH_RADIUS),
        BuildRule(tolerance=0.5, max_modes=20),
        Provenance("cube", ""),
    )


def sphere_on(vademecum: Vademecum, radius: float) -> ContactData:
    return prepare(vademecum, (Tip("sphere", radius),), cloud="off", effects=())


@pytest.mark.long
def test_a_tip_feels_the_tumour_under_it_and_not_aside() -> None:
    harder = _cube_with_tumour()
    law = sphere_on(harder, RADIUS)
    for aside, low, high in ((0.0, 1.5, CONTRAST), (28e-3, 0.99, 1.02)):
        step(law, (top("cube") + np.array([aside, 1e-3, 0.0]))[None])
        assert law.state.law is not None
        modulus = law.state.law.value[0, STIFFNESS] / law.model.arrays.law.modulus[0]
        assert low <= modulus <= high


def test_a_file_keeps_it(tmp_path) -> None:  # type: ignore[no-untyped-def]
    save_vademecum(_cube_with_tumour(), tmp_path / "cube.h5")
    again = load_vademecum(tmp_path / "cube.h5")
    np.testing.assert_array_equal(again.tip_field.tumour, _cube_with_tumour().tip_field.tumour)
    assert again.contrast == CONTRAST


@pytest.mark.long
def test_a_tip_over_a_tumour_feels_a_resolved_contact() -> None:
    """Without the tumour's own stiffness the force would be half of the true one."""
    harder, place, depths = _cube_with_tumour(), top("cube"), (2e-3, 5e-3)
    tips = [Tip("sphere", radius) for radius in (3e-3, 5e-3)]
    inside = (tumour(), CONTRAST)
    mesh = harder.mesh
    truth = contacts_at(
        None, mesh, harder.regions, MATERIAL, place, UP, tips, depths, tumour=inside
    ).forces
    force = [
        [
            press(sphere_on(harder, tip.radius), (tip,), place[None], UP[None], (d,))[0]
            for d in depths
        ]
        for tip in tips
    ]
    np.testing.assert_allclose(force, truth, rtol=0.15)
    plain = replace(harder, contrast=None)
    without = press(sphere_on(plain, 3e-3), tips[:1], place[None], UP[None], depths[:1])[0]
    assert without < 0.7 * truth[0, 0]
