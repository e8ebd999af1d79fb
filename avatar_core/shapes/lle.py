"""Locally linear embedding (LLE) of a base of shapes.

The embedding follows Eq. 16 of Gonzalez, Cueto & Chinesta (2015) with M = (I - W)^T (I - W). The
last term of the matrix printed there has the wrong sign (Roweis & Saul 2000, Science 290:2323).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import LLEError
from avatar_core.shapes.weights import (
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
ROUNDING = 4 * float(np.finfo(float).eps)  # rounding of an inner product, relative to the lengths
TRUSTED = 5e-11  # if rounding may change weights by more, they are solved from differences
CLEAR_GAP = 3.0  # ratio of neighboring eigenvalues from which a spectral gap is clear
LOCAL_VARIANCE = 0.99  # part of the variance that the counted principal components explain


@dataclass(frozen=True, eq=False)
class Gram:
    """Inner products of a base about a fixed origin, from which all distances follow.

    Attributes
    ----------
    origin : ndarray, shape (D,)
        Mean of the first members, which keeps the products and their rounding small. It does not
        move when the base grows.
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
        """Squared lengths |X_i - o|^2, shape (n,)."""
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
class Dimension:
    """Estimates of how many parameters the shapes of a base depend on.

    Attributes
    ----------
    from_gap : int
        Number of eigenvalues of M below its largest spectral gap.
    gap : float
        Ratio of the two eigenvalues at the gap; near 1 the spectrum shows no dimension.
    from_local_pca : int
        Median number of principal components for 99 % of a neighborhood's variance.
    eigenvalues : ndarray
        Lowest eigenvalues of M, ascending.
    local_variances : ndarray, shape (k - 1,)
        Mean fraction of the variance along each principal axis, descending.
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
        """Reasons to distrust the estimates, one line each."""
        lines = []
        if self.gap < CLEAR_GAP:
            lines.append(
                f"no clear gap in the spectrum: the largest ratio is {self.gap:.2g}, after "
                f"{self.from_gap}; add anatomies, or choose another number of neighbors"
            )
        if not self.agree:
            lines.append(
                f"the spectral gap gives {self.from_gap} dimension(s), local PCA "
                f"{self.from_local_pca}"
            )
        return tuple(lines)


class LLE:
    """Locally linear embedding of shapes, in the manner of scikit-learn.

    Each shape X_i is written in terms of its nearest neighbors (Eq. 15), and the coordinates Y_i
    are those that the same weights reconstruct best (Eq. 16):

        min sum_i |X_i - sum_j W_ij X_j|^2,  sum_j W_ij = 1;      min |Y - W Y|^2,  Y^T Y = n I

    Parameters
    ----------
    n_neighbors : int
        Neighbors of each shape, k.
    n_components : int
        Coordinates of each shape, d.
    regularization : float
        Part of the trace added to the diagonal of each local Gram matrix, in (0, 1].
    convex : bool
        Whether weights are non-negative. Regularization is then not used.

    Attributes
    ----------
    embedding_ : ndarray, shape (n, d)
        Coordinates Y, of zero mean.
    eigenvalues_ : ndarray, shape (d,)
        Lowest eigenvalues of M = (I - W)^T (I - W), ascending, without that of the constant.
    weights_ : ndarray, shape (n, k)
        Weights of the neighbors. A repeated shape has weight 1 on the first one equal to it.
    neighbors_ : ndarray of int, shape (n, k)
        Neighbors, nearest first, never the shape itself or its equals.
    same_as_ : ndarray of int, shape (n,)
        Number of the first shape equal to each, mostly its own.
    vectors_ : tuple of n ndarrays, shape (D,)
        The shapes.
    gram_ : Gram
        Inner products of the shapes.

    References
    ----------
    Gonzalez, Cueto & Chinesta (2015), Eq. 15 and 16; Roweis & Saul (2000), Science 290:2323.

    Examples
    --------
    >>> X = np.random.default_rng(0).standard_normal((40, 2)) @ np.ones((2, 9))
    >>> X += np.arange(40)[:, None] * np.arange(9)
    >>> lle = av.shapes.LLE(n_neighbors=6, n_components=2)
    >>> lle.fit_transform(X).shape
    (40, 2)
    >>> np.array_equal(lle.transform(X[:3]), lle.embedding_[:3])
    True
    """

    vectors_: tuple[FloatArray, ...]
    gram_: Gram
    same_as_: IntArray
    neighbors_: IntArray
    weights_: FloatArray

    def __init__(
        self,
        n_neighbors: int = 10,
        n_components: int = 2,
        *,
        regularization: float = DEFAULT_REGULARIZATION,
        convex: bool = False,
    ) -> None:
        self.n_neighbors, self.n_components = n_neighbors, n_components
        self.regularization, self.convex = regularization, convex

    def __repr__(self) -> str:
        given = ", ".join(f"{name}={value!r}" for name, value in self.get_params().items())
        return f"LLE({given})"

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Parameters by name, as scikit-learn asks for them."""
        names = ("n_neighbors", "n_components", "regularization", "convex")
        return {name: getattr(self, name) for name in names}

    def set_params(self, **params: Any) -> LLE:
        """Change parameters, as scikit-learn does; :meth:`fit` then takes them."""
        for name in params:
            if name not in self.get_params():
                raise LLEError(f"lle: no parameter '{name}'; choose {', '.join(self.get_params())}")
        vars(self).update(params)
        return self

    def fit(
        self, X: Sequence[ArrayLike] | FloatArray, y: object = None, *, gram: Gram | None = None
    ) -> LLE:
        """Find the weights of every shape in terms of its neighbors (Eq. 15).

        Parameters
        ----------
        X : array_like, shape (n, D)
            One shape a row, or n arrays of shape (D,). Arrays of float64 are not copied.
        gram : Gram, optional
            Their inner products, if known.

        Raises
        ------
        LLEError
            If there are no shapes, a parameter is out of range, a value is not finite or lengths
            differ.
        """
        rows = tuple(np.asarray(row, dtype=np.float64) for row in X)
        if not rows:
            raise LLEError("lle: the base is empty; add at least one anatomy")
        if self.n_neighbors <= 0:
            raise LLEError(f"lle: {self.n_neighbors} neighbors asked for; choose at least 1")
        require_regularization(self.regularization)
        self.gram_ = _checked_gram(rows, gram)
        self.vectors_, self.same_as_ = rows, _equals(self.gram_)
        self.neighbors_, self.weights_ = _weights(self)
        for name in ("weight_matrix", "_embedded"):
            vars(self).pop(name, None)
        return self

    def fit_transform(self, X: Sequence[ArrayLike] | FloatArray, y: object = None) -> FloatArray:
        """Fit, and return ``embedding_``, shape (n, d)."""
        return self.fit(X).embedding_

    def transform(self, X: Sequence[ArrayLike] | FloatArray) -> FloatArray:
        """Coordinates of shapes, sum_j w_j Y_j by their barycentric weights (Eq. 15).

        A shape equal to one of the base gets exactly its coordinates.

        Parameters
        ----------
        X : array_like, shape (m, D)

        Returns
        -------
        ndarray, shape (m, d)

        Raises
        ------
        LLEError
            If a shape is not as long as those of the base, or not finite.
        """
        found = [self.barycenter(row) for row in X]
        rows = [one.weights @ self.embedding_[one.neighbors] for one in found]
        return np.array(rows).reshape(len(rows), self.n_components)

    def barycenter(self, point: ArrayLike, leave_out: Collection[int] = ()) -> Barycenter:
        """Weights of one new shape with the settings of the base; equal members count once.

        Parameters
        ----------
        point : array_like, shape (D,)
        leave_out : collection of int
            Members that get no weight.
        """
        self._require_fitted()
        return barycenter(
            self.vectors_,
            point,
            self.n_neighbors,
            regularization=self.regularization,
            convex=self.convex,
            leave_out={*leave_out, *self.repeated},
        )

    def spectrum(self, n_values: int) -> tuple[FloatArray, FloatArray]:
        """Lowest eigenvalues and eigenvectors of M (Eq. 16), that of the constant left out.

        Returns
        -------
        values : ndarray, shape (n_values,)
        vectors : ndarray, shape (n, n_values)

        Raises
        ------
        LLEError
            Unless the base has more different shapes than values.
        """
        self._require_fitted()
        n, n_different = len(self.vectors_), len(self.vectors_) - len(self.repeated)
        if not 1 <= n_values < n_different:
            raise LLEError(
                f"lle: {n_values} dimension(s) of {n_different} different anatomies; choose 1 to "
                "fewer than there are anatomies, or add some"
            )
        rest = np.eye(n) - self.weight_matrix
        matrix = rest.T @ rest
        # the constant vector has eigenvalue zero: shifted, it cannot mix with other small ones
        matrix += np.trace(matrix) / n
        values, vectors = eigh(matrix, subset_by_index=[0, n_values - 1])
        return np.maximum(values, 0.0), vectors

    def dimension(self, n_values: int = 20) -> Dimension:
        """Dimension from the gap in the spectrum of M (Polito & Perona 2001) and from local PCA.

        Neither can exceed the number of neighbors minus one. ``notices`` say if they should not
        be trusted.

        Raises
        ------
        LLEError
            If there are fewer than 2 neighbors or 4 different anatomies.
        """
        self._require_fitted()
        k = self.neighbors_.shape[1]
        n_different = len(self.vectors_) - len(self.repeated)
        if k < 2 or n_different < 4:
            raise LLEError(
                f"lle: no dimension from {n_different} different anatomies and {k} neighbor(s); "
                "give at least 4 and 2"
            )
        values, _ = self.spectrum(min(n_values, n_different - 1))
        floor = np.finfo(float).eps * len(self.vectors_)  # rounding of M: entries of order one
        ratios = np.maximum(values[1:], floor) / np.maximum(values[:-1], floor)
        ratios = ratios[: max(k - 1, 1)]
        best = int(np.argmax(ratios))
        variances = local_variances(self)
        needed = np.count_nonzero(np.cumsum(variances, axis=1) < LOCAL_VARIANCE, axis=1) + 1
        return Dimension(
            from_gap=best + 1,
            gap=float(ratios[best]),
            from_local_pca=int(np.median(needed)),
            eigenvalues=values,
            local_variances=variances.mean(axis=0),
        )

    @property
    def embedding_(self) -> FloatArray:
        """Coordinates Y, shape (n, d); found when first asked for."""
        return self._embedded[1]

    @property
    def eigenvalues_(self) -> FloatArray:
        """Lowest eigenvalues of M, shape (d,)."""
        return self._embedded[0]

    @cached_property
    def _embedded(self) -> tuple[FloatArray, FloatArray]:
        values, vectors = self.spectrum(self.n_components)
        return values, vectors * np.sqrt(len(vectors))

    @cached_property
    def weight_matrix(self) -> FloatArray:
        """W, shape (n, n); rows sum to one."""
        n = len(self.vectors_)
        matrix = np.zeros((n, n))
        np.add.at(matrix, (np.arange(n)[:, None], self.neighbors_), self.weights_)
        return matrix

    @property
    def repeated(self) -> tuple[int, ...]:
        """Members equal to an earlier one; they are not used as neighbors."""
        return tuple(int(i) for i in np.flatnonzero(self.same_as_ != np.arange(len(self.same_as_))))

    @property
    def notices(self) -> tuple[str, ...]:
        """How the result differs from the request, one line each."""
        different = len(self.vectors_) - len(self.repeated)
        notices = [f"member {i} equals member {self.same_as_[i]}" for i in self.repeated]
        if self.n_neighbors >= different:
            notices.append(truncation(self.n_neighbors, different - 1))
        return tuple(notices)

    def _require_fitted(self) -> None:
        if "weights_" not in vars(self):
            raise LLEError("lle: there is no base yet; call fit first")


