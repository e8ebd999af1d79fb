"""One field over regions and blocks, against the fields that it separates."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from avatar_core.reduction.block_field import (
    BLOCK,
    POINTS,
    BlockField,
    Blocks,
    blocks_of,
    separate_field,
)
from avatar_core.reduction.regional import RegionalRule, RegionModes, separate_regions

N, N_POSITIONS, N_SHARED = 300, 24, 2
VOLUMES = np.linspace(0.5, 2.0, N)
REGION = np.repeat([0, 1, 2], N_POSITIONS // 3).astype(np.int32)
SHOWN = np.arange(0, N, 3)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(size=(N, 3))


@pytest.fixture(scope="module")
def blocks(points: np.ndarray) -> Blocks:
    return blocks_of(points, SHOWN)


@pytest.fixture(scope="module")
def shared(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two smooth modes, and their amounts in each load."""
    smooth = np.stack([np.sin(3.0 * points), np.cos(2.0 * points)], axis=2).reshape(3 * N, 2)
    load = np.random.default_rng(1).standard_normal((N_POSITIONS, 3, N_SHARED))
    return smooth, load.astype(np.float32)


@pytest.fixture(scope="module")
def regions(points: np.ndarray) -> list[RegionModes]:
    """Return modes of each load's displacement: bumps near places on a line."""
    places = np.column_stack([np.linspace(0.0, 1.0, N_POSITIONS), np.full((N_POSITIONS, 2), 0.5)])
    bump = np.exp(-40.0 * ((points[:, None] - places) ** 2).sum(axis=2))
    columns = np.einsum("vp,dl->vdpl", bump, np.eye(3)).reshape(3 * N, N_POSITIONS, 3)
    size = np.sqrt(np.einsum("x,xpl->pl", np.repeat(VOLUMES, 3), columns**2))
    rule = RegionalRule(1e-3, 5e-3, 20)
    return separate_regions(REGION, columns, rule, size, np.repeat(VOLUMES, 3))[0]


@pytest.fixture(scope="module")
def field(
    blocks: Blocks, shared: tuple[np.ndarray, np.ndarray], regions: list[RegionModes]
) -> BlockField:
    motion = shared[1].reshape(-1, N_SHARED)
    return separate_field(blocks, VOLUMES, REGION, regions, shared, motion, 1e-4)


@pytest.fixture(scope="module")
def exact(shared: tuple[np.ndarray, np.ndarray], regions: list[RegionModes]) -> np.ndarray:
    """Return the separated columns, shape (3 N, n_positions, 3)."""
    out = np.einsum("xk,plk->xpl", *shared)
    for r, (space, load) in enumerate(regions):
        out[:, r == REGION] += np.einsum("xk,plk->xpl", space, load)
    return out


def far_off(found: np.ndarray, exact: np.ndarray) -> float:
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def test_blocks_hold_each_vertex_once_and_what_is_shown_first(
    blocks: Blocks, points: np.ndarray
) -> None:
    assert len(blocks.vertex) == POINTS * blocks.n_blocks
    np.testing.assert_array_equal(blocks.vertex[blocks.place], np.arange(N))
    assert blocks.that_hold(SHOWN) == -(-len(SHOWN) // POINTS) < blocks.n_blocks
    assert blocks.that_hold(SHOWN[:0]) == 0
    columns = np.random.default_rng(2).standard_normal((3 * N, 4))
    np.testing.assert_array_equal(blocks.at_vertices(blocks.of(columns)), columns)
    empty = blocks.of(columns).reshape(-1, 3, 4)[blocks.vertex < 0]
    assert len(empty) and (empty == 0.0).all()


def test_every_load_moves_what_it_did_before_it_was_separated(
    blocks: Blocks, field: BlockField, exact: np.ndarray
) -> None:
    for j in range(N_POSITIONS):
        found = blocks.at_vertices(field.combined(np.array([j]), np.ones(1)))
        assert far_off(found, exact[:, j]) < 5e-4


def test_forces_in_several_regions_add_up(
    blocks: Blocks, field: BlockField, exact: np.ndarray
) -> None:
    at = np.array([1, 7, 8, 20])
    forces = np.random.default_rng(3).standard_normal((4, 3, 5))
    found = blocks.at_vertices(field.under(at, forces))
    assert far_off(found, np.einsum("xpl,plm->xm", exact[:, at], forces)) < 5e-4


def test_part_0_shows_the_global_modes_alone(
    blocks: Blocks, field: BlockField, shared: tuple[np.ndarray, np.ndarray]
) -> None:
    amplitude = shared[1][5].T
    found = blocks.at_vertices(field.of_part(0, amplitude))
    assert far_off(found, shared[0] @ amplitude) < 1e-2


def test_softer_tissue_moves_more_by_global_modes_that_are_larger(
    blocks: Blocks, field: BlockField, exact: np.ndarray
) -> None:
    soft = field.softened(4.0)
    found = blocks.at_vertices(soft.combined(np.array([9]), np.ones(1)))
    assert far_off(found, 4.0 * exact[:, 9]) < 5e-4
    amplitude = np.ones((N_SHARED, 1))
    np.testing.assert_allclose(
        soft.of_part(0, amplitude), 2.0 * field.of_part(0, amplitude), rtol=1e-5
    )


def test_fewer_amplitudes_show_less(blocks: Blocks, field: BlockField, exact: np.ndarray) -> None:
    errors = []
    for most in (N_SHARED, N_SHARED + 3, field.rank):
        fewer = field.with_most(most)
        assert fewer.rank == most and fewer.count.max() == most
        found = [
            blocks.at_vertices(fewer.combined(np.array([j]), np.ones(1)))
            for j in range(N_POSITIONS)
        ]
        errors.append(far_off(np.stack(found, axis=1), exact))
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_memory_is_that_of_its_arrays(field: BlockField) -> None:
    assert field.space.shape[1] == BLOCK and field.space.dtype == np.int16
    assert field.nbytes == sum(getattr(field, one.name).nbytes for one in fields(field))
