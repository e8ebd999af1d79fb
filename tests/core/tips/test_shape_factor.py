"""Effect of bulges, facets, folds and edges on a tip, relative to the law of a plane."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from avatar_core.common.splines import evaluate_all
from avatar_core.fem.half_space_contact import loads_on_heights, ring_radii, sector_angles
from avatar_core.fem.signorini import half_space_radius
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.tip import MAX_DEPTH, Tip
from avatar_core.tips import kept_factors
from avatar_core.tips.kept_factors import factors_of
from avatar_core.tips.law import ShapeFactor, of_planes
from avatar_core.tips.shape_factor import RETREAT, SPACING, dense
from avatar_core.vademecum.tip_field import TipField, make_tip_field
from tests.core.conftest import box_mesh, box_regions
from tests.helpers.half_space import sneddon
from tests.helpers.known_surfaces import ball

PATCH = 12e-3
SLOPE = np.tan(np.radians(15.0))  # slope of both sides of the roof
TOP = 0.06  # height of the roof's ridge [m]
BALL = 40e-3  # radius of the round organ [m]
RADII = (1.5e-3, 5e-3, 7e-3, 10e-3)
PUNCH, CONE = Tip("flat", 3e-3), Tip("cone", 10e-3, 60.0)
BALLS = [Tip("sphere", radius) for radius in RADII]


@cache
def roof() -> TipField:
    """Return a block whose top falls off to both sides of the ridge x = 0.05, y = ``TOP``."""
    box = box_mesh(4, (0.1, TOP, 0.1))
    vertices = box.vertices.copy()
    vertices[:, 1] -= SLOPE * abs(vertices[:, 0] - 0.05) * vertices[:, 1] / TOP
    return make_tip_field(TetMesh(vertices, box.tets), box_regions(box), PATCH)


@cache
def round_organ() -> TipField:
    """Return a ball, accessible all around."""
    surface = ball(BALL, level=5)
    apex = np.full((len(surface.faces), 1), len(surface.vertices))
    mesh = TetMesh(
        np.vstack([surface.vertices, np.zeros(3)]), np.hstack([apex, surface.faces]).astype(int)
    )
    whole = np.ones(len(mesh.boundary_faces), bool)
    return make_tip_field(mesh, Regions(~whole, whole), PATCH, surface)


def at_points(values: np.ndarray, spacing: float, field: TipField, at: np.ndarray) -> np.ndarray:
    out = np.empty(len(at))
    evaluate_all(values, field.origin, spacing, at, out, np.empty_like(at))
    return out


def shape_factor(field: TipField, tip: Tip, at: np.ndarray) -> np.ndarray:
    shape = factors_of(field, [tip])
    return np.exp(at_points(dense(shape.value[0], shape.brick), shape.spacing[0], field, at))


def over_the_ridge(tip: Tip, depths: np.ndarray) -> np.ndarray:
    """Return poses of a tip above the middle of the ridge."""
    at = np.tile([0.05, TOP + tip.offset, 0.047], (len(depths), 1))
    at[:, 1] -= depths
    return at


def over_the_ball(tip: Tip, depth: float) -> np.ndarray:
    n = np.random.default_rng(0).normal(size=(40, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return (BALL + tip.offset - depth) * n


@pytest.mark.parametrize("tip", [*BALLS, PUNCH, CONE])
def test_over_a_ridge_a_tip_feels_that_of_boundary_elements(tip: Tip) -> None:
    depths = np.array([2e-3, 3e-3, 4.5e-3])
    at = over_the_ridge(tip, depths)
    felt = tip.offset - at_points(roof().distance, float(roof().spacing[0]), roof(), at)
    given = (1.0 - RETREAT) * felt
    reach = [min(half_space_radius(tip, d), tip.radius) for d in given]
    window = np.minimum(2.0 * np.array(reach), 0.999 * tip.radius)
    rise = window[:, None] * ring_radii()
    under = tip.height(rise) - given[:, None]
    fall = SLOPE * abs(rise[:, :, None] * np.cos(sector_angles()))
    load = loads_on_heights(under, window, fall + (felt - depths)[:, None, None])
    exact = load / [sneddon(tip, d, 1.0) for d in given]
    found = shape_factor(roof(), tip, at)
    assert (exact < 0.96).all()
    np.testing.assert_allclose(found, exact, rtol=0.05)


@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize("depth", [0.3e-3, 1e-3])
def test_on_a_ball_a_ball_is_hertzs(radius: float, depth: float) -> None:
    tip = Tip("sphere", radius)
    found = shape_factor(round_organ(), tip, over_the_ball(tip, depth))
    np.testing.assert_allclose(found, (1.0 + radius / BALL) ** -0.5, rtol=0.04)


@pytest.mark.parametrize("tip", BALLS)
def test_over_one_curvature_the_depth_changes_little(tip: Tip) -> None:
    """The force on the tool is therefore the load on the organ."""
    deep, shallow = (
        shape_factor(round_organ(), tip, over_the_ball(tip, depth)) for depth in (4e-3, 1e-3)
    )
    np.testing.assert_allclose(deep, shallow, rtol=0.05)


def test_it_is_held_as_deep_as_a_tip_may_be_and_where_the_contact_begins() -> None:
    tip = Tip("sphere", 5e-3)
    deep = np.array([8e-3, 12e-3, 20e-3, tip.offset + MAX_DEPTH])
    found = np.log(shape_factor(roof(), tip, over_the_ridge(tip, deep)))
    np.testing.assert_allclose(found[1], found[0], rtol=0.1)
    assert (found < 0.3 * found[0]).all() and found[0] < -0.05  # on both flanks it is less
    begin = np.log(shape_factor(roof(), tip, over_the_ridge(tip, np.array([0.0, 1e-3]))))
    np.testing.assert_allclose(begin[0], begin[1], rtol=0.05)


@pytest.mark.parametrize("tip", [*BALLS, PUNCH, CONE])
def test_on_a_plane_it_is_one(tip: Tip) -> None:
    mesh = box_mesh(4)
    field = make_tip_field(mesh, box_regions(mesh), PATCH)
    x, z = np.random.default_rng(0).uniform(0.03, 0.07, (2, 100))
    for depth in (0.0, 1e-3, 4e-3):
        at = np.stack([x, np.full(100, 0.1 + tip.offset - depth), z], axis=1)
        np.testing.assert_allclose(shape_factor(field, tip, at), 1.0, atol=2e-3)


def test_each_tip_of_a_scene_has_its_own() -> None:
    tips = [PUNCH, Tip("sphere", 3e-3), Tip("sphere", 3e-3)]
    shape = factors_of(roof(), tips)
    assert shape.spacing == SPACING
    np.testing.assert_array_equal(shape.value[1], shape.value[2])
    at = over_the_ridge(PUNCH, np.array([2e-3]))
    together = at_points(dense(shape.value[0], shape.brick), SPACING, roof(), at)
    np.testing.assert_array_equal(np.exp(together), shape_factor(roof(), PUNCH, at))


def test_a_patch_and_a_field_without_an_outline_have_none() -> None:
    assert factors_of(roof()._replace(outline=None), [PUNCH]).value.size == 0
    assert factors_of(roof(), [Tip("patch", 3e-3)]).value.size == 0


# --- cache ------------------------------------------------------------------------------------


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Tip]]:
    """Record the tips whose factors are computed, with an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found: list[Tip] = []

    def factor_of(field: TipField, tip: Tip) -> ShapeFactor:
        found.append(tip)
        return of_planes(1)

    monkeypatch.setattr(kept_factors, "factor_of", factor_of)
    kept_factors._kept.cache_clear()
    yield found
    kept_factors._kept.cache_clear()


