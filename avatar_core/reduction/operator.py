"""The stiffness K as reduction needs it: solutions K^-1 f and products K u."""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
import rslab
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ConvergenceError


class Operator(Protocol):
    """A symmetric positive definite K, such as :class:`avatar_core.fem.elasticity.Elasticity`."""

    def solve(self, loads: FloatArray | sp.spmatrix) -> FloatArray:
        """Return K^-1 F of loads F, shape (n_dofs, n)."""

    def apply(self, displacement: FloatArray) -> FloatArray:
        """Return K U of displacements U, shape (n_dofs, n)."""


class SparseOperator:
    """A sparse symmetric positive definite matrix, factored once when it is first solved with.

    Parameters
    ----------
    matrix : sparse matrix, shape (n_dofs, n_dofs)
        K, both triangles.

    Raises
    ------
    ConvergenceError
        If the matrix is not square and symmetric.

    Examples
    --------
    >>> operator = av.mor.SparseOperator(K)
    >>> np.allclose(operator.apply(operator.solve(F)), F)
    True
    """

    def __init__(self, matrix: sp.spmatrix) -> None:
        self.matrix = sp.csr_matrix(matrix)
        rows, columns = self.matrix.shape
        largest = np.abs(self.matrix).max()
        if rows != columns or np.abs(self.matrix - self.matrix.T).max() > 1e-10 * largest:
            raise ConvergenceError(
                f"the stiffness, shape {(rows, columns)}, is not symmetric; give both triangles of "
                "the K in K u = f"
            )

    @cached_property
    def _factor(self) -> rslab.Ldlt:
        return rslab.ldlt(sp.csc_matrix(self.matrix), threads=1)

    def solve(self, loads: FloatArray | sp.spmatrix) -> FloatArray:
        """Return K^-1 F of loads F, shape (n_dofs, n)."""
        dense = loads.toarray() if sp.issparse(loads) else loads  # type: ignore[union-attr]
        return np.asarray(self._factor.solve_many(np.asfortranarray(dense, dtype=float)))

    def apply(self, displacement: FloatArray) -> FloatArray:
        """Return K U of displacements U, shape (n_dofs, n)."""
        return np.asarray(self.matrix @ displacement)


def operator_of(stiffness: Operator | sp.spmatrix) -> Operator:
    """Return K with its solutions, of a sparse matrix or of what solves already."""
    return SparseOperator(stiffness) if sp.issparse(stiffness) else stiffness