def _checked_gram(rows: tuple[FloatArray, ...], gram: Gram | None) -> Gram:
    """Return the inner products of shapes, given or computed; raise LLEError for bad shapes."""
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
    return gram


def _equals(gram: Gram) -> IntArray:
    """Return the number of the first member equal to each, shape (n,)."""
    same_as = np.zeros(1, dtype=np.int64)
    for i in range(1, len(gram.products)):
        same_as = np.append(same_as, _first_equal(gram, i, same_as))
    return same_as


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


def _weights(base: LLE) -> tuple[IntArray, FloatArray]:
    """Return neighbors and weights of every member, both of shape (n, k)."""
    n = len(base.vectors_)
    is_first = base.same_as_ == np.arange(n)
    first, again = np.flatnonzero(is_first), np.flatnonzero(~is_first)
    n_used = min(base.n_neighbors, len(first) - 1)
    k = max(n_used, 1)  # one column for repeated members, even if no two members differ
    neighbors, weights = np.zeros((n, k), dtype=np.int64), np.zeros((n, k))
    neighbors[again] = base.same_as_[again, None]
    weights[again] = np.eye(1, k)
    if n_used > 0:
        neighbors[first] = _nearest(base, first, k)
        weights[first] = _row_weights(base, first, neighbors[first])
    return neighbors, weights


