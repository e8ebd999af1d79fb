"""Places of a few forces, sought one after another, by the likelihood of the cloud.

Take the equations d = J z + e of :mod:`avatar_core.registration.posterior`, with the unknowns z of
rigid motion and of places already chosen. A force at one more place has the marginal likelihood

    log p = 1/2 r^T M^-1 r - 1/2 log det M,   M = I + S H S - X^T G^-1 X,

with its own block H of J^T E^-1 J, the coupling X to the others, and r the residual of the others.
This is a system of three unknowns for each place, solved for all at once. A place is added while it
makes the cloud likelier on average over all places than without it (orthogonal matching pursuit;
Tropp & Gilbert, IEEE Trans. Inf. Theory 53, 2007, with a Bayesian stop).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray

MOST_FORCES = 3
_GAIN = 5.0  # gain of the log likelihood that one more force needs


@dataclass(frozen=True, eq=False)
class Noise:
    """The error of the cloud: E^-1 without a dense matrix; see :mod:`posterior`.

    weights : ndarray, shape (n_points,)
    cells : sparse, shape (n_cells, n_points)
    noise, mismatch : sigma, tau [m]
    """

    weights: FloatArray
    cells: sp.csr_matrix
    noise: float
    mismatch: float

    def weighed(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (A, B) with J^T E^-1 J' = A^T A' - B^T B' for rows J, J' (n_points, n)."""
        inverse = self.noise**-2
        taken = inverse**2 / (self.mismatch**-2 + inverse * (self.cells @ self.weights))
        own = np.sqrt(inverse * self.weights)[:, None] * rows
        shared = np.sqrt(taken)[:, None] * (self.cells @ (self.weights[:, None] * rows))
        return own, np.asarray(shared)


@dataclass(frozen=True, eq=False)
class Found:
    """Places of forces, and the likelihood of others.

    chosen : places, the likeliest first
    gain : ndarray, shape (n_places,), log likelihood of a force at each place instead of the first,
        given the others
    """

    chosen: list[int]
    gain: FloatArray


def find_sites(
    common: FloatArray, rows: FloatArray, data: FloatArray, error: Noise, most: int = MOST_FORCES
) -> Found:
    """Return the places of forces that explain a cloud.

    common : ndarray, shape (n_points, m), rows of the rigid motion times prior deviations
    rows : ndarray, shape (n_points, n_places, 3), rows of a force at each place, times prior
        deviations
    data : ndarray, shape (n_points,), distances [m]
    most : largest number of forces
    """
    n_points, n_places, _ = rows.shape
    own, shared = error.weighed(rows.reshape(n_points, -1).astype(np.float32))
    blocks = [part.reshape(len(part), n_places, 3) for part in (own, shared)]
    hessian = sum(
        sign * np.einsum("psa,psb->sab", part, part, optimize=True)
        for sign, part in zip((1.0, -1.0), blocks, strict=True)
    )
    value = error.weighed(data[:, None])
    right = (own.T @ value[0] - shared.T @ value[1]).reshape(n_places, 3)
    weighed = _Weighed(own, shared, hessian, right, value, error)
    chosen: list[int] = []
    for k in range(most):
        gain = weighed.gains(np.hstack([common, *(rows[:, j] for j in chosen)]))
        best = int(gain.argmax())
        mean = gain[best] + np.log(np.mean(np.exp(gain - gain[best])))
        if k > 0 and (mean < _GAIN or best in chosen):
            break
        chosen.append(best)
    others = [rows[:, j] for j in chosen[1:]]
    return Found(chosen, weighed.gains(np.hstack([common, *others])))


@dataclass(frozen=True, eq=False)
class _Weighed:
    """Sums over the points that do not depend on the chosen places."""

    own: FloatArray
    shared: FloatArray
    hessian: FloatArray
    right: FloatArray
    value: tuple[FloatArray, FloatArray]
    error: Noise

    def gains(self, others: FloatArray) -> FloatArray:
        """Return log likelihood that a force at each place adds to others, rows (n_points, m)."""
        A, B = self.error.weighed(others)
        gram = A.T @ A - B.T @ B + np.eye(A.shape[1])
        known = (A.T @ self.value[0] - B.T @ self.value[1])[:, 0]
        coupling = (self.own.T @ A - self.shared.T @ B).reshape(len(self.right), 3, -1)
        inverse = np.linalg.inv(gram)
        system = self.hessian + np.eye(3) - coupling @ inverse @ coupling.swapaxes(1, 2)
        left = self.right - coupling @ (inverse @ known)
        solved = np.linalg.solve(system, left[:, :, None])[:, :, 0]
        return np.asarray(0.5 * (left * solved).sum(axis=1) - 0.5 * np.linalg.slogdet(system)[1])
