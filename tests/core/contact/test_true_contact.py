"""The force of the step against references: Sneddon on boxes, resolved contacts on organs.

A cube of 200 mm, clamped below, acts as a half-space under a tip. Its free sides let a patch of
12 mm in the middle of its top sink deeper, its clamp less deep; both together leave 0.1 %.
Sneddon's forces hold as they are. A column of half the width also gives way as a whole. There the
depth is Sneddon's plus the force times the extra sinking of the patch on fine elements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pytest

from avatar_core.certify.contact_sites import Site, draw_sites
from avatar_core.contact.effects import LargeDeformation, SeveralTools
from avatar_core.fem.elasticity import Material
from avatar_core.fem.signorini import CondensedContact, Push
from avatar_core.fem.sphere_indentation import Domain, SphereIndentation
from avatar_core.geometry.mesh import regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.tip import Tip
from avatar_core.offline.large_deformation import (
    LargeRule,
    hyperelastic_problem,
    with_large_deformation,
)
from avatar_core.offline.resolved_contact import contacts_at, refined_organ
from avatar_core.vademecum.model import Vademecum
from tests.helpers.box_organ import (
    MATERIAL,
    MODULUS,
    PATCH_RADIUS,
    UP,
    Body,
    body_mesh,
    organ,
    patch_compliance,
    top,
)
from tests.helpers.contact import prepare
from tests.helpers.disk_cache import cached_on_disk
from tests.helpers.half_space import on_soft_base, sneddon
from tests.helpers.tool_motion import press

RADII = (1e-3, 3e-3, 5e-3, 10e-3)
DEPTHS = (0.5e-3, 1e-3, 2e-3, 5e-3)
SHAPES: dict[str, Callable[[float], Tip]] = {
    "sphere": lambda radius: Tip("sphere", radius),
    "flat": lambda radius: Tip("flat", radius),
    "cone": lambda radius: Tip("cone", radius, 45.0),
    "rounded_cone": lambda radius: Tip("rounded_cone", radius, 50.0, 0.3 * radius),
}
TIPS = [
    pytest.param(make(radius), id=f"{shape}-{1e3 * radius:g}mm")
    for shape, make in SHAPES.items()
    for radius in RADII
]
# offsets from the middle, between load positions [m]
ASIDE = ((0.0, 0.0), (3e-3, 2e-3), (-9e-3, 7e-3))
HALF_SPACE = 0.7665 / (MODULUS * PATCH_RADIUS)  # compliance of a patch on a half-space [m/N]


def depths_of(tip: Tip) -> list[float]:
    """Return the depths at which the contact does not reach the rim of a cone."""
    rimless = tip.shape in ("sphere", "flat")
    return [depth for depth in DEPTHS if rimless or depth <= tip.radius]


def on_top(body: Body, tip: Tip, aside: tuple[float, float]) -> Callable[[float], float]:
    """Return the step's force on a tip over its depth in the top of a box."""
    data = prepare(organ(body), (tip,), cloud="off", effects=())
    point = top(body) + np.array([aside[0], 0.0, aside[1]])
    return lambda depth: float(press(data, (tip,), point[None], UP[None], (depth,))[0])


@pytest.mark.parametrize("tip", TIPS)
def test_a_tip_feels_sneddons_force_on_a_cube(tip: Tip) -> None:
    exact = [sneddon(tip, depth, MODULUS) for depth in depths_of(tip)]
    for aside in ASIDE:
        force = on_top("cube", tip, aside)
        np.testing.assert_allclose([force(depth) for depth in depths_of(tip)], exact, rtol=0.03)


def exact_on_column(tip: Tip, depth: float) -> float:
    """Return Sneddon's force on a half-space that also gives way as the column does [N]."""
    base = patch_compliance("column") - HALF_SPACE
    return on_soft_base(partial(sneddon, tip, modulus=MODULUS), depth, base)


@pytest.mark.long
@pytest.mark.parametrize("tip", TIPS)
def test_a_tip_on_a_column_feels_it_give_way(tip: Tip) -> None:
    """The coarse mesh is too stiff, most for wide tips: 5.5 % at 10 mm."""
    exact = [exact_on_column(tip, depth) for depth in depths_of(tip)]
    force = on_top("column", tip, ASIDE[0])
    limit = 0.01 + 5.0 * tip.radius
    np.testing.assert_allclose([force(depth) for depth in depths_of(tip)], exact, rtol=limit)


@pytest.mark.long
@pytest.mark.parametrize("radius", [3e-3, 10e-3])
def test_a_sphere_feels_the_large_strain_of_a_neo_hookean_cube(radius: float) -> None:
    """It agrees with finite elements of the sphere down to one radius, where it is 7 % lower."""
    cube, rule = organ("cube"), LargeRule(max_push=12e-3)
    problem = hyperelastic_problem(cube, "neo-hookean")
    bent = with_large_deformation(cube, problem, "neo-hookean", rule)
    tip = Tip("sphere", radius)
    data = prepare(bent, (tip,), cloud="off", effects=(LargeDeformation(),))
    place = (top("cube")[None], UP[None])
    elements = SphereIndentation(MATERIAL.poisson_ratio, domain=Domain(0.2))
    for each in elements.press([0.25, 0.5, 1.0]):
        force = press(data, (tip,), *place, (each.depth * radius,))[0]
        truth = each.force * MATERIAL.young_modulus * radius**2
        assert force == pytest.approx(truth, rel=0.04)