def test_a_factor_is_computed_once_for_an_organ_and_a_tip(made: list[Tip]) -> None:
    tips = [Tip("sphere", 3e-3), PUNCH]
    for _ in range(2):
        factors_of(roof(), tips)
        kept_factors._kept.cache_clear()  # as in another process
    assert made == tips
    moved = roof()._replace(distance=roof().distance + np.float32(1e-3))
    factors_of(moved, tips[:1])
    assert made == [*tips, tips[0]]


def test_a_damaged_cache_or_none_costs_time_alone(made: list[Tip], tmp_path: Path) -> None:
    factors_of(roof(), [PUNCH])
    (file,) = (tmp_path / "avatar" / "tips").iterdir()
    file.write_bytes(file.read_bytes()[:-40])
    kept_factors._kept.cache_clear()
    factors_of(roof(), [PUNCH])
    assert made == [PUNCH, PUNCH]
    file.unlink()
    file.parent.rmdir()
    file.parent.write_text("no folder")
    kept_factors._kept.cache_clear()
    factors_of(roof(), [PUNCH])
    assert made == [PUNCH] * 3


def test_the_cache_does_not_grow_for_ever(made: list[Tip], tmp_path: Path) -> None:
    for k in range(kept_factors._ON_DISK + 3):
        factors_of(roof(), [Tip("sphere", 1e-3 + 1e-5 * k)])
    assert len(list((tmp_path / "avatar" / "tips").iterdir())) == kept_factors._ON_DISK
