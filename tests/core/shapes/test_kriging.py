"""Weights of ordinary kriging: their sum, members, copies, and vectors of any numbers."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.shapes.weights import kriging


def test_kriging_weights_sum_to_one_and_know_a_member() -> None:
    vectors = np.random.default_rng(0).standard_normal((6, 40))
    outside = kriging(list(vectors), vectors.mean(axis=0) + 0.1, 6)
    assert outside.weights.sum() == pytest.approx(1.0, abs=1e-10)  # the constraint of the system
    member = kriging(list(vectors), vectors[4], 6)
    assert member.member == 4
    assert member.combine(list(vectors)).tobytes() == vectors[4].tobytes()


def test_a_duplicate_in_the_base_does_not_break_kriging() -> None:
    vectors = np.random.default_rng(1).standard_normal((5, 30))
    doubled = np.vstack([vectors, vectors[2]])
    point = vectors.mean(axis=0) + 0.3
    single, double = kriging(list(vectors), point, 5), kriging(list(doubled), point, 6)
    # the twins divide one weight; the system is singular, hence not to rounding
    np.testing.assert_allclose(
        double.combine(list(doubled)), single.combine(list(vectors)), atol=1e-6
    )


def test_vectors_of_whole_numbers_have_the_weights_of_the_same_floats() -> None:
    vectors = np.random.default_rng(0).integers(-3000, 3000, (8, 50)).astype(np.int16)
    point = np.random.default_rng(1).integers(-3000, 3000, 50).astype(np.int16)
    whole, exact = kriging(vectors, point, 8), kriging(vectors.astype(float), point, 8)
    np.testing.assert_allclose(whole.weights, exact.weights, atol=1e-12)
    assert whole.residual == pytest.approx(exact.residual)


def test_weights_and_residual_are_the_same_far_from_the_origin() -> None:
    vectors = np.random.default_rng(0).integers(-30, 30, (8, 50)).astype(float)
    point, far = np.round(vectors.mean(axis=0)) + 1.0, 2.0**30  # sums are exact
    here, there = kriging(vectors, point, 8), kriging(vectors + far, point + far, 8)
    np.testing.assert_allclose(there.weights, here.weights, atol=1e-12)
    assert there.residual == pytest.approx(here.residual, rel=1e-9)
