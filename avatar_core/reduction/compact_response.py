"""Elastic response of one anatomy, or of a combination of anatomies, in few modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar_core.common.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class CompactResponse:
    """Displacement under unit loads u(x, s) ~ X(x) Y(s)^T, with Y Y^T the contact compliance.

    Attributes
    ----------
    space : ndarray, shape (3 n_vertices, rank)
        X, K-orthonormal for an anatomy.
    load : ndarray, shape (3 n_positions, rank)
        Y.
    residual_compliance : ndarray, shape (n_positions, 3, 3)
        C - Y Y^T of each patch [m/N].
    """

    space: FloatArray
    load: FloatArray
    residual_compliance: FloatArray


def positive_part(blocks: FloatArray) -> FloatArray:
    """Return the symmetric 3 x 3 blocks without their negative eigenvalues, shape (n, 3, 3)."""
    value, vector = np.linalg.eigh((blocks + blocks.transpose(0, 2, 1)) / 2.0)
    return np.asarray((vector * np.maximum(value, 0.0)[:, None]) @ vector.transpose(0, 2, 1))
