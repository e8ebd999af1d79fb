"""Distortion of a tetrahedral mesh against a reference: the symmetric Dirichlet energy.

    W(x) = sum_t V_t / V  sum_i 1/2 (s_i^2 + s_i^-2 - 2)

with s_i the singular values of the deformation gradient F of tetrahedron t (Smith and Schaefer,
"Bijective parameterization with free boundaries", 2015). W is invariant to rigid motions, penalises
stretch and compression equally, and is unbounded as a tetrahedron flattens: a line search on it
never inverts one.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_PAIRS = ((0, 1), (0, 2), (1, 2))
_LEAST_CURVATURE = 1e-3  # replaces that of concave modes; a stretch has 4


class Distortion:
    """Symmetric Dirichlet energy of positions x against a reference mesh.

    Parameters
    ----------
    reference : ndarray, shape (n_vertices, 3) [m], positively oriented with ``tets``
    tets : ndarray of int, shape (n_tets, 4)
    """

    def __init__(self, reference: FloatArray, tets: NDArray[np.int64]) -> None:
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
        """Sparsity of the Hessian, and position of each element entry in it."""
        n = 3 * self.n_vertices
        key = np.repeat(self._dofs, 12, axis=1).ravel() * n + np.tile(self._dofs, (1, 12)).ravel()
        entry, self._place = np.unique(key, return_inverse=True)
        self._columns = entry % n
        self._starts = np.searchsorted(entry // n, np.arange(n + 1))

    def deformation_gradient(self, positions: FloatArray) -> FloatArray:
        """F of each tetrahedron, shape (n_tets, 3, 3)."""
        return np.swapaxes(positions[self.tets], 1, 2) @ self._gradients

    def jacobians(self, positions: FloatArray) -> FloatArray:
        """det F, the volume of each tetrahedron over its reference volume, shape (n_tets,)."""
        return np.linalg.det(self.deformation_gradient(positions))

    def energy(self, positions: FloatArray) -> float:
        """W(x), infinite if a tetrahedron is flat or inverted."""
        F = self.deformation_gradient(positions)
        if not np.linalg.det(F).min() > 0:
            return float("inf")
        squares = (F**2).sum(axis=(1, 2)) + (np.linalg.inv(F) ** 2).sum(axis=(1, 2))
        return float(0.5 * (self._weight @ (squares - 6.0)))

    def derivatives(self, positions: FloatArray) -> tuple[FloatArray, sp.csr_matrix]:
        """Gradient (3 n_vertices,) and positive definite Hessian (3 n_vertices, 3 n_vertices).

        In the frame of the singular vectors, the Hessian of an isotropic energy is diagonal except
        for the stretches, which do not couple here: f''(s_i) for stretches,
        (f'(a) - f'(b)) / (a - b) for shears, (f'(a) + f'(b)) / (a + b) for twists. Only twists
        can be negative, and are then raised to a small positive value (Smith, De Goes, Kim,
        "Analytic eigensystems for isotropic distortion energies", 2019).
        """
        left, s, right = np.linalg.svd(self.deformation_gradient(positions))
        stress = (left * (s - s**-3)[:, None, :]) @ right * self._weight[:, None, None]
        nodal = self._gradients @ np.swapaxes(stress, 1, 2)
        n = 3 * self.n_vertices
        gradient = np.zeros(n)
        np.add.at(gradient, self._dofs.ravel(), nodal.ravel())
        modes, curvature = _eigenmodes(left, s, right)
        # change of each mode's amplitude with the twelve coordinates of the tetrahedron
        change = np.einsum("tmab,tkb->tmka", modes, self._gradients).reshape(len(s), 9, 12)
        scaled = change * (curvature * self._weight[:, None])[:, :, None]
        blocks = np.swapaxes(change, 1, 2) @ scaled
        values = np.bincount(self._place, weights=blocks.ravel(), minlength=len(self._columns))
        return gradient, sp.csr_matrix((values, self._columns, self._starts), shape=(n, n))


def _eigenmodes(
    left: FloatArray, s: FloatArray, right: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Nine orthonormal modes of F and the curvature of the energy in each, (n, 9, 3, 3), (n, 9)."""
    outer: FloatArray = np.einsum("tai,tjb->tijab", left, right)
    modes = [outer[:, i, i] for i in range(3)]
    curvature: list[FloatArray] = [1.0 + 3.0 * s[:, i] ** -4 for i in range(3)]
    for i, j in _PAIRS:
        a, b = s[:, i], s[:, j]
        cube = (a * b) ** 3
        modes.append((outer[:, i, j] + outer[:, j, i]) / np.sqrt(2.0))
        curvature.append(1.0 + (a * a + a * b + b * b) / cube)
        modes.append((outer[:, i, j] - outer[:, j, i]) / np.sqrt(2.0))
        curvature.append(np.maximum(1.0 - (a * a - a * b + b * b) / cube, _LEAST_CURVATURE))
    return np.stack(modes, axis=1), np.column_stack(curvature)
