"""Fields separated block by block: stated and least errors, and the step's display."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.contact.effects import SelfWeight
from avatar_core.contact.tool_path import palpation
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.block_field import POINTS
from avatar_core.reduction.block_modes import BlockModes, compact_order, load_sizes, separate_blocks
from avatar_core.vademecum.model import Vademecum
from tests.helpers.contact import prepare, step

N_BLOCKS, SIZE, N_MODES, N_LOADS = 12, 30, 16, 40
MASS = np.linspace(0.5, 2.0, N_BLOCKS * SIZE).reshape(N_BLOCKS, SIZE)


@pytest.fixture
def fields() -> np.ndarray:
    """Return fields that are rough in the first blocks and smooth in the last, far from a touch."""
    x = np.linspace(0.0, 1.0, N_BLOCKS * SIZE)[:, None]
    s = np.linspace(0.0, 0.15, N_MODES)[None]
    whole = 1.0 / (0.02 + np.abs(x - s)) + 3.0 * np.sin(5.0 * x * (1.0 + s))
    return np.asarray(whole.reshape(N_BLOCKS, SIZE, N_MODES))


@pytest.fixture
def loads() -> np.ndarray:
    return np.random.default_rng(2).standard_normal((N_LOADS, N_MODES))


def shown(modes: BlockModes, loads: np.ndarray, level: int = 10**6) -> np.ndarray:
    """Return each load's field with the modes up to a level, (n_loads, n_blocks, size)."""
    out = np.zeros((len(loads), N_BLOCKS, SIZE))
    for b in range(N_BLOCKS):
        rows = np.arange(modes.start[b], modes.start[b + 1])
        rows = rows[modes.level[rows] <= level]
        out[:, b] = loads @ modes.core[rows].T.astype(float) @ modes.space[rows]
    return out


def left(found: np.ndarray, fields: np.ndarray, loads: np.ndarray) -> np.ndarray:
    """Return the relative L2 error of each load."""
    exact = np.einsum("bim,lm->lbi", fields, loads)
    size = np.sqrt((MASS * exact**2).sum(axis=(1, 2)))
    return np.asarray(np.sqrt((MASS * (found - exact) ** 2).sum(axis=(1, 2))) / size)


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).mean()))


@pytest.mark.parametrize("tolerance", [1e-1, 1e-2, 1e-3])
def test_the_tolerance_is_kept_with_no_mode_too_many(
    fields: np.ndarray, loads: np.ndarray, tolerance: float
) -> None:
    sizes = load_sizes(fields, MASS, loads)
    modes = separate_blocks(fields, MASS, loads, sizes, tolerance)
    found = shown(modes, loads)
    assert rms(left(found, fields, loads)) <= 1.01 * tolerance
    # without the weakest kept mode it would not be
    weakest = modes.level.max()
    fewer = shown(modes, loads, weakest - 1)
    assert rms(left(fewer, fields, loads)) > tolerance


def test_rough_blocks_get_more_modes_than_smooth_ones(
    fields: np.ndarray, loads: np.ndarray
) -> None:
    """The total is less than with equal numbers in all blocks."""
    sizes = load_sizes(fields, MASS, loads)
    modes = separate_blocks(fields, MASS, loads, sizes, 1e-3)
    counts = np.diff(modes.start)
    assert counts[0] > 2 * counts[-1]
    mean = int(np.ceil(counts.mean()))
    alike = np.zeros((N_LOADS, N_BLOCKS, SIZE))
    exact = np.einsum("bim,lm->lbi", fields, loads)
    for b in range(N_BLOCKS):
        root = np.sqrt(MASS[b])
        u, s, vt = np.linalg.svd(root * exact[:, b] / sizes[:, None], full_matrices=False)
        alike[:, b] = sizes[:, None] * (u[:, :mean] * s[:mean]) @ vt[:mean] / root
    assert rms(left(shown(modes, loads), fields, loads)) < rms(left(alike, fields, loads))


def test_levels_count_the_modes_of_a_block_in_the_mean(
    fields: np.ndarray, loads: np.ndarray
) -> None:
    sizes = load_sizes(fields, MASS, loads)
    modes = separate_blocks(fields, MASS, loads, sizes, 1e-4)
    errors = []
    for level in range(1, modes.level.max()):
        assert (modes.level <= level).sum() == level * N_BLOCKS
        errors.append(rms(left(shown(modes, loads, level), fields, loads)))
    assert len(errors) >= 3 and errors == sorted(errors, reverse=True)
    for first, end in zip(modes.start[:-1], modes.start[1:], strict=True):
        assert (np.diff(modes.level[first:end]) >= 0).all()  # the strongest first


def test_all_modes_serve_amplitudes_that_no_load_has(fields: np.ndarray) -> None:
    """The kept modes span their whole field: the mean over the loads does not limit them."""
    few = np.random.default_rng(3).standard_normal((2 * N_MODES, N_MODES))
    few[:, 3:] *= 1e-3
    modes = separate_blocks(fields, MASS, few, load_sizes(fields, MASS, few), 1e-9)
    other = np.eye(N_MODES)
    assert left(shown(modes, other), fields, other).max() < 1e-3


def test_nothing_moves_nothing() -> None:
    for shape in ((0, SIZE, N_MODES), (N_BLOCKS, SIZE, 0)):
        empty = np.zeros(shape)
        modes = separate_blocks(empty, MASS[: shape[0]], np.ones((5, shape[2])), np.ones(5), 1e-3)
        assert len(modes.space) == 0 and modes.start.tolist() == [0] * (shape[0] + 1)


def test_blocks_of_points_are_compact_and_full() -> None:
    points = np.random.default_rng(1).uniform(size=(1000, 3)) * [3.0, 2.0, 1.0]
    order = compact_order(points, POINTS)
    assert sorted(order) == list(range(1000))
    blocks = [points[order[i : i + POINTS]] for i in range(0, 1000, POINTS)]
    within = np.mean([block.var(axis=0).sum() for block in blocks])
    assert within < 0.15 * points.var(axis=0).sum()
    assert compact_order(points[:0], POINTS).shape == (0,)


@pytest.mark.long
@pytest.mark.parametrize("history", [False, True])
def test_a_step_shows_the_displacement_of_the_vademecum(
    phantom_vademecum: Vademecum, history: bool
) -> None:
    """Displacement of the patch under a tip, to 0.3 %, with a fifth of its modes per point."""
    v, tip = phantom_vademecum, Tip("patch", 8e-3)
    effects = (SelfWeight(),) if history else ()
    data = prepare(v, (tip,), cloud="volume", effects=effects)
    mass, errors = np.repeat(v.mesh.vertex_volumes, 3), []
    step(data, np.full((1, 3), 1e3))
    rest = data.out.cloud[:, 3:].astype(float).copy()  # it may sag
    for at in palpation(v, tip.offset, 4e-3, 41)[15:26]:
        step(data, at[None].copy())
        state, n = data.state, data.state.n_nodes[0]
        weights = state.weight[0, :n, 0]
        exact = v.displacement(state.nodes[0, :n], weights) @ (-state.force[0] * state.normal[0])
        wrong = (data.out.cloud[:, 3:] - rest).ravel() - exact
        errors.append(np.sqrt((mass * wrong**2).sum() / (mass * exact**2).sum()))
    assert 0.0 < max(errors) < 8e-3
    assert np.mean(errors) < 4e-3
    counts = np.diff(v.field.start[1:], axis=1)
    assert counts.mean() < 0.25 * v.n_modes
