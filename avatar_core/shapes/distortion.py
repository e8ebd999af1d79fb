"""Distortion of a tetrahedral mesh against a reference: the symmetric Dirichlet energy.

    W(x) = sum_t V_t / V  sum_i 1/2 (s_i^2 + s_i^-2 - 2)

Here s_i are the singular values of the deformation gradient F of tetrahedron t (Smith and Schaefer,
"Bijective parameterization with free boundaries", 2015). W is invariant to rigid motions, penalises
stretch and compression equally, and is unbounded as a tetrahedron flattens. A line search on W
therefore never inverts a tetrahedron.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.common.jit import compiled

_LEAST_CURVATURE = 1e-3  # least curvature of concave modes; a stretch has 4


class Distortion:
    """Symmetric Dirichlet energy of positions x against a reference mesh.

    Parameters
    ----------
    reference : ndarray, shape (n_vertices, 3)
        Reference positions [m], positively oriented with ``tets``.
    tets : ndarray of int, shape (n_tets, 4)
    """

    def __init__(self, reference: FloatArray, tets: IntArray) -> None:
        self.tets, self.n_vertices = tets, len(reference)
        corners = reference[tets]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        volume = np.linalg.det(edges)
        inverse = np.linalg.inv(edges)
        # F = sum_k x_k (x) g_k, g_k the gradient of the barycentric coordinate of corner k
        self._gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        self._weight = volume / volume.sum()
        self._dofs = (3 * tets[:, :, None] + np.arange(3)).reshape(len(tets), 12)
        self._pattern()

    def _pattern(self) -> None:
        """Compute the Hessian's sparsity, and the position of each element entry in it."""
        n = 3 * self.n_vertices
        key = np.repeat(self._dofs, 12, axis=1).ravel() * n + np.tile(self._dofs, (1, 12)).ravel()
        self._entries, self._place = np.unique(key, return_inverse=True)
        self._columns = self._entries % n
        self._starts = np.searchsorted(self._entries // n, np.arange(n + 1))

    @property
    def n_entries(self) -> int:
        """Number of stored entries of the Hessian."""
        return len(self._entries)

    def matrix(self, values: FloatArray) -> sp.csr_matrix:
        """Return a symmetric matrix of the Hessian's pattern, (3 n_vertices, 3 n_vertices)."""
        n = 3 * self.n_vertices
        return sp.csr_matrix((values, self._columns, self._starts), shape=(n, n))

    def add(self, hessian: sp.csr_matrix, other: sp.csr_matrix) -> None:
        """Add a matrix that couples vertices of the same tetrahedron, and keep the pattern."""
        n = 3 * self.n_vertices
        rows = np.repeat(np.arange(n), np.diff(other.indptr))
        hessian.data[np.searchsorted(self._entries, rows * n + other.indices)] += other.data

    def deformation_gradient(self, positions: FloatArray) -> FloatArray:
        """Return F of each tetrahedron, shape (n_tets, 3, 3)."""
        return np.swapaxes(positions[self.tets], 1, 2) @ self._gradients

    def jacobians(self, positions: FloatArray) -> FloatArray:
        """Return det F of each tetrahedron, its volume over the reference one, shape (n_tets,)."""
        return np.linalg.det(self.deformation_gradient(positions))

    def energy(self, positions: FloatArray) -> float:
        """Return W(x), infinite if a tetrahedron is flat or inverted."""
        return float(_energy(self.deformation_gradient(positions), self._weight))

    def derivatives(self, positions: FloatArray) -> tuple[FloatArray, sp.csr_matrix]:
        """Return the gradient and the positive definite Hessian.

        Shapes (3 n_vertices,) and (3 n_vertices, 3 n_vertices). In the frame of the singular
        vectors, the Hessian of an isotropic energy is diagonal except for the stretches, which do
        not couple here. Its entries are f''(s_i) for stretches, (f'(a) - f'(b)) / (a - b) for
        shears, and (f'(a) + f'(b)) / (a + b) for twists. Only twists can be negative. They are then
        raised to a small positive value (Smith, De Goes, Kim, "Analytic eigensystems for isotropic
        distortion energies", 2019).
        """
        left, s, right = np.linalg.svd(self.deformation_gradient(positions))
        stress = (left * (s - s**-3)[:, None, :]) @ right * self._weight[:, None, None]
        nodal = self._gradients @ np.swapaxes(stress, 1, 2)
        n = 3 * self.n_vertices
        gradient = np.bincount(self._dofs.ravel(), nodal.ravel(), n).astype(float)
        # v_i . g_k, with which mode u_i (x) v_j changes by u_i where corner k moves
        along = right @ np.swapaxes(self._gradients, 1, 2)
        values = np.zeros(self.n_entries)
        place = self._place.reshape(len(s), 12, 12)
        _add_hessians(left, s, along, self._weight, place, values)
        return gradient, self.matrix(values)


@compiled()
def _energy(deformation, weight):  # type: ignore[no-untyped-def]
    """Return sum_t w_t (|F|^2 + |F^-1|^2 - 6) / 2, with F^-1 from the cofactors and det F."""
    total = 0.0
    for t in range(len(weight)):
        f = deformation[t]
        squares, cofactors, determinant = 0.0, 0.0, 0.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                cofactor = f[j, b] * f[k, c] - f[j, c] * f[k, b]
                squares += f[i, a] ** 2
                cofactors += cofactor**2
                if i == 0:
                    determinant += f[0, a] * cofactor
        if not determinant > 0.0:
            return np.inf
        total += weight[t] * (squares + cofactors / determinant**2 - 6.0)
    return 0.5 * total


@compiled()
def _add_hessians(left, s, along, weight, place, values):  # type: ignore[no-untyped-def]
    """Add the Hessian of each tetrahedron, 12 x 12, to the matrix at ``place``.

    left, s, along : u_i in the columns, s_i, and v_i . g_k, of each tetrahedron
    """
    change, block = np.empty(12), np.empty((12, 12))
    for t in range(len(s)):
        block[:] = 0.0
        for i in range(3):
            j = (i + 1) % 3
            a, b = s[t, i], s[t, j]
            cube = (a * b) ** 3
            u, v, p, q = left[t, :, i], left[t, :, j], along[t, i], along[t, j]
            _set_change(u, p, u, p, 0.0, change)
            _add_outer(change, weight[t] * (1.0 + 3.0 * a**-4), block)
            _set_change(u, q, v, p, 1.0, change)
            shear = 1.0 + (a * a + a * b + b * b) / cube
            _add_outer(change, 0.5 * weight[t] * shear, block)
            _set_change(u, q, v, p, -1.0, change)
            twist = max(1.0 - (a * a - a * b + b * b) / cube, _LEAST_CURVATURE)
            _add_outer(change, 0.5 * weight[t] * twist, block)
        for row in range(12):
            for column in range(12):
                values[place[t, row, column]] += block[row, column]


@compiled()
def _set_change(u, q, v, p, sign, change):  # type: ignore[no-untyped-def]
    """Write u_a q_k + sign v_a p_k, the change of component a of corner k."""
    for k in range(4):
        for a in range(3):
            change[3 * k + a] = u[a] * q[k] + sign * v[a] * p[k]


@compiled()
def _add_outer(change, factor, block):  # type: ignore[no-untyped-def]
    for row in range(12):
        for column in range(12):
            block[row, column] += factor * change[row] * change[column]
