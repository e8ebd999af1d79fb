"""Resolved contact: Sneddon's exact tips, the conditions of contact, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.errors import ContactError, ConvergenceError
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.signorini import (
    CondensedContact,
    Push,
    complementary,
    half_space_radius,
    through_centre,
)
from avatar_core.geometry.refinement import Grading, refine
from avatar_core.geometry.tip import Tip
from avatar_core.offline.resolved_contact import contacts_at
from tests.core.conftest import box_mesh, box_regions

SIDE = 0.2  # side of the cube in place of a half-space [m]
TOP = np.array([0.5 * SIDE, SIDE, 0.5 * SIDE])
UP = np.array([0.0, 1.0, 0.0])
MATERIAL = Material()
MODULUS = MATERIAL.young_modulus / (1.0 - MATERIAL.poisson_ratio**2)  # E*
SPHERE, PUNCH = Tip("sphere", 3e-3), Tip("flat", 2e-3)
CONE = Tip("cone", 3e-3, half_angle=60.0)


def _cube(core: float, inner: float, outer: float, *places: np.ndarray) -> Elasticity:
    mesh = box_mesh(4, (SIDE, SIDE, SIDE))
    gradings = [Grading(x, UP, core, 2.4e-3, inner, outer) for x in places or (TOP,)]
    mesh, regions = refine(mesh, box_regions(mesh), gradings)
    return Elasticity(mesh, MATERIAL, regions.clamped)


def _sphere_force(radius: float, depth: float) -> float:
    a = half_space_radius(Tip("sphere", radius), depth)
    log = np.log((radius + a) / (radius - a))
    assert 0.5 * a * log == pytest.approx(depth, rel=1e-6)
    return float(MODULUS * (0.5 * (a**2 + radius**2) * log - a * radius))


@pytest.fixture(scope="module")
def pressed() -> CondensedContact:
    """Press a sphere, a punch and a cone at one place of a cube, about six elements across."""
    pushes = [Push(tip, TOP, UP) for tip in (SPHERE, PUNCH, CONE)]
    return CondensedContact(_cube(0.7e-3, 0.25, 0.7), pushes, np.array([2e-3, 1e-3, 1e-3]))


@pytest.mark.long
@pytest.mark.parametrize("depth", [1e-3, 2e-3])
def test_a_sphere_feels_sneddons_force(pressed: CondensedContact, depth: float) -> None:
    touch = pressed.solve([0], [depth]).touches[0]
    assert touch.force == pytest.approx(_sphere_force(SPHERE.radius, depth), rel=0.02)
    assert touch.radius == pytest.approx(half_space_radius(SPHERE, depth), rel=0.1)


def test_a_punch_and_a_cone_feel_sneddons_force(pressed: CondensedContact) -> None:
    depth = 1e-3
    punch, cone = (pressed.solve([k], [depth]).forces[0] for k in (1, 2))
    assert punch == pytest.approx(2 * MODULUS * PUNCH.radius * depth, rel=0.03)
    slope = np.tan(np.radians(60.0))
    assert cone == pytest.approx(2 / np.pi * MODULUS * slope * depth**2, rel=0.03)


def test_the_surface_gives_way_and_pushes_back(pressed: CondensedContact) -> None:
    contact = pressed.solve([0], [2e-3])
    touch, mesh = contact.touches[0], pressed.elasticity.mesh
    np.testing.assert_allclose(
        contact.loads.reshape(-1, 3).sum(axis=0), -touch.force * UP, atol=1e-9
    )
    assert (touch.pressures > 0).all() and contact.violation < 1e-9
    u = pressed.displacements([contact])[0]
    r = np.linalg.norm((mesh.vertices[touch.vertices] - TOP)[:, [0, 2]], axis=1)
    inside = touch.vertices[r < 1.5e-3]
    np.testing.assert_allclose(-u[inside, 1], 2e-3 - SPHERE.height(r[r < 1.5e-3]), atol=0.03 * 2e-3)


@pytest.mark.long
def test_a_ball_pushed_askew_finds_the_axis_without_moment() -> None:
    """In a half-space it is the normal, with Sneddon's force, whatever the first axis."""
    depth, angle = 1e-3, np.radians(12.0)
    axis = np.array([np.sin(angle), np.cos(angle), 0.0])
    to_centre = SPHERE.radius - depth
    askew = Push(SPHERE, TOP + to_centre * (UP - axis), axis)
    cube = _cube(0.4e-3, 0.25, 0.7)
    touch = CondensedContact(cube, [askew], depth, reach=2.5).solve([0], [depth]).touches[0]
    np.testing.assert_allclose(touch.lean, np.tan(angle) * across(axis), atol=0.03)
    for _ in range(2):
        askew = through_centre(askew, touch)
        touch = CondensedContact(cube, [askew], depth).solve([0], [depth]).touches[0]
    assert askew.axis @ UP > np.cos(np.radians(0.5))
    np.testing.assert_allclose(
        askew.point + to_centre * askew.axis, TOP + to_centre * UP, atol=1e-9
    )
    assert touch.force == pytest.approx(_sphere_force(SPHERE.radius, depth), rel=0.02)