@pytest.mark.long
def test_a_patch_sinks_into_the_cube_as_into_a_half_space() -> None:
    assert patch_compliance("cube") == pytest.approx(HALF_SPACE, rel=2e-3)


@cached_on_disk
def true_force(
    point: tuple[float, ...], normal: tuple[float, ...], radius: float, depth: float
) -> float:
    """Return the force of a sphere's resolved contact with the coarse phantom [N]."""
    surface = phantom_liver(12e-3)
    mesh = tetrahedralize(surface, 800)
    organ_there = (surface, mesh, regions_by_rule(mesh), Material())
    place = (np.array(point), np.array(normal))
    truth = contacts_at(*organ_there, *place, [Tip("sphere", radius)], [depth])
    return float(truth.forces[0, 0])


@pytest.mark.long
def test_a_tip_on_an_organ_feels_a_resolved_contact(straight: Vademecum) -> None:
    tip, depth = Tip("sphere", 5e-3), 2e-3
    site = draw_sites(straight, phantom_liver(12e-3), 8, 1)[2]
    data = prepare(straight, (tip,), cloud="off", effects=())
    force = press(data, (tip,), site.point[None], site.normal[None], (depth,))[0]
    truth = true_force(tuple(site.point.tolist()), tuple(site.normal.tolist()), tip.radius, depth)
    assert force == pytest.approx(truth, rel=0.05)


def pairs_of(sites: Sequence[Site]) -> list[tuple[Site, Site]]:
    """Pair sites that are 25 mm apart, to 1.5 mm, with normals within 30 degrees."""
    return [
        (first, second)
        for k, first in enumerate(sites)
        for second in sites[:k]
        if abs(np.linalg.norm(first.point - second.point) - 25e-3) < 1.5e-3
        and first.normal @ second.normal > np.cos(np.radians(30.0))
    ]


@pytest.mark.long
def test_two_tips_on_the_phantom_feel_resolved_contacts(phantom_vademecum: Vademecum) -> None:
    """Two tips on the phantom bear the forces of resolved contacts.

    The force on a tip that the other has almost lifted off is a small difference of two depths. Its
    error is compared with a tenth of the other's force.
    """
    v, surface = phantom_vademecum, phantom_liver()
    tips, depths = (Tip("sphere", 3e-3), Tip("sphere", 5e-3)), ((2e-3, 4e-3), (4e-3, 2e-3))
    data = prepare(v, tips, cloud="off", effects=(SeveralTools(),))
    pairs = pairs_of(draw_sites(v, surface, 60, 0)[:-2])[:1]
    assert len(pairs) == 1
    for pair in pairs:
        points, normals = ([getattr(s, name) for s in pair] for name in ("point", "normal"))
        fine = refined_organ(
            *(surface, v.mesh, v.regions, v.material), points, normals, tips, np.ravel(depths)
        )
        pushes = [Push(*each) for each in zip(tips, points, normals, strict=True)]
        both = CondensedContact(fine, pushes, np.max(depths), reach=2.0)
        for each in depths:
            truth = both.solve((0, 1), each).forces
            force = press(data, tips, np.array(points), np.array(normals), each)
            assert (np.abs(force - truth) < 0.1 * np.maximum(truth, 0.1 * truth.max())).all()


@cached_on_disk
def true_forces_beside(apart: float, radii: tuple[float, float]) -> tuple[np.ndarray, ...]:
    """Return the forces of two balls on a cube, resolved together, for each of ``BESIDE`` [N]."""
    mesh, regions = body_mesh("cube")
    points, tips = beside(apart), [Tip("sphere", radius) for radius in radii]
    fine = refined_organ(None, mesh, regions, MATERIAL, points, [UP, UP], tips, np.ravel(BESIDE))
    pushes = [Push(tip, point, UP) for tip, point in zip(tips, points, strict=True)]
    both = CondensedContact(fine, pushes, np.max(BESIDE), reach=2.0)
    return tuple(both.solve((0, 1), depths).forces for depths in BESIDE)


BESIDE = ((2e-3, 4e-3), (0.8e-3, 4e-3), (4e-3, 2e-3))  # depths of two balls [m]


def beside(apart: float) -> np.ndarray:
    """Return two places on the cube, shape (2, 3) [m]."""
    first = top("cube") + np.array([1e-3, 0.0, 2e-3])
    return np.stack([first, first + apart * np.array([0.8, 0.0, 0.6])])


@pytest.mark.parametrize("apart", [14e-3, pytest.param(20e-3, marks=pytest.mark.long)])
def test_a_ball_in_the_dent_of_another_feels_what_is_left(apart: float) -> None:
    """It falls to a quarter of the force alone; with a patch's dent it would fall to a sixth."""
    radii = (3e-3, 5e-3)
    tips = tuple(Tip("sphere", radius) for radius in radii)
    data = prepare(organ("cube"), tips, cloud="off", effects=(SeveralTools(),))
    for depths, truth in zip(BESIDE, true_forces_beside(apart, radii), strict=True):
        force = press(data, tips, beside(apart), np.array([UP, UP]), depths)
        np.testing.assert_allclose(force, truth, rtol=0.06)
