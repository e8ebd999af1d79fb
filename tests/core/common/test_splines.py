"""Quadratic B-splines on a grid: reproduced fields, and derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.common.splines import (
    BRICK,
    add_in_bricks,
    cell_at,
    evaluate,
    in_cell,
    on_grid,
    second_derivatives,
)

ORIGIN, SPACING = np.array([0.01, -0.02, 0.03]), 3e-3


def _points(n: int) -> np.ndarray:
    return ORIGIN + SPACING * np.random.default_rng(0).uniform(1.0, 6.0, (n, 3))


def _grid() -> np.ndarray:
    return ORIGIN + SPACING * np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1)


def test_linear_fields_are_exact() -> None:
    slope = np.array([2.0, -3.0, 0.5])
    values, gradient = (_grid() @ slope + 1.0).astype(np.float32), np.zeros(3)
    for p in _points(20):
        assert evaluate(values, ORIGIN, SPACING, p, gradient, 9.0) == pytest.approx(p @ slope + 1.0)
        np.testing.assert_allclose(gradient, slope, rtol=1e-3)


def test_derivatives_are_those_of_the_value() -> None:
    values = np.random.default_rng(1).standard_normal((8, 8, 8)).astype(np.float32)
    h, scratch, hessian = 1e-3 * SPACING, np.zeros(3), np.zeros((3, 3))
    for p in _points(20):
        gradient = np.zeros(3)
        in_cell(values, cell_at(ORIGIN, SPACING, p), gradient)
        second_derivatives(values, cell_at(ORIGIN, SPACING, p), SPACING, hessian)
        for d in range(3):
            step = h * np.eye(3)[d]
            ends, slopes = [], []
            for q in (p + step, p - step):
                ends.append(evaluate(values, ORIGIN, SPACING, q, scratch, 0.0))
                slopes.append(scratch.copy())
            assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(gradient[d], rel=1e-4, abs=0.1)
            change = (slopes[0] - slopes[1]) / (2 * h)
            # the second derivative jumps at cell borders, which a difference may straddle
            np.testing.assert_allclose(change, hessian[d], atol=2e-2 * np.abs(hessian).max())


def test_bricks_are_the_same_field() -> None:
    """The field vanishes in all bricks except two adjacent ones."""
    values = np.zeros((3 * BRICK, BRICK, 2 * BRICK))
    values[BRICK:, :, :BRICK] = np.random.default_rng(2).standard_normal((2 * BRICK, BRICK, BRICK))
    brick = np.array([[[-1, -1]], [[1, -1]], [[0, -1]]], np.int32)
    cut = np.stack([values[2 * BRICK :, :, :BRICK], values[BRICK : 2 * BRICK, :, :BRICK]])
    rng, shape = np.random.default_rng(3), np.array(values.shape)
    for p in ORIGIN + SPACING * rng.uniform(1.0, shape - 2.0, (200, 3)):
        cell, gradient, added = cell_at(ORIGIN, SPACING, p), np.zeros(3), np.ones(3)
        value = in_cell(values, cell, gradient)
        assert add_in_bricks(brick, cut, cell, added) == pytest.approx(value, abs=1e-12)
        np.testing.assert_allclose(added - 1.0, gradient, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, 1.0])
def test_off_the_grid_is_said(bad: float) -> None:
    p = ORIGIN + SPACING * np.array([3.0, bad if not np.isfinite(bad) else bad * 1e3, 3.0])
    gradient = np.ones(3)
    assert not on_grid((8, 8, 8), ORIGIN, SPACING, p)
    assert evaluate(np.zeros((8, 8, 8)), ORIGIN, SPACING, p, gradient, 7.0) == 7.0
    assert not gradient.any()
