"""The L2 norm of displacement over an organ, by lumped masses: |u|^2 = sum_i m_i u_i^2."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray


def l2_norm(field: FloatArray, mass: FloatArray) -> NDArray[np.float64]:
    """|u| of each column of a field.

    Parameters
    ----------
    field : ndarray, shape (n_dofs, ...)
    mass : ndarray, shape (n_dofs,), :attr:`avatar_core.geometry.mesh.TetMesh.lumped_mass`

    Returns
    -------
    ndarray, shape (...)
    """
    return np.asarray(np.sqrt(np.tensordot(mass, field**2, axes=1)), float)


def relative_l2(estimate: FloatArray, truth: FloatArray, mass: FloatArray) -> NDArray[np.float64]:
    """|u - u_ref| / |u_ref| of each column; arguments as of :func:`l2_norm`."""
    return l2_norm(estimate - truth, mass) / l2_norm(truth, mass)
