"""What a ball feels of facets, folds and edges beside the contact law's few numbers."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from avatar_core.common.splines import evaluate_all
from avatar_core.contact.ball_shift import RADII, RETREAT, SPACING, make_felt_field, shifts_of
from avatar_core.contact.ball_shift import _dense as dense
from avatar_core.contact.effects.tip_law import depths_under_loads, tip_law_arrays, tip_law_state
from avatar_core.fem.elasticity import Material
from avatar_core.fem.half_space_contact import loads_on_heights, ring_radii, sector_angles
from avatar_core.fem.signorini import half_space_radius
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.tip_field import TipField
from tests.core.conftest import box_mesh, box_regions

PATCH = 12e-3
SLOPE = np.tan(np.radians(15.0))  # of both sides of the roof
TOP = 0.06  # height of the roof's ridge [m]


@cache
def roof() -> TipField:
    """Of a block whose top falls off to both sides of the ridge x = 0.05, y = ``TOP``."""
    box = box_mesh(4, (0.1, TOP, 0.1))
    vertices = box.vertices.copy()
    vertices[:, 1] -= SLOPE * abs(vertices[:, 0] - 0.05) * vertices[:, 1] / TOP
    return make_felt_field(TetMesh(vertices, box.tets), box_regions(box), PATCH)


def at_points(values: np.ndarray, at: np.ndarray, spacing: float | None = None) -> np.ndarray:
    """A field of the roof at some poses, shape (n,)."""
    field, out = roof(), np.empty(len(at))
    step = field.spacing[0] if spacing is None else spacing
    evaluate_all(values, field.origin, step, at, out, np.empty_like(at))
    return out


def psi(radius: float, at: np.ndarray) -> np.ndarray:
    shift = shifts_of(roof(), [Tip("sphere", radius)])
    return at_points(dense(shift.value[0], shift.brick), at, shift.spacing[0])


def law_depth(radius: float, at: np.ndarray, load: np.ndarray) -> np.ndarray:
    """The depth at which the contact law feels F / E* with the local profile at some poses."""
    field = roof()
    shape = [at_points(f, at) for f in (field.curvature, field.growth, field.anisotropy)]
    arrays = tip_law_arrays((Tip("sphere", radius),), Material(), np.zeros((5, 0, 0, 0)))
    assert arrays is not None
    depth = np.empty(len(at))
    depths_under_loads(tip_law_state(arrays, 0), *shape, load, depth)
    return depth


def over_the_ridge(radius: float, depths: np.ndarray) -> np.ndarray:
    """Poses of a ball above the middle of the ridge."""
    at = np.tile([0.05, TOP + radius, 0.047], (len(depths), 1))
    at[:, 1] -= depths
    return at


@pytest.mark.parametrize("radius", [*RADII, 4e-3])
def test_over_a_ridge_a_ball_feels_that_of_boundary_elements(radius: float) -> None:
    """Along the ridge of a roof: to 0.04 mm, where phi alone is 0.05 to 0.11 mm off.

    For radii that are stored, and for one between them.
    """
    depths = np.array([2e-3, 3e-3, 4.5e-3])
    given = (1.0 - RETREAT) * depths
    window = np.array(
        [min(2.0 * half_space_radius(Tip("sphere", radius), d), 0.999 * radius) for d in given]
    )
    x = window[:, None, None] * ring_radii()[:, None] * np.cos(sector_angles())
    load = loads_on_heights(radius, given, window, SLOPE * abs(x))
    at = over_the_ridge(radius, depths)
    phi = at_points(roof().distance, at)
    found = (radius - phi - psi(radius, at)) - (depths - given)
    np.testing.assert_allclose(found, law_depth(radius, at, load), atol=4e-5)


@pytest.mark.parametrize("radius", RADII)
def test_nothing_is_shifted_before_the_ball_touches(radius: float) -> None:
    """psi vanishes with the depth: the contact begins where the ball meets the surface."""
    at = over_the_ridge(radius, np.array([-0.4e-3, -0.2e-3]))
    assert (at_points(roof().distance, at) + psi(radius, at) > radius).all()
    touching, pressed = psi(radius, over_the_ridge(radius, np.array([0.0, 1e-3])))
    assert abs(touching) < 0.15 * abs(pressed)


@pytest.mark.parametrize(("radius", "nearest"), [(1e-3, RADII[0]), (20e-3, RADII[-1])])
def test_a_ball_beyond_the_radii_is_shifted_as_the_nearest_one(
    radius: float, nearest: float
) -> None:
    depths = np.array([1.5e-3, 3e-3, 4.5e-3])
    as_nearest = psi(nearest, over_the_ridge(nearest, depths))
    found = psi(radius, over_the_ridge(radius, depths))
    np.testing.assert_allclose(found, as_nearest, rtol=0.1, atol=3e-5)
    assert abs(as_nearest).max() > 5e-5


def test_only_balls_are_shifted() -> None:
    tips = [Tip("flat", 3e-3), Tip("sphere", 3e-3), Tip("sphere", 17e-3), Tip("sphere", 3e-3)]
    shift = shifts_of(roof(), tips)
    assert shift.spacing == SPACING
    assert not shift.value[0].any()
    assert abs(shift.value[1:]).max(axis=(1, 2, 3, 4)).min() > 5e-5
    np.testing.assert_array_equal(shift.value[1], shift.value[3])
    assert shifts_of(roof(), tips[:1]).value.size == 0
    assert shifts_of(roof()._replace(shift=None), tips).value.size == 0


def test_a_plane_shifts_nothing() -> None:
    mesh = box_mesh(4)
    field = make_felt_field(mesh, box_regions(mesh), PATCH)
    x, z = np.random.default_rng(0).uniform(0.03, 0.07, (2, 100))
    for radius in RADII:
        shift, out = shifts_of(field, [Tip("sphere", radius)]), np.empty(100)
        values = dense(shift.value[0], shift.brick)
        for depth in (0.0, 1e-3, 4e-3):
            at = np.stack([x, np.full(100, 0.1 + radius - depth), z], axis=1)
            evaluate_all(values, field.origin, shift.spacing[0], at, out, np.empty_like(at))
            assert abs(out).max() < 1e-6
