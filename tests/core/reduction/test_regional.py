"""Fields separated region by region: least and stated errors, one field across borders."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from avatar_core.contact.cloud_kernels import MAX_PAST, _fade_regions
from avatar_core.contact.effects import Viscoelasticity
from avatar_core.contact.tool_path import slide
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.regional import RegionalRule, RegionModes, regions_of, separate_regions
from avatar_core.vademecum.model import Vademecum
from tests.helpers.contact import prepare, step

N_VERTICES, N_POSITIONS, N_LOADS = 40, 24, 3
SINGLE = 5e-4  # squared columns in single precision resolve errors above this


@pytest.fixture
def columns() -> np.ndarray:
    """Return smooth fields of positions on a line: neighbors are similar, (3 n_v, n, 3)."""
    x = np.linspace(0.0, 1.0, 3 * N_VERTICES)[:, None, None]
    s = np.linspace(0.0, 1.0, N_POSITIONS)[None, :, None]
    direction = np.array([1.0, 0.3, -0.7])
    return np.asarray(np.exp(-30.0 * (x - s) ** 2) * direction + 0.1 * np.sin(9 * x * direction))


MASS = np.linspace(0.5, 2.0, 3 * N_VERTICES)
REGION = np.repeat([0, 1, 2], N_POSITIONS // 3).astype(np.int32)


def separated(columns: np.ndarray, rule: RegionalRule) -> tuple[list[RegionModes], np.ndarray]:
    size = np.sqrt(np.einsum("x,xij->ij", MASS, columns**2))
    return separate_regions(REGION, lambda at: columns[:, at], rule, size, MASS)


def true_errors(regions: list[RegionModes], columns: np.ndarray) -> np.ndarray:
    size, left = np.sqrt(np.einsum("x,xij->ij", MASS, columns**2)), columns.copy()
    for r, (space, load) in enumerate(regions):
        left[:, r == REGION] -= np.einsum("xk,pik->xpi", space, load)
    return np.asarray(np.sqrt(np.einsum("x,xij->ij", MASS, left**2)) / size)


def ranks(regions: list[RegionModes]) -> list[int]:
    return [space.shape[1] for space, _ in regions]


def test_errors_that_are_told_are_those_that_are_left(columns: np.ndarray) -> None:
    for most in (2, 4, 7):
        regions, errors = separated(columns, RegionalRule(0.0, 0.0, most))
        assert ranks(regions) == [most] * 3
        np.testing.assert_allclose(errors[most], true_errors(regions, columns), atol=SINGLE)
        peaks = [np.abs(space).max(axis=0) for space, _ in regions]
        np.testing.assert_allclose(peaks, 1.0, rtol=1e-6)


def test_the_tolerance_is_met_with_as_few_modes_as_do(columns: np.ndarray) -> None:
    rule = RegionalRule(tolerance=0.02, worst=0.06, most=20)
    regions, errors = separated(columns, rule)
    found = true_errors(regions, columns)
    for region, rank in enumerate(ranks(regions)):
        here = region == REGION
        assert found[here].mean() < rule.tolerance + SINGLE
        assert found[here].max() < rule.worst + SINGLE
        fewer = errors[rank - 1, here]
        assert fewer.mean() > rule.tolerance or fewer.max() > rule.worst
    assert max(ranks(regions)) < 20


def test_no_basis_of_as_many_modes_leaves_less(columns: np.ndarray) -> None:
    """By the mean square of relative errors, against random and smooth bases."""
    _, errors = separated(columns, RegionalRule(0.0, 0.0, 3))
    here = REGION == 1
    size = np.sqrt(np.einsum("x,xij->ij", MASS, columns**2))
    scaled = (np.sqrt(MASS)[:, None, None] * columns / size)[:, here].reshape(len(MASS), -1)
    least = (errors[3, here] ** 2).sum()
    rng = np.random.default_rng(0)
    for basis in (rng.standard_normal((len(MASS), 3)), scaled[:, ::8][:, :3]):
        q = np.linalg.qr(basis)[0]
        assert ((scaled - q @ (q.T @ scaled)) ** 2).sum() > least


def test_regions_are_compact_and_the_same_every_time() -> None:
    centers = np.random.default_rng(3).uniform(size=(300, 3))
    region = regions_of(centers, 12)
    np.testing.assert_array_equal(region, regions_of(centers, 12))
    assert set(region) == set(range(region.max() + 1)) and region.max() >= 9
    within = np.mean([centers[region == r].var(axis=0).sum() for r in range(region.max() + 1)])
    assert within < 0.3 * centers.var(axis=0).sum()
    assert set(regions_of(centers[:2], 12)) == {0, 1}


def test_displacement_and_force_cross_borders_of_regions_without_a_jump(
    phantom_vademecum: Vademecum,
) -> None:
    """A step of 0.1 mm moves the cloud as little at a border as within a region."""
    v, tip = phantom_vademecum, Tip("sphere", 8e-3)
    data = prepare(v, (tip,), cloud="volume")
    path = slide(v, tip.offset, 4e-3, 0.12)
    quarters = np.arange(0.0, len(path) - 1.0, 0.25)
    fine = np.column_stack([np.interp(quarters, np.arange(len(path)), x) for x in path.T])
    moved, force, regions = [], [], []
    for at in fine:
        step(data, at[None].copy())
        moved.append(data.out.cloud[:, 3:].astype(float).copy())
        force.append(data.out.force[0].copy())
        regions.append(frozenset(data.state.touched[: data.state.n_touched[0]].tolist()))
    change = np.array([np.abs(b - a).max() for a, b in pairwise(moved)])
    turns = np.array([a != b for a, b in pairwise(regions)])
    assert turns.sum() >= 4  # the way leads through several regions
    assert np.isfinite(change).all() and change.max() > 0.0
    usual = np.quantile(change[~turns], 0.99)
    assert change[turns].max() < 2.0 * usual
    pull = np.linalg.norm(np.diff(force, axis=0), axis=1)
    assert pull[turns].max() < 2.0 * np.quantile(pull[~turns], 0.99)


def test_a_history_in_many_regions_is_shown_without_a_jump(phantom_vademecum: Vademecum) -> None:
    """Soft tissue was stroked across many regions: those that moved most stay shown."""
    v, tip = phantom_vademecum, Tip("sphere", 8e-3)
    slow = Viscoelasticity((0.95,), (2.0,))
    data = prepare(v, (tip,), cloud="volume", effects=(slow,))
    path = slide(v, tip.offset, 4e-3, 0.4)
    shown, change, turns, before = [], [], [], None
    for at in path:
        step(data, at[None].copy())
        cloud = data.out.cloud[:, 3:].astype(float).copy()
        shown.append(frozenset(data.state.touched[: data.state.n_touched[0]].tolist()))
        if before is not None:
            change.append(np.abs(cloud - before).max())
            turns.append(shown[-1] != shown[-2])
        before = cloud
    seen = frozenset().union(*shown)
    assert len(seen) > MAX_PAST + 2  # more were stroked than are shown
    step(data, np.full((1, 3), 1e3))  # the tip is gone: what is left is history
    assert data.state.n_touched[0] == MAX_PAST
    assert np.max(change, where=turns, initial=0.0) < 2.0 * np.quantile(change, 0.99)


def test_regions_fade_before_they_are_left_out(phantom_vademecum: Vademecum) -> None:
    """Four of seven stay, each reduced by the fifth's motion, so that no change jumps."""
    data = prepare(phantom_vademecum, cloud="volume")
    state, start = data.state, data.model.arrays.region_start
    own = start[:7] + start[0]  # the first of its modes, after the global ones
    moved = np.arange(7.0, 0.0, -1.0)
    state.n_touched[0], state.touched[:7] = 7, np.arange(7)
    state.is_touched[:7] = True
    state.amplitude[:] = 0.0
    state.amplitude[own] = moved
    _fade_regions(data.model.arrays, state)
    assert state.n_touched[0] == MAX_PAST
    assert state.touched[:MAX_PAST].tolist() == [0, 1, 2, 3]
    assert state.is_touched[:7].tolist() == [True] * 4 + [False] * 3
    np.testing.assert_allclose(state.amplitude[own[:4]], moved[:4] - moved[4], rtol=1e-5)
