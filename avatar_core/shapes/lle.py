"""Locally linear embedding (LLE) of a base of shapes.

:func:`fit` computes the weights, :func:`embed` the coordinates. The embedding follows Eq. 16 of
Gonzalez, Cueto & Chinesta (2015) with M = (I - W)^T (I - W); the last term of the matrix printed
there has the wrong sign (Roweis & Saul 2000, Science 290:2323).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import LLEError
from avatar_core.shapes.barycenter import (
    DEFAULT_REGULARIZATION,
    SAME,
    Barycenter,
    Vectors,
    barycenter,
    barycenter_weights,
    convex_weights,
    local_gram,
    require_regularization,
    truncation,
)

BLOCK = 8192  # values of each vector per block of the Gram matrix: the blocks stay in cache
ROUNDING = 4 * float(np.finfo(float).eps)  # of an inner product, relative to the lengths
TRUSTED = 5e-11  # if rounding may change weights by more, they are solved from differences
CLEAR_GAP = 3.0  # ratio of neighbouring eigenvalues from which a spectral gap is clear
LOCAL_VARIANCE = 0.99  # part of the variance that the counted principal components explain


@dataclass(frozen=True, eq=False)
class Gram:
    """Inner products of a base about a fixed origin, from which all distances follow.

    Attributes
    ----------
    origin : ndarray, shape (D,)
        The mean of the first members, which keeps the products and their rounding small; it does
        not move when the base grows.
    products : ndarray, shape (n, n)
        G_ij = (X_i - o) . (X_j - o).
    """

    origin: FloatArray
    products: FloatArray

    @classmethod
    def of(cls, vectors: Vectors) -> Gram:
        """Return all products of n vectors of shape (D,), summed over blocks of values."""
        n, length = len(vectors), len(vectors[0])
        origin, products = np.empty(length), np.zeros((n, n))
        for start in range(0, length, BLOCK):
            part = slice(start, start + BLOCK)
            block = np.stack([vector[part] for vector in vectors])
            origin[part] = block.mean(axis=0)
            block -= origin[part]
            products += block @ block.T
        return cls(origin, products)

    @property
    def squared_lengths(self) -> FloatArray:
        """|X_i - o|^2, shape (n,)."""
        return np.diag(self.products)

    def squared_distances(self, rows: IntArray) -> FloatArray:
        """Return |X_i - X_j|^2 for some i and all j, shape (len(rows), n)."""
        lengths = self.squared_lengths
        return np.maximum(lengths[rows, None] + lengths - 2 * self.products[rows], 0.0)

    def grown(self, vectors: Vectors, point: FloatArray) -> Gram:
        """Return the matrix with one more row, for a point appended to the vectors."""
        shifted = point - self.origin
        row = np.array([(vector - self.origin) @ shifted for vector in vectors])
        corner = np.array([[shifted @ shifted]])
        return Gram(self.origin, np.block([[self.products, row[:, None]], [row[None, :], corner]]))


@dataclass(frozen=True, eq=False)
class LLE:
    """A base of shapes with the weights of each in terms of the others.

    Attributes
    ----------
    vectors : tuple[ndarray, ...]
        n arrays of shape (D,).
    gram : Gram
        Their inner products.
    same_as : ndarray of int, shape (n,)
        Number of the first member equal to each, mostly its own.
    neighbors : ndarray of int, shape (n, k)
        Nearest first; never the member itself or its equals.
    weights : ndarray
        Shape (n, k); a repeated member has weight 1 on the first one equal to it.
    n_neighbors, regularization, convex : int
        As requested; see `barycenter`.
    """

    vectors: tuple[FloatArray, ...]
    gram: Gram
    same_as: IntArray
    neighbors: IntArray
    weights: FloatArray
    n_neighbors: int
    regularization: float
    convex: bool

    def __len__(self) -> int:
        return len(self.vectors)

    @property
    def repeated(self) -> tuple[int, ...]:
        """Members equal to an earlier one; they are not used as neighbours."""
        return tuple(int(i) for i in np.flatnonzero(self.same_as != np.arange(len(self))))

    @property
    def notices(self) -> tuple[str, ...]:
        """How the result differs from the request, one line each."""
        different = len(self) - len(self.repeated)
        notices = [f"member {i} equals member {self.same_as[i]}" for i in self.repeated]
        if self.n_neighbors >= different:
            notices.append(truncation(self.n_neighbors, different - 1))
        return tuple(notices)

    @cached_property
    def weight_matrix(self) -> FloatArray:
        """W, shape (n, n); rows sum to one."""
        matrix = np.zeros((len(self), len(self)))
        np.add.at(matrix, (np.arange(len(self))[:, None], self.neighbors), self.weights)
        return matrix

    def barycenter(self, point: ArrayLike, leave_out: Collection[int] = ()) -> Barycenter:
        """Weights of a new point, with the settings of the base; equal members count once."""
        return barycenter(
            self.vectors,
            point,
            self.n_neighbors,
            regularization=self.regularization,
            convex=self.convex,
            leave_out={*leave_out, *self.repeated},
        )


def fit(
    vectors: Sequence[ArrayLike] | FloatArray,
    n_neighbors: int,
    *,
    regularization: float = DEFAULT_REGULARIZATION,
    convex: bool = False,
    gram: Gram | None = None,
) -> LLE:
    """Return the weights of every member of a base in terms of its neighbours (Eq. 15).

    Raises LLEError if the base is empty, k <= 0, a value is not finite or lengths differ.

    Parameters
    ----------
    vectors : Sequence[array_like] or ndarray
        n arrays of shape (D,), not copied; an array of shape (n, D) will do.
    n_neighbors : int
        k, neighbours of each member.
    regularization : float
        Part of the trace added to the diagonal of each local Gram matrix.
    convex : bool
        Non-negative weights; regularization is then not used.
    gram : Gram or None
        Their inner products, if known.
    """
    rows = tuple(np.asarray(v, dtype=np.float64) for v in vectors)
    if not rows:
        raise LLEError("lle: the base is empty; add at least one anatomy")
    if n_neighbors <= 0:
        raise LLEError(f"lle: {n_neighbors} neighbours asked for; choose at least 1")
    require_regularization(regularization)
    if any(row.shape != rows[0].shape or row.ndim != 1 for row in rows):
        raise LLEError("lle: the vectors differ in length; compute all on one grid")
    gram = Gram.of(rows) if gram is None else gram
    if gram.products.shape != (len(rows), len(rows)) or gram.origin.shape != rows[0].shape:
        raise LLEError(
            f"lle: the Gram matrix of {len(gram.products)} vectors of {len(gram.origin)} values "
            f"does not fit {len(rows)} of {len(rows[0])}; compute it again"
        )
    if not np.isfinite(gram.products).all():
        bad = next((i for i, row in enumerate(rows) if not np.isfinite(row).all()), 0)
        raise LLEError(f"lle: vector {bad} is NaN or infinite; compute its distances again")
    same_as = np.zeros(1, dtype=np.int64)
    for i in range(1, len(rows)):
        same_as = np.append(same_as, _first_equal(gram, i, same_as))
    empty = (np.zeros((len(rows), 0), dtype=np.int64), np.zeros((len(rows), 0)))
    base = LLE(rows, gram, same_as, *empty, n_neighbors, regularization, convex)
    return _with_weights(base)


def _first_equal(gram: Gram, i: int, same_as: IntArray) -> int:
    """Return the number of the first member equal to member i; i if there is none before it.

    same_as : ndarray of int, shape (i,), of the members before it
    """
    lengths = np.maximum(gram.squared_lengths[:i], gram.squared_lengths[i])
    # if all vectors are equal, their lengths about the rounded origin are rounding, too
    noise = ROUNDING**2 * (gram.origin @ gram.origin)
    squared = gram.squared_distances(np.array([i]))[0, :i]
    hits = np.flatnonzero((squared <= SAME**2 * lengths + noise) & (same_as == np.arange(i)))
    return int(hits[0]) if len(hits) else i


def _with_weights(base: LLE) -> LLE:
    """Return the base with the neighbours and weights of every member."""
    n = len(base)
    is_first = base.same_as == np.arange(n)
    first, again = np.flatnonzero(is_first), np.flatnonzero(~is_first)
    n_used = min(base.n_neighbors, len(first) - 1)
    k = max(n_used, 1)  # one column for repeated members, even if no two members differ
    neighbors, weights = np.zeros((n, k), dtype=np.int64), np.zeros((n, k))
    neighbors[again] = base.same_as[again, None]
    weights[again] = np.eye(1, k)
    if n_used > 0:
        neighbors[first] = _nearest(base, first, k)
        weights[first] = _row_weights(base, first, neighbors[first])
    return replace(base, neighbors=neighbors, weights=weights)


def _nearest(base: LLE, rows: IntArray, k: int) -> IntArray:
    """Return the k nearest others, repeated members left out; ties go to the lower number."""
    squared = base.gram.squared_distances(rows)
    squared[:, list(base.repeated)] = np.inf
    squared[np.arange(len(rows)), rows] = np.inf
    return np.argsort(squared, axis=1, kind="stable")[:, :k]


def _row_weights(base: LLE, rows: IntArray, neighbors: IntArray) -> FloatArray:
    """Return weights of members from the Gram matrix, or from differences where it loses digits."""
    products, lengths = base.gram.products, base.gram.squared_lengths
    cross = products[rows[:, None], neighbors]
    local = products[neighbors[:, :, None], neighbors[:, None, :]]
    local = local - cross[:, :, None] - cross[:, None, :] + lengths[rows, None, None]
    for i in _imprecise(local, np.maximum(lengths[rows], lengths[neighbors].max(axis=1)), base):
        local[i] = local_gram(base.vectors[rows[i]], [base.vectors[j] for j in neighbors[i]])
    if base.convex:
        return np.array([convex_weights(one) for one in local])
    return barycenter_weights(local, base.regularization)


def _imprecise(local: FloatArray, lengths: FloatArray, base: LLE) -> IntArray:
    """Neighbourhoods where rounding of the Gram matrix may change the weights by more than TRUSTED.

    Estimated as the rounding eps |X|^2 over the smallest eigenvalue, which is at least r tr(C).
    """
    ridge = base.regularization * np.trace(local, axis1=1, axis2=2)
    rounding = ROUNDING * lengths
    suspects = np.flatnonzero(rounding > TRUSTED * ridge)
    least = np.maximum(np.linalg.eigvalsh(local[suspects])[:, 0], 0.0) + ridge[suspects]
    return suspects[rounding[suspects] > TRUSTED * least]


# --- embedding --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Embedding:
    """Low-dimensional coordinates of a base.

    Attributes
    ----------
    coordinates : ndarray
        Y, shape (n, d), zero mean, Y^T Y = n I.
    eigenvalues : ndarray, shape (d,)
        The lowest of M, ascending, without that of the constant.
    """

    coordinates: FloatArray
    eigenvalues: FloatArray

    def of(self, point: Barycenter) -> FloatArray:
        """Return the coordinates of a point that is not in the base, sum_j w_j Y_j, shape (d,)."""
        return point.weights @ self.coordinates[point.neighbors]


@dataclass(frozen=True, eq=False)
class Dimension:
    """Estimates of how many parameters the shapes of a base depend on.

    Attributes
    ----------
    from_gap : int
        Number of eigenvalues of M below its largest spectral gap.
    gap : float
        Ratio of the two eigenvalues at the gap; near 1 the spectrum shows no dimension.
    from_local_pca : int
        Principal components for 99 % of the variance of a neighbourhood, median.
    eigenvalues : ndarray
        The lowest of M, ascending.
    local_variances : ndarray, shape (k - 1,)
        Mean fraction of the variance, descending.
    """

    from_gap: int
    gap: float
    from_local_pca: int
    eigenvalues: FloatArray
    local_variances: FloatArray

    @property
    def agree(self) -> bool:
        """Whether both estimates agree."""
        return self.from_gap == self.from_local_pca

    @property
    def notices(self) -> tuple[str, ...]:
        """Why the estimates should not be trusted, one line each."""
        lines = []
        if self.gap < CLEAR_GAP:
            lines.append(
                f"no clear gap in the spectrum: the largest ratio is {self.gap:.2g}, after "
                f"{self.from_gap}; add anatomies, or choose another number of neighbours"
            )
        if not self.agree:
            lines.append(
                f"the spectral gap gives {self.from_gap} dimension(s), local PCA "
                f"{self.from_local_pca}"
            )
        return tuple(lines)


def spectrum(base: LLE, n_values: int) -> tuple[FloatArray, FloatArray]:
    """Lowest eigenvalues and eigenvectors of M = (I - W)^T (I - W) (Eq. 16), constant left out.

    Returns ndarrays of shape (n_values,) and (n, n_values).

    Raises LLEError unless the base has more different members than values.
    """
    n, n_different = len(base), len(base) - len(base.repeated)
    if not 1 <= n_values < n_different:
        raise LLEError(
            f"lle: {n_values} dimension(s) of {n_different} different anatomies; choose 1 to "
            "fewer than there are anatomies, or add some"
        )
    rest = np.eye(n) - base.weight_matrix
    matrix = rest.T @ rest
    # the constant vector has eigenvalue zero: shifted, it cannot mix with other small ones
    matrix += np.trace(matrix) / n
    values, vectors = eigh(matrix, subset_by_index=[0, n_values - 1])
    return np.maximum(values, 0.0), vectors


def embed(base: LLE, n_components: int) -> Embedding:
    """Return coordinates that the weights reconstruct best (Eq. 16): min |Y - W Y|^2, Y^T Y = n I.

    Raises LLEError unless there are more different anatomies than components.
    """
    values, vectors = spectrum(base, n_components)
    return Embedding(vectors * np.sqrt(len(base)), values)


def estimate_dimension(base: LLE, n_values: int = 20) -> Dimension:
    """Return dimension from the gap in the spectrum of M (Polito & Perona 2001) and from local PCA.

    Neither can exceed the number of neighbours minus one. ``notices`` say if
    they should not be trusted.

    Raises LLEError if there are fewer than 2 neighbours or 4 different anatomies.
    """
    k = base.neighbors.shape[1]
    n_different = len(base) - len(base.repeated)
    if k < 2 or n_different < 4:
        raise LLEError(
            f"lle: no dimension from {n_different} different anatomies and {k} neighbour(s); "
            "give at least 4 and 2"
        )
    values, _ = spectrum(base, min(n_values, n_different - 1))
    floor = np.finfo(float).eps * len(base)  # rounding of M, whose entries are of order one
    ratios = np.maximum(values[1:], floor) / np.maximum(values[:-1], floor)
    ratios = ratios[: max(k - 1, 1)]
    best = int(np.argmax(ratios))
    variances = local_variances(base)
    needed = np.count_nonzero(np.cumsum(variances, axis=1) < LOCAL_VARIANCE, axis=1) + 1
    return Dimension(
        from_gap=best + 1,
        gap=float(ratios[best]),
        from_local_pca=int(np.median(needed)),
        eigenvalues=values,
        local_variances=variances.mean(axis=0),
    )


def local_variances(base: LLE) -> FloatArray:
    """Return fractions of the variance along the principal axes of each neighbourhood, descending.

    Returns ndarray, shape (members that differ, k - 1).
    """
    members = np.flatnonzero(base.same_as == np.arange(len(base)))
    near = base.neighbors[members]
    local = base.gram.products[near[:, :, None], near[:, None, :]]
    local = local - local.mean(axis=1, keepdims=True)
    local = local - local.mean(axis=2, keepdims=True)
    values = np.maximum(np.linalg.eigvalsh(local)[:, :0:-1], 0.0)
    return values / values.sum(axis=1, keepdims=True)