@pytest.mark.long
def test_contacts_at_a_place_turn_the_axis_of_balls_alone() -> None:
    """The centre of the ball stays; a punch presses along the axis that it was given."""
    angle, depth = np.radians(12.0), 1e-3
    axis = np.array([np.sin(angle), np.cos(angle), 0.0])
    mesh = box_mesh(4, (SIDE, SIDE, SIDE))
    tips = (SPHERE, PUNCH)
    found = contacts_at(None, mesh, box_regions(mesh), MATERIAL, TOP, axis, tips, (depth,))
    assert found.axes[0, 0] @ UP > np.cos(np.radians(2.0))
    np.testing.assert_array_equal(found.axes[1, 0], axis)
    deeper = SPHERE.radius - (SPHERE.radius - depth) * np.cos(angle)
    assert found.forces[0, 0] == pytest.approx(_sphere_force(SPHERE.radius, deeper), rel=0.02)


def across(axis: np.ndarray) -> np.ndarray:
    """Return the direction across an axis in which ``UP`` leans away from it."""
    side = (axis @ UP) * axis - UP
    return np.asarray(side / np.linalg.norm(side))


def test_a_punch_keeps_its_axis(pressed: CondensedContact) -> None:
    for k in (1, 2):
        touch = pressed.solve([k], [1e-3]).touches[0]
        assert not touch.lean.any()
        np.testing.assert_array_equal(through_centre(pressed.pushes[k], touch).axis, UP)


def test_no_force_before_the_tip_touches(pressed: CondensedContact) -> None:
    contact = pressed.solve([0], [-1e-3])
    assert contact.forces[0] == 0 and len(contact.touches[0].vertices) == 0
    np.testing.assert_allclose(pressed.first_depths, 0.0, atol=0.2e-3)


def test_what_was_not_prepared_is_refused(pressed: CondensedContact) -> None:
    with pytest.raises(ContactError, match="beyond the deepest"):
        pressed.solve([1], [2e-3])
    narrow = CondensedContact(pressed.elasticity, [Push(SPHERE, TOP, UP)], 1e-3, reach=0.2)
    with pytest.raises(ContactError, match="raise its reach"):
        narrow.solve([0], [1e-3])
    with pytest.raises(ContactError, match="faces it"):
        CondensedContact(pressed.elasticity, [Push(SPHERE, TOP, -UP)], 1e-3)


def test_complementary_pressures_satisfy_the_conditions() -> None:
    for seed in range(200):
        rng = np.random.default_rng(seed)
        root = rng.normal(size=(12, 12))
        compliance, needed = root @ root.T, rng.normal(size=12)
        pressure = complementary(compliance, needed)
        slack = compliance @ pressure - needed
        assert (pressure >= 0).all() and slack.min() > -1e-6
        np.testing.assert_allclose(pressure * slack, 0.0, atol=1e-6)


def test_a_compliance_that_is_none_is_refused() -> None:
    with pytest.raises(ConvergenceError, match="slivers"):
        complementary(-np.eye(2), np.ones(2))


@pytest.mark.long
def test_two_tips_soften_each_other_as_two_point_forces() -> None:
    """On a half-space the force F of one lowers the surface by F / (pi E* D) at the other."""
    apart, depth = 25e-3, 2e-3
    aside = np.array([0.5 * apart, 0.0, 0.0])
    places = np.stack([TOP - aside, TOP + aside])
    elasticity = _cube(0.6e-3, 0.25, 0.5, *places)
    pushes = [Push(SPHERE, place, UP) for place in places]
    contact = CondensedContact(elasticity, pushes, depth).solve((0, 1), (depth, depth))
    assert contact.forces[0] == pytest.approx(contact.forces[1], rel=0.01)
    lowered = contact.forces[0] / (np.pi * MODULUS * apart)
    assert contact.forces[0] == pytest.approx(_sphere_force(3e-3, depth - lowered), rel=0.02)