def _nearest(base: LLE, rows: IntArray, k: int) -> IntArray:
    """Return the k nearest others, repeated members left out; ties go to the lower number."""
    squared = base.gram_.squared_distances(rows)
    squared[:, list(base.repeated)] = np.inf
    squared[np.arange(len(rows)), rows] = np.inf
    return np.argsort(squared, axis=1, kind="stable")[:, :k]


def _row_weights(base: LLE, rows: IntArray, neighbors: IntArray) -> FloatArray:
    """Return weights of members from the Gram matrix, or from differences where it loses digits."""
    products, lengths = base.gram_.products, base.gram_.squared_lengths
    cross = products[rows[:, None], neighbors]
    local = products[neighbors[:, :, None], neighbors[:, None, :]]
    local = local - cross[:, :, None] - cross[:, None, :] + lengths[rows, None, None]
    for i in _imprecise(local, np.maximum(lengths[rows], lengths[neighbors].max(axis=1)), base):
        local[i] = local_gram(base.vectors_[rows[i]], [base.vectors_[j] for j in neighbors[i]])
    if base.convex:
        return np.array([convex_weights(one) for one in local])
    return barycenter_weights(local, base.regularization)


def _imprecise(local: FloatArray, lengths: FloatArray, base: LLE) -> IntArray:
    """Return neighborhoods whose weights rounding may change by more than TRUSTED.

    The estimate is the rounding eps |X|^2 of the Gram matrix over the smallest eigenvalue, which is
    at least r tr(C).
    """
    ridge = base.regularization * np.trace(local, axis1=1, axis2=2)
    rounding = ROUNDING * lengths
    suspects = np.flatnonzero(rounding > TRUSTED * ridge)
    least = np.maximum(np.linalg.eigvalsh(local[suspects])[:, 0], 0.0) + ridge[suspects]
    return suspects[rounding[suspects] > TRUSTED * least]


def local_variances(base: LLE) -> FloatArray:
    """Return fractions of the variance along the principal axes of each neighborhood, descending.

    Returns ndarray, shape (members that differ, k - 1).
    """
    members = np.flatnonzero(base.same_as_ == np.arange(len(base.vectors_)))
    near = base.neighbors_[members]
    local = base.gram_.products[near[:, :, None], near[:, None, :]]
    local = local - local.mean(axis=1, keepdims=True)
    local = local - local.mean(axis=2, keepdims=True)
    values = np.maximum(np.linalg.eigvalsh(local)[:, :0:-1], 0.0)
    return values / values.sum(axis=1, keepdims=True)
