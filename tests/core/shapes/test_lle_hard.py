"""Bases of shapes that leave the weights undecided: equal, nearly equal, in line, few, far away.

With C the local Gram matrix of k neighbours, r the regularisation and d the least distance, the
weights minimise w.Cw + r tr(C) |w|^2 among all that sum to one. Compared with the nearest neighbour
alone, w = e_1, that says

    |w|^2 <= 1 + d^2 / (r tr(C)) <= 1 + 1 / (r k),     w.Cw <= d^2 + r tr(C),

whatever the neighbours are; compared with an exact representation, x = sum_j v_j X_j,

    |w| <= |v|,     w.Cw <= r tr(C) |v|^2,     where w.Cw = |x - sum_j w_j X_j|^2.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.errors import LLEError
from avatar_core.geometry.level_set import distance_in_box, padded_box
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.shapes.barycenter import (
    DEFAULT_REGULARIZATION,
    Barycenter,
    barycenter,
    barycenter_weights,
    convex_weights,
)
from avatar_core.shapes.lle import LLE, embed, estimate_dimension, fit
from tests.core.shapes.test_lle import with_one_more
from tests.helpers.examples import examples

Figure = Callable[[str], None]

EPS = float(np.finfo(float).eps)
NEAR = 1e-5  # a hundredth of a millimetre [m]
TRUSTED = 5e-11  # what rounding may do to the weights of a base, `avatar_core.shapes.lle`


@pytest.fixture(scope="module")
def livers() -> np.ndarray:
    """Signed distances of 12 livers of two kinds of change at some 5,000 points, (12, D) [m]."""
    phantom = phantom_liver(12e-3)
    organs = [shape.moved(phantom) for shape in population(12, seed=3, bend=5e-3)]
    box = padded_box(organs, 14e-3, 20e-3)
    return np.array([distance_in_box(organ, box).values.ravel() for organ in organs])


def sound(found: Barycenter, base: np.ndarray, x: np.ndarray, r: float) -> None:
    """Weights that are weights, bounded as they must be, and a residual that is theirs."""
    w, k = found.weights, len(found.weights)
    assert np.isfinite(w).all()
    assert abs(w.sum() - 1.0) <= 2.0 * k * EPS * found.absolute_sum
    assert w @ w <= (1.0 + 1.0 / (r * k)) * (1.0 + 1e-3)  # 1e-3: rounding of C at r = 1e-12
    rounding = 8.0 * k * EPS * np.abs(base).max() * np.sqrt(base.shape[1]) * found.absolute_sum
    left = np.linalg.norm(x - w @ base[found.neighbors])
    assert found.residual == pytest.approx(left, abs=rounding)
    assert found.hull_distance <= found.distances[0] + rounding


def rows_are_sound(base: LLE, r: float) -> None:
    """The same of the weights of every member that has neighbours."""
    has = len(base) - len(base.repeated) > 1
    assert np.isfinite(base.weights).all()
    sums = base.weight_matrix.sum(axis=1)
    first = base.same_as == np.arange(len(base))
    wanted = np.where(first & (not has), 0.0, 1.0)
    k = base.weights.shape[1]
    np.testing.assert_array_less(
        np.abs(sums - wanted), 2.0 * k * EPS * np.abs(base.weights).sum(axis=1) + EPS
    )
    assert (np.square(base.weights).sum(axis=1) <= (1.0 + 1.0 / (r * k)) * (1.0 + 1e-3)).all()


# --- any base at all --------------------------------------------------------------------------

KINDS = ("scattered", "equal", "near", "in line", "two clusters", "one far away")


def base_of(kind: str, n: int, length: int, seed: int) -> np.ndarray:
    """n vectors of a size of 0.1, as different as the kind allows."""
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
def check_any_base(
    kind: str, n: int, k: int, length: int, r: float, seed: int, single: bool
) -> None:
    base = base_of(kind, n, length, seed)
    rng = np.random.default_rng(seed + 1)
    if single:
        base = base.astype(np.float32).astype(np.float64)
    grown = fit(base[:1], k, regularization=r)
    for row in base[1:]:
        grown = with_one_more(grown, row)
    for one in (fit(base, k, regularization=r), grown):
        rows_are_sound(one, r)
    v = rng.uniform(-1.0, 1.0, n)
    v = v / v.sum() if abs(v.sum()) > 0.1 else np.full(n, 1.0 / n)
    inside, outside = v @ base, 10.0 * rng.standard_normal(length)
    for x in (inside, outside):
        found = barycenter(base, x, k, regularization=r)
        sound(found, base, x, r)
        most = np.sqrt(1.0 + 1.0 / (r * len(found.weights)))
        tally["share"] = max(tally["share"], float(np.linalg.norm(found.weights) / most))
        convex = barycenter(base, x, k, regularization=r, convex=True)
        assert convex.weights.min() >= 0.0
        # the nearest point p of the hull: no neighbour lies on x's side of the plane through p
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


tally = {"share": 0.0}


@pytest.mark.examples
def test_any_base_gives_bounded_weights_that_sum_to_one(figure: Figure) -> None:
    """Fitted, grown or asked for a new point; n = 1, k = 1, k = n, k > n, any regularisation."""
    tally["share"] = 0.0
    check_any_base()
    figure(f"150 bases: |w| up to {tally['share']:.2f} of what the ridge allows")


# --- one by one, on livers --------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 5, 12, 40])
def test_duplicates_change_no_weight(livers: np.ndarray, k: int, figure: Figure) -> None:
    """Scanned twice or three times, in any order: as if each was there once."""
    n = len(livers)
    order = np.random.default_rng(k).permutation([*range(n), 0, 3, 3, n - 1])
    base, clean = fit(livers[order], k), fit(livers, k)
    rows_are_sound(base, DEFAULT_REGULARIZATION)
    assert len(base.repeated) == 4
    carried = np.zeros((n, n))  # weights of equals added up, rows of first members
    for i in np.flatnonzero(base.same_as == np.arange(len(base))):
        np.add.at(carried[order[i]], order, base.weight_matrix[i])
    off = np.abs(carried - clean.weight_matrix).max()
    assert off < TRUSTED * (1.0 if k < n - 1 else 10.0)
    x = 0.3 * livers[2] + 0.5 * livers[3] + 0.2 * livers[7]
    one, other = base.barycenter(x), clean.barycenter(x)
    assert np.array_equal(order[one.neighbors], other.neighbors)
    assert np.array_equal(one.weights, other.weights)
    figure(f"weights moved by {off:.0e}")


def test_near_duplicates_of_a_hundredth_of_a_millimetre(livers: np.ndarray, figure: Figure) -> None:
    """They share a weight; no shape made of them moves by more than they differ."""
    rng = np.random.default_rng(1)
    again = livers[:6] + NEAR * rng.uniform(-1.0, 1.0, (6, livers.shape[1]))
    both = np.vstack([livers, again])
    base, clean = fit(both, 18), fit(livers, 12)
    assert base.repeated == ()
    rows_are_sound(base, DEFAULT_REGULARIZATION)
    rms = NEAR / np.sqrt(3.0)
    worst = 0.0
    for i in range(6):  # each is written by its twin, to the distance between the two
        twin = base.weight_matrix[i, 12 + i]
        assert twin == pytest.approx(1.0, abs=0.01)
        left = np.linalg.norm(livers[i] - base.weight_matrix[i] @ both)
        squared = ((both - livers[i]) ** 2).sum(axis=1)
        assert left**2 <= squared[12 + i] + DEFAULT_REGULARIZATION * squared.sum()
    # among copies even nearer, as exact as from differences, though the Gram matrix is not
    part = 0.1 * (again - livers[:6])
    close = fit(np.vstack([livers[:6], livers[:6] + part, livers[:6] - 0.5 * part]), 2)
    for i in range(18):
        exact = barycenter(close.vectors, close.vectors[i], 2, leave_out=[i])
        np.testing.assert_array_equal(close.neighbors[i], exact.neighbors)
        np.testing.assert_allclose(close.weights[i], exact.weights, rtol=0.0, atol=TRUSTED)
    for _ in range(10):
        v = rng.dirichlet(np.ones(12))
        one, other = base.barycenter(v @ livers), clean.barycenter(v @ livers)
        assert one.absolute_sum < 2.0 * other.absolute_sum
        apart = one.combine(both) - other.combine(livers)
        worst = max(worst, float(np.sqrt(np.mean(apart**2))))
    assert worst < rms
    figure(f"shapes apart by {1e6 * worst:.2g} um, copies by {1e6 * rms:.1f} um")


def test_collinear_anatomies(livers: np.ndarray, figure: Figure) -> None:
    """One parameter: it is found between them and beyond, with small weights, and mapped."""
    t = np.array([0.0, 0.1, 0.3, 0.35, 0.6, 0.8, 1.0])
    line = livers[0] + np.outer(t, livers[1] - livers[0])
    base = fit(line, 6)
    rows_are_sound(base, DEFAULT_REGULARIZATION)
    length = np.linalg.norm(livers[1] - livers[0])
    worst = 0.0
    for wanted in (0.2, 0.5, 0.97, -0.5, 2.0):
        x = livers[0] + wanted * (livers[1] - livers[0])
        found = base.barycenter(x)
        sound(found, line, x, DEFAULT_REGULARIZATION)
        assert found.condition == np.inf
        off = abs(found.weights @ t[found.neighbors] - wanted)
        both = np.vstack([t[found.neighbors], np.ones(6)])
        v = np.linalg.norm(np.linalg.lstsq(both, np.array([wanted, 1.0]))[0])
        ridge = DEFAULT_REGULARIZATION * (found.distances**2).sum()
        assert off * length <= np.sqrt(ridge) * v + 1e-12
        assert np.linalg.norm(found.weights) <= v + 1e-9
        worst = max(worst, off)
    y = embed(base, 1).coordinates[:, 0]
    assert abs(np.corrcoef(y, t)[0, 1]) > 1.0 - 1e-9
    assert estimate_dimension(base).from_local_pca == 1
    figure(f"parameter off by {worst:.0e}")


def test_one_neighbour(livers: np.ndarray, figure: Figure) -> None:
    base = fit(livers, 1)
    nearest = np.linalg.norm(livers[:, None] - livers, axis=2) + np.diag(np.full(12, np.inf))
    assert np.array_equal(base.neighbors[:, 0], nearest.argmin(axis=1))
    assert np.array_equal(base.weights, np.ones((12, 1)))
    found = base.barycenter(livers[4] + NEAR)
    assert found.member is None and found.neighbors.tolist() == [4]
    assert found.residual == pytest.approx(NEAR * np.sqrt(livers.shape[1]), rel=1e-9)
    assert np.array_equal(found.combine(livers), livers[4])
    with pytest.raises(LLEError, match="at least 4 and 2") as refused:
        estimate_dimension(base)
    assert "\n" not in str(refused.value)
    y = embed(base, 2).coordinates
    np.testing.assert_allclose(y.T @ y, 12.0 * np.eye(2), atol=1e-9)
    figure("the nearest, with weight 1")


@pytest.mark.parametrize("k", [11, 12, 13, 1000])
def test_all_neighbours_and_more(livers: np.ndarray, k: int, figure: Figure) -> None:
    """Every other member is used, and the notice says so; an affine map is reproduced."""
    base = fit(livers, k)
    assert base.weights.shape == (12, 11)
    assert base.notices == (
        () if k == 11 else (f"{k} neighbours asked for, 11 used: the base has no more",)
    )
    np.testing.assert_array_equal(base.weights, fit(livers, 11).weights)
    rng = np.random.default_rng(k)
    v = rng.dirichlet(np.ones(12))
    found = base.barycenter(v @ livers)
    assert len(found.weights) == min(k, 12)
    images = livers[:, ::50] * 3.0 + 1.0
    bound = np.sqrt(DEFAULT_REGULARIZATION * (found.distances**2).sum()) * np.linalg.norm(v)
    if k >= 12:
        assert found.residual <= bound
        off = np.abs(found.combine(images) - v @ images).max()
        assert off <= 3.0 * bound
    figure(f"residual {1e3 * found.residual / np.sqrt(livers.shape[1]):.1e} mm")


def test_a_gram_matrix_without_trace(figure: Figure) -> None:
    """Neighbours that all are the point, up to what numbers can hold: equal shares."""
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
    alike = fit([x] * 5, 3)
    assert alike.repeated == (1, 2, 3, 4)
    rows_are_sound(alike, DEFAULT_REGULARIZATION)
    assert alike.barycenter(x).member == 0
    assert alike.barycenter(x + 1.0).weights.tolist() == [1.0]
    with pytest.raises(LLEError, match="different anatomies") as refused:
        embed(alike, 1)
    assert "\n" not in str(refused.value)
    figure("weights 1/k down to a trace of 2e-323")


def test_a_base_of_one(livers: np.ndarray, figure: Figure) -> None:
    base = fit(livers[:1], 10)
    assert base.notices == ("10 neighbours asked for, 0 used: the base has no more",)
    assert np.array_equal(base.weight_matrix, [[0.0]])  # not its own neighbour
    for x in (livers[1], 1e6 * livers[1]):
        found = base.barycenter(x)
        sound(found, livers[:1], x, DEFAULT_REGULARIZATION)
        assert found.weights.tolist() == [1.0] and found.member is None
        assert found.residual == found.hull_distance == found.distances[0]
    assert base.barycenter(livers[0]).member == 0
    for call in (lambda: embed(base, 1), lambda: estimate_dimension(base)):
        with pytest.raises(LLEError) as refused:
            call()
        assert "\n" not in str(refused.value)
    pair = with_one_more(base, livers[1])
    assert np.array_equal(pair.weight_matrix, [[0.0, 1.0], [1.0, 0.0]])
    figure("weight 1, no map")


@pytest.mark.parametrize(
    ("kind", "shift"), [(np.float64, 0.0), (np.float64, 64.0), (np.float32, 0.0)]
)
def test_a_query_equal_to_a_member(
    livers: np.ndarray, kind: type, shift: float, figure: Figure
) -> None:
    """Each one is known again, and no neighbour is taken for it, wherever the zero is."""
    base = fit(livers + shift, 8)
    for i in range(len(livers)):
        found = base.barycenter((livers[i] + shift).astype(kind))
        assert (found.member, found.neighbors[0]) == (i, i)
        assert found.weights.tolist() == [1.0] + 7 * [0.0]
        assert np.array_equal(found.combine(livers), livers[i])
        assert with_one_more(base, (livers[i] + shift).astype(kind)).same_as[-1] == i
        beside = (livers[i] + shift + NEAR).astype(kind)
        assert base.barycenter(beside).member is None
        assert with_one_more(base, beside).repeated == ()
    figure("weight 1 on all 12")


@pytest.mark.parametrize("away", [1.0, 1e3, 1e6, 1e12])
def test_a_query_far_outside(away: float, figure: Figure) -> None:
    """Above the middle of a simplex: the hull distance is the height, the weights stay small."""
    base = 0.1 * np.eye(6, 40)
    x = base.mean(axis=0) + away * np.eye(40)[-1]
    found = barycenter(base, x, 6)
    sound(found, base, x, DEFAULT_REGULARIZATION)
    assert found.hull_distance == pytest.approx(away, rel=1e-7)
    # by symmetry; C is singular but for 0.01 of (away)^2, what is left of that in rounding
    np.testing.assert_allclose(found.weights, 1.0 / 6.0, atol=1e-9)
    # beyond a corner, linear continuation is what the ridge leaves of it
    x = base[0] + away * (base[0] - base[1:].mean(axis=0))
    found = barycenter(base, x, 6)
    sound(found, base, x, DEFAULT_REGULARIZATION)
    bound = np.sqrt(DEFAULT_REGULARIZATION * (found.distances**2).sum())
    exact = np.sqrt((1.0 + away) ** 2 + 5.0 * (away / 5.0) ** 2)
    assert found.residual <= bound * exact * (1.0 + 1e-9)
    figure(f"sum |w| {found.absolute_sum:.3g}, hull distance {found.hull_distance:.3g}")


def test_single_precision_input(livers: np.ndarray, figure: Figure) -> None:
    """A base read as float32 has the weights of the numbers that it holds, in double precision."""
    single = livers.astype(np.float32)
    base, same = fit(single, 8), fit(single.astype(np.float64), 8)
    assert base.weights.dtype == np.float64
    assert np.array_equal(base.weights, same.weights)
    x = (0.4 * livers[1] + 0.6 * livers[5]).astype(np.float32)
    found = barycenter(single, x, 8)
    sound(found, single.astype(np.float64), x, DEFAULT_REGULARIZATION)
    exact = barycenter(single.astype(np.float64), x.astype(np.float64), 8)
    np.testing.assert_array_equal(found.weights, exact.weights)
    off = np.abs(base.weights - fit(livers, 8).weights).max()
    figure(f"weights {off:.0e} from those of double precision")


@pytest.mark.parametrize("convex", [False, True])
def test_translation_and_order_change_nothing(
    livers: np.ndarray, convex: bool, figure: Figure
) -> None:
    """Bit for bit, where the differences of the vectors are exact: on a grid of 2^-40 m."""
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
    base, moved = fit(exact, 9, convex=convex), fit((exact + shift)[order], 9, convex=convex)
    off = np.abs(moved.weight_matrix - base.weight_matrix[np.ix_(order, order)]).max()
    # rounding of the sums about the origin, which is 300 times as far away
    assert off < 1e-8
    figure(f"a point: nothing; a base: {off:.0e}")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda x: np.where(np.arange(len(x)) == 7, np.nan, x), "vector 2 is NaN"),
        (lambda x: x * np.inf, "vector 2 is NaN"),
        (lambda x: x[:-1], "differ in length"),
        (lambda x: x[:1], "differ in length"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_spoilt_member_is_refused(livers, spoil, words, figure) -> None:  # type: ignore[no-untyped-def]
    """By a base, and by a point that is asked of the vectors alone."""
    rows = [row.copy() for row in livers]
    rows[2] = spoil(rows[2])
    for call in (lambda: fit(rows, 5), lambda: barycenter(rows, livers[0] + NEAR, 12)):
        with pytest.raises(LLEError, match=words) as refused:
            call()
        assert "\n" not in str(refused.value)
    figure(str(refused.value))
