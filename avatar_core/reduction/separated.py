"""Separated representations u(x, s) = sum_k X_k(x) Y_k(s) (paper Eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SeparatedField:
    """A field over space and load, as a sum of products.

    Attributes
    ----------
    space : ndarray, shape (n_dofs, rank)
        X_k at the degrees of freedom in space.
    load : ndarray, shape (n_loads, rank)
        Y_k at the loads (position and direction).

    Examples
    --------
    >>> field = av.mor.SeparatedField(space=np.ones((4, 2)), load=np.ones((3, 2)))
    >>> field.evaluate().shape, field.truncate(1).rank
    ((4, 3), 1)
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
        """Return the field under the chosen loads, shape (n_dofs, n_chosen)."""
        return self.space @ self.load[loads].T

    def truncate(self, rank: int) -> SeparatedField:
        """Return the first ``rank`` modes."""
        return SeparatedField(self.space[:, :rank], self.load[:, :rank])

    def sorted_by_norm(
        self, space_mass: np.ndarray, load_mass: np.ndarray | None = None
    ) -> SeparatedField:
        """Return the same field with its modes mixed and sorted by :meth:`mixing_by_norm`."""
        mixing = self.mixing_by_norm(space_mass, load_mass)
        return SeparatedField(self.space @ mixing, self.load @ mixing)

    def mixing_by_norm(
        self, space_mass: np.ndarray, load_mass: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the orthogonal mixing that sorts modes by weighted L2 norm, shape (rank, rank).

        It is the Q of B^T R = Q T, with X^T M X = A^T A, Y^T W Y = B^T B and the singular value
        decomposition A B^T = P S R^T. Q is orthogonal. Therefore Y Y^T does not change, and the
        leading modes still span a Galerkin subspace.

        Parameters
        ----------
        space_mass : ndarray, shape (n_dofs,)
            M, lumped.
        load_mass : ndarray, shape (n_loads,)
            W; by default 1 / |u|^2 of each load in M, which makes the norm one of relative errors.
        """
        a = _gram_root(self.space, space_mass)
        if load_mass is None:
            load_mass = 1.0 / np.maximum(((self.load @ a.T) ** 2).sum(axis=1), 1e-300)
        b = _gram_root(self.load, load_mass)
        _, _, right = np.linalg.svd(a @ b.T)
        return np.asarray(np.linalg.qr(b.T @ right.T)[0])


def _gram_root(factor: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Return A with A^T A = factor^T M factor, also where the factor is rank deficient."""
    return np.asarray(np.linalg.qr(np.sqrt(mass)[:, None] * factor, mode="r"))
