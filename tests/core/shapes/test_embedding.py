"""Embedding, dimension and inner products of a base, against mathematics and scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.shapes.lle import LLE, Gram, local_variances


@pytest.fixture(scope="module")
def flat() -> tuple[np.ndarray, np.ndarray]:
    """Draw parameters (150, 4) and points (150, 80) of an affine family."""
    rng = np.random.default_rng(1)
    t = rng.uniform(-1, 1, (150, 4))
    return t, t @ rng.standard_normal((4, 80)) + rng.standard_normal(80)


def swiss_roll(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw parameters (arc, height) and points of a rolled-up sheet in space."""
    rng = np.random.default_rng(0)
    t = 1.5 * np.pi * (1 + 2 * rng.random(n))
    height = 20 * rng.random(n)
    return np.c_[t, height], np.c_[t * np.cos(t), height, t * np.sin(t)]


def explained(target: np.ndarray, coordinates: np.ndarray) -> float:
    """Return the part of target's variance that is an affine function of the coordinates."""
    columns = np.c_[np.ones(len(coordinates)), coordinates]
    rest = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
    return float(1 - rest.var() / target.var())


def test_eigenvalues_are_the_reconstruction_errors_of_the_coordinates(cloud):
    base = LLE(8, 3, regularization=1e-3).fit(cloud)
    y = base.embedding_
    assert np.allclose(y.T @ y, len(cloud) * np.eye(3), atol=1e-9)
    assert np.allclose(y.mean(axis=0), 0.0, atol=1e-9)
    errors = np.sum((y - base.weight_matrix @ y) ** 2, axis=0) / len(cloud)  # Eq. 16
    # one eigenvalue carries the rounding of M, about 1e-15
    assert np.allclose(errors, base.eigenvalues_, atol=1e-13)
    rest = np.eye(60) - base.weight_matrix
    assert np.allclose(np.linalg.eigvalsh(rest.T @ rest)[1:4], base.eigenvalues_, atol=1e-13)


def test_embedding_spans_that_of_scikit_learn(cloud):
    manifold = pytest.importorskip("sklearn.manifold")
    theirs = manifold.LocallyLinearEmbedding(
        n_neighbors=10, n_components=3, reg=1e-3, eigen_solver="dense"
    ).fit_transform(cloud)
    ours = LLE(10, 3, regularization=1e-3).fit_transform(cloud)
    a, b = np.linalg.qr(theirs)[0], np.linalg.qr(ours)[0]
    assert np.linalg.svd(a.T @ b, compute_uv=False).min() > 1 - 1e-9


def test_embedding_of_an_affine_family_is_affine_in_its_parameters(flat):
    t, points = flat
    base = LLE(10, 4, regularization=1e-9).fit(points)
    # regularisation 1e-9 of the trace against local variances of a hundredth of it
    assert explained(t, base.embedding_) > 1 - 1e-6
    # the affine map from parameters to coordinates holds out of sample too
    new = np.array([[0.1, -0.3, 0.5, 0.2], [0.0, 0.6, -0.2, -0.4]])
    matrix = np.linalg.lstsq(np.c_[np.ones(150), t], base.embedding_, rcond=None)[0]
    slope = np.linalg.lstsq(np.c_[np.ones(150), t], points, rcond=None)[0]
    wanted = np.c_[np.ones(2), new]
    assert base.transform(wanted @ slope) == pytest.approx(wanted @ matrix, abs=1e-3)
    assert np.array_equal(base.transform(points), base.embedding_)


def test_swiss_roll_is_unrolled():
    parameters, points = swiss_roll(800)
    found = LLE(8, regularization=1e-2).fit_transform(points)
    order = np.argsort(np.argsort(parameters[:, 0]))
    along = [abs(np.corrcoef(order, np.argsort(np.argsort(c)))[0, 1]) for c in found.T]
    # over 3 seeds 0.998 to 1.000; larger k short-cuts between the layers (0.7)
    assert max(along) > 0.99
    linear = [abs(np.corrcoef(order, np.argsort(np.argsort(c)))[0, 1]) for c in points.T]
    assert max(linear) < 0.6


@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_dimension_of_affine_families(d):
    rng = np.random.default_rng(d)
    points = rng.uniform(-1, 1, (200, d)) @ rng.standard_normal((d, 60))
    found = LLE(12).fit(points).dimension()
    assert (found.from_gap, found.from_local_pca, found.agree) == (d, d, True)
    assert found.notices == ()
    assert found.gap > 100
    assert np.all(np.diff(found.eigenvalues) >= 0)
    assert found.local_variances.sum() == pytest.approx(1.0)


def test_local_variances_find_a_curved_sheet_and_full_noise():
    rolled = LLE(10, regularization=1e-3).fit(swiss_roll(800)[1])
    assert rolled.dimension().from_local_pca == 2
    rng = np.random.default_rng(6)
    noise = LLE(12).fit(rng.standard_normal((200, 40))).dimension()
    assert noise.gap < 3  # no gap stands out
    assert noise.notices[0].startswith("no clear gap")
    assert noise.from_local_pca >= 10


def test_local_variances_equal_those_of_the_singular_values(cloud):
    base = LLE(7).fit(cloud)
    near = cloud[base.neighbors_[11]]
    squared = np.linalg.svd(near - near.mean(axis=0), compute_uv=False)[:6] ** 2
    assert np.allclose(local_variances(base)[11], squared / squared.sum(), atol=1e-12)


def test_inner_products_are_those_about_the_mean_and_grow_about_it(cloud):
    long = np.tile(cloud, 50)  # more values than one block
    first = Gram.of(tuple(long[:-1]))
    assert np.allclose(first.origin, long[:-1].mean(axis=0), atol=1e-14)
    gram = first.grown(tuple(long[:-1]), long[-1])
    difference = long - first.origin
    wanted = difference @ difference.T
    # sums of 1e4 products, each rounded to 1e-16 of the largest
    assert np.allclose(gram.products, wanted, rtol=0, atol=1e-13 * wanted.max())
    squared = np.sum((long[3] - long) ** 2, axis=1)
    assert np.allclose(gram.squared_distances(np.array([3]))[0], squared, atol=1e-12 * wanted.max())


def test_known_inner_products_are_used(cloud):
    base = LLE(8).fit(cloud)
    again = LLE(8).fit(cloud, gram=base.gram_)
    assert again.gram_ is base.gram_
    assert np.array_equal(again.weights_, base.weights_)


def test_the_estimator_keeps_the_manners_of_scikit_learn(cloud):
    base = pytest.importorskip("sklearn.base")
    lle = LLE(8, 3, regularization=1e-3)
    assert base.clone(lle).get_params() == lle.get_params()
    assert not [name for name in vars(lle) if name.endswith("_")]  # before it is fitted
    y = lle.fit_transform(cloud)
    assert y is lle.embedding_ and lle.eigenvalues_.shape == (3,)
    assert np.array_equal(lle.transform(cloud[:5]), y[:5])
    again = lle.set_params(n_components=2).fit(cloud)
    assert again is lle and lle.embedding_.shape == (60, 2)
    np.testing.assert_allclose(lle.embedding_, y[:, :2], atol=1e-9)
    assert repr(LLE(8)).startswith("LLE(n_neighbors=8, n_components=2,")
