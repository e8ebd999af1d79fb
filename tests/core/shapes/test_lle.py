"""Weights and growth of a base against mathematics and scikit-learn.

Bases that leave the weights undecided are tested too: equal, nearly equal, in line, few, far away.
With C the local Gram matrix of k neighbors, r the regularisation and d the least distance, the
weights minimise w.Cw + r tr(C) |w|^2 among all that sum to one. Compared with the nearest neighbor
alone, w = e_1, this gives

    |w|^2 <= 1 + d^2 / (r tr(C)) <= 1 + 1 / (r k),     w.Cw <= d^2 + r tr(C),

for any neighbors. Compared with an exact representation, x = sum_j v_j X_j, it gives

    |w| <= |v|,     w.Cw <= r tr(C) |v|^2,     where w.Cw = |x - sum_j w_j X_j|^2.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.optimize import minimize

from avatar_core.errors import LLEError
from avatar_core.geometry.level_set import distance_in_box, padded_box
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.shapes.lle import LLE, Gram
from avatar_core.shapes.weights import (
    DEFAULT_REGULARIZATION,
    Barycenter,
    barycenter,
    barycenter_weights,
    convex_weights,
    local_gram,
)
from tests.helpers.examples import examples

NONE = 1e-12  # nearly no regularisation
EPS = float(np.finfo(float).eps)
NEAR = 1e-5  # a hundredth of a millimetre [m]
TRUSTED = 5e-11  # bound of rounding on the weights of a base, `avatar_core.shapes.lle`


@pytest.fixture(scope="module")
def livers() -> np.ndarray:
    """Return signed distances of 12 livers of two kinds at some 5,000 points, (12, D) [m]."""
    phantom = phantom_liver(12e-3)
    organs = [shape.moved(phantom) for shape in population(12, seed=3, bend=5e-3)]
    box = padded_box(organs, 14e-3, 20e-3)
    return np.array([distance_in_box(organ, box).values.ravel() for organ in organs])


# --- weights ----------------------------------------------------------------------------------


@pytest.mark.parametrize("regularization", [1e-3, 1e-9])
def test_weights_do_not_see_rotation_scale_and_shift(cloud, regularization):
    rng = np.random.default_rng(4)
    turn = np.linalg.qr(rng.standard_normal((200, 200)))[0]
    moved = 7.0 * cloud @ turn + 30 * rng.standard_normal(200)
    one = LLE(8, regularization=regularization).fit(cloud)
    other = LLE(8, regularization=regularization).fit(moved)
    assert np.array_equal(one.neighbors_, other.neighbors_)
    # 1e-15 relative rounding times a condition of up to 1e5 (three dimensions, curved)
    assert np.allclose(one.weights_, other.weights_, atol=1e-9)


def test_point_in_the_affine_hull_is_reproduced_and_so_is_every_affine_map():
    rng = np.random.default_rng(5)
    corners = rng.standard_normal((6, 40))  # in general position: the weights are unique
    wanted = np.array([0.7, -0.4, 0.5, 0.3, 0.2, -0.3])
    found = barycenter(corners, wanted @ corners, 6, regularization=NONE)
    # regularisation times condition (about 10), and cancellation in the small local Gram
    assert np.allclose(found.weights[np.argsort(found.neighbors)], wanted, atol=1e-9)
    # the residual enters the local Gram squared: half the digits of 1e-12 remain
    assert found.residual < 1e-6
    assert found.absolute_sum == pytest.approx(2.4, abs=1e-9)
    assert found.hull_distance > 0.1
    matrix, shift = rng.standard_normal((3, 40)), rng.standard_normal(3)
    images = corners @ matrix.T + shift
    assert np.allclose(found.combine(images), matrix @ (wanted @ corners) + shift, atol=1e-8)


@pytest.mark.parametrize(("k", "regularization"), [(5, 1e-3), (12, 1e-3), (12, 1e-6), (25, 1e-9)])
def test_weights_equal_those_of_scikit_learn(cloud, k, regularization):
    reference = pytest.importorskip("sklearn.manifold._locally_linear")
    theirs = reference.barycenter_kneighbors_graph(cloud, k, reg=regularization).toarray()
    ours = LLE(k, regularization=regularization).fit(cloud).weight_matrix
    assert np.abs(ours - theirs).max() < 1e-8  # the required agreement


def test_a_base_far_from_zero_keeps_its_digits(cloud):
    reference = pytest.importorskip("sklearn.manifold._locally_linear")
    # inner products are 1e8 times the squared distances; clusters 1e4 apart defeat any centring
    far = cloud + 1e4
    far[30:] += 3e4
    theirs = reference.barycenter_kneighbors_graph(far, 8, reg=1e-6).toarray()
    assert np.abs(LLE(8).fit(far).weight_matrix - theirs).max() < 1e-8


def test_condition_of_known_neighborhoods():
    right_angled = barycenter(np.eye(4)[:3], np.zeros(4), 3)
    assert right_angled.condition == pytest.approx(1.0)
    in_line = barycenter(np.array([[1.0, 0], [2, 0], [3, 0]]), np.zeros(2), 3)
    assert in_line.condition == np.inf
    stretched = barycenter(np.diag([1.0, 10.0]), np.zeros(2), 2)
    assert stretched.condition == pytest.approx(100.0)


# --- convex weights and the hull --------------------------------------------------------------


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.2, 0.3, 0.1), 0.0),  # inside the tetrahedron 0, e1, e2, e3
        ((1.0, 1.0, 1.0), 2 / np.sqrt(3)),  # above its slanted face: (3 - 1) / sqrt 3
        ((0.3, 0.2, -0.7), 0.7),  # below a face
        ((4.0, 0.0, 0.0), 3.0),  # beyond a corner
        ((-1.0, -2.0, 0.5), np.sqrt(5)),  # beside an edge
    ],
)
def test_hull_distance_of_a_tetrahedron(point, distance):
    corners = np.vstack([np.zeros(3), np.eye(3)])
    found = barycenter(corners, point, 4, convex=True)
    # the root of the Gram matrix halves the digits: 1e-8
    assert found.hull_distance == pytest.approx(distance, abs=1e-7)
    assert found.residual == found.hull_distance
    assert found.absolute_sum == pytest.approx(1.0)
    assert found.weights.min() >= 0


def test_convex_weights_equal_a_general_optimiser(cloud):
    gram = local_gram(cloud[3], np.delete(cloud, 3, axis=0)[:12])
    sum_to_one = {"type": "eq", "fun": lambda w: w.sum() - 1}
    found = minimize(
        lambda w: w @ gram @ w / np.trace(gram),
        np.full(12, 1 / 12),
        bounds=[(0, None)] * 12,
        constraints=[sum_to_one],
        options={"ftol": 1e-14, "maxiter": 500},
    )
    ours = convex_weights(gram)
    assert ours @ gram @ ours <= found.fun * np.trace(gram) * (1 + 1e-9)
    assert np.allclose(ours, found.x, atol=1e-4)  # where the general optimiser stops


# --- members and duplicates -------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 2, 10, 60])
@pytest.mark.parametrize("convex", [False, True])
def test_member_has_weight_one_on_itself(cloud, k, convex):
    values = [row.astype(np.float32) / 3 for row in cloud]
    values[30][0] = np.nan  # a failed member affects no other
    for i in (0, 17, 59):
        found = barycenter(cloud, cloud[i], k, convex=convex, regularization=1e-3)
        assert (found.member, found.neighbors[0], found.weights[0]) == (i, i, 1.0)
        assert not found.weights[1:].any()
        assert (found.residual, found.hull_distance, found.condition) == (0.0, 0.0, 1.0)
        assert np.array_equal(found.combine(values), values[i])


def test_equal_members_count_once(cloud):
    unique = cloud[:20]
    twice = np.vstack([unique, unique[3], unique[[3, 7]] * (1 + 1e-12)])
    base, clean = LLE(6).fit(twice), LLE(6).fit(unique)
    assert base.repeated == (20, 21, 22)
    assert base.same_as_[20:].tolist() == [3, 3, 7]
    assert np.array_equal(base.neighbors_[:20], clean.neighbors_)
    assert np.allclose(base.weights_[:20], clean.weights_, atol=1e-12)
    assert np.array_equal(base.weight_matrix[20:], np.eye(23)[[3, 3, 7]])
    assert "member 20 equals member 3" in base.notices
    coordinates = base.embedding_
    assert np.allclose(coordinates[20:], coordinates[[3, 3, 7]], atol=1e-9)
    query = base.barycenter(unique[3])
    assert query.member == 3
    new = 0.5 * (unique[3] + unique[5])
    assert np.array_equal(base.barycenter(new).weights, clean.barycenter(new).weights)


# --- bad requests -----------------------------------------------------------------------------


def test_members_left_out_have_no_weight(cloud):
    found = barycenter(cloud, cloud[4], 5, leave_out=(4, 7))
    assert found.member is None
    assert not {4, 7} & set(found.neighbors.tolist())


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda x: LLE(3).transform(x), "call fit first"),
        (lambda x: LLE(3).set_params(k=4), "no parameter 'k'; choose n_neighbors"),
        (lambda x: LLE(3).fit([]), "empty; add"),
        (lambda x: barycenter([], x[0], 3), "empty; add"),
        (lambda x: LLE(0).fit(x), "choose at least 1"),
        (lambda x: barycenter(x, x[0], -2), "choose at least 1"),
        (lambda x: barycenter(x, x[0] * np.nan, 3), "NaN or infinite"),
        (lambda x: LLE(3).fit(np.vstack([x, x[:1] * np.inf])), "vector 60 is NaN"),
        (lambda x: barycenter(np.vstack([x, x[:1] * np.nan]), x[0] + 1, 60), "vector 60 is NaN"),
        (lambda x: LLE(3).fit(x).barycenter(x[0] / 0.0), "NaN or infinite"),
        (lambda x: LLE(1).fit([x[0], x[1][:-1]]), "differ in length"),
        (lambda x: barycenter([x[0], x[1][:1]], x[2], 2), "differ in length"),
        (lambda x: LLE(3).fit(x).barycenter(x[0][:-1]), "grid of the base"),
        (lambda x: LLE(3).fit(x, gram=Gram.of(x[:4])), "compute it again"),
        (lambda x: LLE(3, regularization=0.0).fit(x), "regularisation 0"),
        (lambda x: barycenter(x, x[0], 3, regularization=np.nan), "regularisation nan"),
        (lambda x: barycenter(x[:2], x[5], 3, leave_out=(0, 1)), "leave out fewer"),
        (lambda x: LLE(5, 0).fit_transform(x), "0 dimension"),
        (lambda x: LLE(5).fit(x).spectrum(60), "60 dimension"),
        (lambda x: LLE(5).fit(x[:3]).dimension(), "at least 4"),
        (lambda x: LLE(1).fit(x).dimension(), "at least 4 and 2"),
        (lambda x: LLE(10, 1).fit_transform(x[:1]), "add some"),
        (lambda x: LLE(3, 1).fit_transform([x[0]] * 5), "different anatomies"),
        (lambda x: LLE(10).fit(x[:1]).dimension(), "from 1 different anatomies"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
def test_bad_requests_name_cause_and_remedy(cloud, call, words):
    with pytest.raises(LLEError, match=words) as caught:
        call(cloud)
    assert "\n" not in str(caught.value)


# --- growth -----------------------------------------------------------------------------------


def with_one_more(base: LLE, point: np.ndarray) -> LLE:
    """Grow a base as an atlas does: one more row of inner products, about the same origin."""
    return LLE(base.n_neighbors, regularization=base.regularization).fit(
        (*base.vectors_, point), gram=base.gram_.grown(base.vectors_, point)
    )


def grown(points: np.ndarray, start: int, k: int, **options: float) -> LLE:
    base = LLE(k, **options).fit(points[:start])
    for point in points[start:]:
        base = with_one_more(base, point)
    return base


@pytest.mark.parametrize(
    ("start", "k", "regularization"), [(40, 8, 1e-3), (40, 12, 1e-6), (1, 6, 1e-6), (3, 59, 1e-6)]
)
def test_base_grown_one_by_one_equals_the_batch(cloud, start, k, regularization):
    one_by_one = grown(cloud, start, k, regularization=regularization)
    batch = LLE(k, regularization=regularization).fit(cloud)
    assert np.array_equal(one_by_one.neighbors_, batch.neighbors_)
    assert np.abs(one_by_one.weights_ - batch.weights_).max() < 1e-10  # the required agreement
    a, b = (np.linalg.qr(base.embedding_)[0] for base in (one_by_one, batch))
    # singular values 1: the same subspace, so the same map up to sign and rotation
    assert np.linalg.svd(a.T @ b, compute_uv=False).min() > 1 - 1e-6


def test_base_with_equals_grows_like_the_batch(cloud):
    points = np.vstack([cloud[:12], cloud[4], cloud[12:20], cloud[15]])
    one_by_one, batch = grown(points, 2, 5), LLE(5).fit(points)
    assert one_by_one.repeated == batch.repeated == (12, 21)
    assert np.abs(one_by_one.weight_matrix - batch.weight_matrix).max() < 1e-10


# --- bases that leave the weights undecided ------------------------------------------------------


def sound(found: Barycenter, base: np.ndarray, x: np.ndarray, r: float) -> None:
    """Check that weights sum to one and are bounded, and that the residual is theirs."""
    w, k = found.weights, len(found.weights)
    assert np.isfinite(w).all()
    assert abs(w.sum() - 1.0) <= 2.0 * k * EPS * found.absolute_sum
    assert w @ w <= (1.0 + 1.0 / (r * k)) * (1.0 + 1e-3)  # 1e-3: rounding of C at r = 1e-12
    largest = max(np.abs(base).max(), np.abs(x).max())  # x (1 - sum w) is the rounding of the sum
    rounding = 8.0 * k * EPS * largest * np.sqrt(base.shape[1]) * found.absolute_sum
    left = np.linalg.norm(x - w @ base[found.neighbors])
    assert found.residual == pytest.approx(left, abs=rounding)
    assert found.hull_distance <= found.distances[0] + rounding


def rows_are_sound(base: LLE, r: float) -> None:
    """Check the weights of every member that has neighbors as :func:`sound` does."""
    has = len(base.vectors_) - len(base.repeated) > 1
    assert np.isfinite(base.weights_).all()
    sums = base.weight_matrix.sum(axis=1)
    first = base.same_as_ == np.arange(len(base.vectors_))
    wanted = np.where(first & (not has), 0.0, 1.0)
    k = base.weights_.shape[1]
    np.testing.assert_array_less(
        np.abs(sums - wanted), 2.0 * k * EPS * np.abs(base.weights_).sum(axis=1) + EPS
    )
    assert (np.square(base.weights_).sum(axis=1) <= (1.0 + 1.0 / (r * k)) * (1.0 + 1e-3)).all()


# --- any base at all --------------------------------------------------------------------------

KINDS = ("scattered", "equal", "near", "in line", "two clusters", "one far away")


def base_of(kind: str, n: int, length: int, seed: int) -> np.ndarray:
    """Draw n vectors of a size of 0.1, as different as the kind allows."""
    rng = np.random.default_rng(seed)
    base = rng.standard_normal((n, length))
    if kind == "equal":
        base = base[rng.integers(0, n, n)]
    elif kind == "near":
        base = base[rng.integers(0, n, n)] + 10.0 * NEAR * base
    elif kind == "in line":
        base = base[0] + np.outer(rng.standard_normal(n), base[-1])
    elif kind == "two clusters":
        base[n // 2 :] += 1e4
    elif kind == "one far away":
        base[-1] += 1e4
    return 0.1 * base


@examples(150)
@given(
    kind=st.sampled_from(KINDS),
    n=st.integers(1, 12),
    k=st.integers(1, 15),
    length=st.sampled_from([1, 2, 40]),
    r=st.sampled_from([1e-12, 1e-9, 1e-6, 1e-3, 1.0]),
    seed=st.integers(0, 10**6),
    single=st.booleans(),
)
@example(kind="scattered", n=10, k=5, length=40, r=1e-6, seed=0, single=True)
@example(kind="scattered", n=1, k=10, length=40, r=1e-6, seed=0, single=False)
@example(kind="near", n=12, k=4, length=2, r=1e-6, seed=0, single=False)
@example(kind="in line", n=7, k=6, length=40, r=1e-6, seed=0, single=False)
@example(kind="one far away", n=6, k=6, length=40, r=1e-6, seed=0, single=False)
def test_any_base_gives_bounded_weights_that_sum_to_one(
    kind: str, n: int, k: int, length: int, r: float, seed: int, single: bool
) -> None:
    """Fitted, grown or queried for a new point; n = 1, k = 1, k = n, k > n, any regularisation."""
    base = base_of(kind, n, length, seed)
    rng = np.random.default_rng(seed + 1)
    if single:
        read = base.astype(np.float32)
        base = read.astype(np.float64)
        held = LLE(k, regularization=r).fit(read).weights_
        assert held.dtype == np.float64
        assert np.array_equal(held, LLE(k, regularization=r).fit(base).weights_)
    grown = LLE(k, regularization=r).fit(base[:1])
    for row in base[1:]:
        grown = with_one_more(grown, row)
    for one in (LLE(k, regularization=r).fit(base), grown):
        rows_are_sound(one, r)
    v = rng.uniform(-1.0, 1.0, n)
    v = v / v.sum() if abs(v.sum()) > 0.1 else np.full(n, 1.0 / n)
    inside, outside = v @ base, 10.0 * rng.standard_normal(length)
    for x in (inside, outside):
        found = barycenter(base, x, k, regularization=r)
        sound(found, base, x, r)
        convex = barycenter(base, x, k, regularization=r, convex=True)
        assert convex.weights.min() >= 0.0
        # the nearest point p of the hull: no neighbor lies on x's side of the plane through p
        p = convex.weights @ base[convex.neighbors]
        beyond = (base[convex.neighbors] - p) @ (x - p)
        assert beyond.max() <= 1e-6 * max(convex.distances) ** 2
    whole = barycenter(base, inside, n, regularization=r)
    trace = float((whole.distances**2).sum())
    rounding = 100.0 * n * EPS * np.abs(base).max() * np.sqrt(length) * whole.absolute_sum
    if whole.member is None:
        assert whole.residual <= np.sqrt(r * trace) * np.linalg.norm(v) + rounding
    for i in range(n):
        found = barycenter(base, base[i].astype(np.float32), k, regularization=r)
        sound(found, base, base[i].astype(np.float32), r)
        exact = barycenter(base, base[i], k, regularization=r)
        assert (exact.member, exact.weights[0], exact.residual) == (
            np.flatnonzero((base == base[i]).all(axis=1))[0],
            1.0,
            0.0,
        )


# --- one by one, on livers --------------------------------------------------------------------


def test_near_duplicates_of_a_hundredth_of_a_millimetre(livers: np.ndarray) -> None:
    """Their weights are divided; no shape made of them moves by more than they differ."""
    rng = np.random.default_rng(1)
    again = livers[:6] + NEAR * rng.uniform(-1.0, 1.0, (6, livers.shape[1]))
    both = np.vstack([livers, again])
    base, clean = LLE(18).fit(both), LLE(12).fit(livers)
    assert base.repeated == ()
    rows_are_sound(base, DEFAULT_REGULARIZATION)
    rms = NEAR / np.sqrt(3.0)
    for i in range(6):  # each is represented by its twin, to the distance between the two
        twin = base.weight_matrix[i, 12 + i]
        assert twin == pytest.approx(1.0, abs=0.01)
        left = np.linalg.norm(livers[i] - base.weight_matrix[i] @ both)
        squared = ((both - livers[i]) ** 2).sum(axis=1)
        assert left**2 <= squared[12 + i] + DEFAULT_REGULARIZATION * squared.sum()
    # among copies even nearer, as exact as from differences, though the Gram matrix is not
    part = 0.1 * (again - livers[:6])
    close = LLE(2).fit(np.vstack([livers[:6], livers[:6] + part, livers[:6] - 0.5 * part]))
    for i in range(18):
        exact = barycenter(close.vectors_, close.vectors_[i], 2, leave_out=[i])
        np.testing.assert_array_equal(close.neighbors_[i], exact.neighbors)
        np.testing.assert_allclose(close.weights_[i], exact.weights, rtol=0.0, atol=TRUSTED)
    for _ in range(10):
        v = rng.dirichlet(np.ones(12))
        one, other = base.barycenter(v @ livers), clean.barycenter(v @ livers)
        assert one.absolute_sum < 2.0 * other.absolute_sum
        apart = one.combine(both) - other.combine(livers)
        assert np.sqrt(np.mean(apart**2)) < rms


def test_one_neighbor(livers: np.ndarray) -> None:
    base = LLE(1).fit(livers)
    nearest = np.linalg.norm(livers[:, None] - livers, axis=2) + np.diag(np.full(12, np.inf))
    assert np.array_equal(base.neighbors_[:, 0], nearest.argmin(axis=1))
    assert np.array_equal(base.weights_, np.ones((12, 1)))
    found = base.barycenter(livers[4] + NEAR)
    assert found.member is None and found.neighbors.tolist() == [4]
    assert found.residual == pytest.approx(NEAR * np.sqrt(livers.shape[1]), rel=1e-9)
    assert np.array_equal(found.combine(livers), livers[4])
    y = base.embedding_
    np.testing.assert_allclose(y.T @ y, 12.0 * np.eye(2), atol=1e-9)


@pytest.mark.parametrize("k", [11, 12, 13, 1000])
def test_all_neighbors_and_more(livers: np.ndarray, k: int) -> None:
    """Every other member is used, and the notice says so."""
    base = LLE(k).fit(livers)
    assert base.weights_.shape == (12, 11)
    notice = f"{k} neighbors asked for, {{}} used: the base has no more"
    assert base.notices == ((notice.format(11),) if k > 11 else ())
    np.testing.assert_array_equal(base.weights_, LLE(11).fit(livers).weights_)
    rng = np.random.default_rng(k)
    v = rng.dirichlet(np.ones(12))
    found = base.barycenter(v @ livers)
    assert len(found.weights) == min(k, 12)
    assert found.notices == ((notice.format(12),) if k > 12 else ())


def test_a_gram_matrix_without_trace() -> None:
    """All neighbors equal the point, up to floating-point range: equal weights."""
    for scale in (0.0, 5e-324, 1e-310, 1e-200):
        gram = scale * np.ones((4, 4))
        for r in (1e-12, 1e-6, 1.0):
            weights = barycenter_weights(gram, r)
            np.testing.assert_allclose(weights, 0.25, rtol=1e-3)  # eps / r
        stacked = barycenter_weights(np.stack([gram, np.eye(4)]), 1e-6)
        np.testing.assert_allclose(stacked[1], 0.25, rtol=1e-12)
        shares = convex_weights(gram)
        assert shares.min() >= 0.0 and shares.sum() == pytest.approx(1.0)
    x = np.full(40, 0.1)
    alike = LLE(3).fit([x] * 5)
    assert alike.repeated == (1, 2, 3, 4)
    rows_are_sound(alike, DEFAULT_REGULARIZATION)
    assert alike.barycenter(x).member == 0
    assert alike.barycenter(x + 1.0).weights.tolist() == [1.0]


@pytest.mark.parametrize(
    ("kind", "shift"), [(np.float64, 0.0), (np.float64, 64.0), (np.float32, 0.0)]
)
def test_a_query_equal_to_a_member(livers: np.ndarray, kind: type, shift: float) -> None:
    """Each member is recognised, and no neighbor is mistaken for it, whatever the origin."""
    base = LLE(8).fit(livers + shift)
    for i in range(len(livers)):
        found = base.barycenter((livers[i] + shift).astype(kind))
        assert (found.member, found.neighbors[0]) == (i, i)
        assert found.weights.tolist() == [1.0] + 7 * [0.0]
        assert np.array_equal(found.combine(livers), livers[i])
        assert with_one_more(base, (livers[i] + shift).astype(kind)).same_as_[-1] == i
        beside = (livers[i] + shift + NEAR).astype(kind)
        assert base.barycenter(beside).member is None
        assert with_one_more(base, beside).repeated == ()


@pytest.mark.parametrize("convex", [False, True])
def test_translation_and_order_change_nothing(livers: np.ndarray, convex: bool) -> None:
    """Bit for bit, if the differences of the vectors are exact: on a grid of 2^-40 m."""
    exact = np.round(livers * 2.0**40) / 2.0**40
    x = np.round(exact[:4].mean(axis=0) * 2.0**40) / 2.0**40
    shift = np.round(np.random.default_rng(0).uniform(-8.0, 8.0, exact.shape[1]) * 2.0**8) / 2.0**8
    order = np.random.default_rng(1).permutation(12)
    one = barycenter(exact, x, 9, convex=convex)
    for other, number in (
        (barycenter(exact + shift, x + shift, 9, convex=convex), np.arange(12)),
        (barycenter(exact[order], x, 9, convex=convex), order),
    ):
        assert np.array_equal(number[other.neighbors], one.neighbors)
        assert np.array_equal(other.weights, one.weights)
    base, moved = (
        LLE(9, convex=convex).fit(exact),
        LLE(9, convex=convex).fit((exact + shift)[order]),
    )
    if convex:
        assert base.weights_.min() >= 0.0
    off = np.abs(moved.weight_matrix - base.weight_matrix[np.ix_(order, order)]).max()
    # rounding of the sums about the origin, which is 300 times as far away
    assert off < 1e-8
