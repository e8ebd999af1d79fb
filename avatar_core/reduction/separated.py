"""Separated representations u(x, s) = sum_k X_k(x) Y_k(s) (paper Eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SeparatedField:
    """A field over space and load, as a sum of products.

    space : ndarray, shape (n_dofs, rank), X_k at the degrees of freedom in space
    load : ndarray, shape (n_loads, rank), Y_k at the loads (position and direction)
    """

    space: np.ndarray
    load: np.ndarray

    @property
    def rank(self) -> int:
        """Number of modes."""
        return self.space.shape[1]

    @property
    def nbytes(self) -> int:
        """Memory held by the factors [bytes]."""
        return self.space.nbytes + self.load.nbytes

    def evaluate(self, loads: np.ndarray | slice = slice(None)) -> np.ndarray:
        """The field under the chosen loads, shape (n_dofs, n_chosen)."""
        return self.space @ self.load[loads].T

    def truncate(self, rank: int) -> SeparatedField:
        """The first ``rank`` modes."""
        return SeparatedField(self.space[:, :rank], self.load[:, :rank])

    def sorted_by_worth(
        self, space_mass: np.ndarray, load_mass: np.ndarray | None = None
    ) -> SeparatedField:
        """The same field with orthogonally mixed modes, of which the first are worth most."""
        mixing = self.mixing_by_worth(space_mass, load_mass)
        return SeparatedField(self.space @ mixing, self.load @ mixing)

    def mixing_by_worth(
        self, space_mass: np.ndarray, load_mass: np.ndarray | None = None
    ) -> np.ndarray:
        """The orthogonal mixing that sorts modes by their worth, shape (rank, rank).

        An orthogonal mixing keeps what orthonormal modes are good for: Y Y^T, and that any
        leading ones are a Galerkin subspace. It is the Q of B^T R = Q T, with X^T M X = A^T A,
        Y^T W Y = B^T B and the singular value decomposition A B^T = P S R^T.

        Parameters
        ----------
        space_mass : ndarray, shape (n_dofs,), lumped, M
        load_mass : ndarray, shape (n_loads,), W; by default 1 / |u|^2 of each load in M, so that
            relative errors count
        """
        a = _gram_root(self.space, space_mass)
        if load_mass is None:
            load_mass = 1.0 / np.maximum(((self.load @ a.T) ** 2).sum(axis=1), 1e-300)
        b = _gram_root(self.load, load_mass)
        _, _, right = np.linalg.svd(a @ b.T)
        return np.asarray(np.linalg.qr(b.T @ right.T)[0])

    def norm(self, space_mass: np.ndarray, load_mass: np.ndarray) -> float:
        """sqrt(sum_ij m_i w_j u_ij^2) with lumped masses, never forming u."""
        gram_space = self.space.T @ (space_mass[:, None] * self.space)
        gram_load = self.load.T @ (load_mass[:, None] * self.load)
        return float(np.sqrt(max((gram_space * gram_load).sum(), 0.0)))

    def compress(
        self, space_mass: np.ndarray, load_mass: np.ndarray, tolerance: float
    ) -> SeparatedField:
        """The shortest field within ``tolerance`` (relative, in :meth:`norm`) of this one.

        This is the singular value decomposition, computed on the two small Gram matrices.
        """
        rotation, left, value = optimal_rotation(self, space_mass, load_mass)
        energy = value**2
        tail = np.sqrt(np.maximum(energy.sum() - np.cumsum(energy), 0.0) / energy.sum())
        rank = int(np.argmax(tail <= max(tolerance, 1e-15))) + 1
        return SeparatedField(self.space @ left[:, :rank], self.load @ rotation[:, :rank])


def optimal_rotation(
    field: SeparatedField, space_mass: np.ndarray, load_mass: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right and left mixing matrices of the weighted singular value decomposition.

    With Gx = X^T M X = A^T A, Gy = Y^T W Y = B^T B and A B^T = P S Q^T, the field equals
    (X A^-1 P S)(Y B^-1 Q)^T, whose columns are orthogonal in the two masses.

    Returns
    -------
    load_mixing, space_mixing : ndarray, shape (rank, rank)
    singular_values : ndarray, shape (rank,), descending
    """
    a = _gram_root(field.space, space_mass)
    b = _gram_root(field.load, load_mass)
    left, value, right = np.linalg.svd(a @ b.T)
    return np.linalg.pinv(b) @ right.T, np.linalg.pinv(a) @ (left * value), value


def _gram_root(factor: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """A with A^T A = factor^T M factor, also where the factor is rank deficient."""
    return np.asarray(np.linalg.qr(np.sqrt(mass)[:, None] * factor, mode="r"))
