"""Norms of displacement over an organ, its mean strain, and orthonormality checks.

The L2 norm uses lumped masses: |u|^2 = sum_i m_i u_i^2. Orthonormality is checked in any inner
product.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ConvergenceError
from avatar_core.geometry.mesh import TetMesh


def l2_norm(field: FloatArray, mass: FloatArray) -> NDArray[np.float64]:
    """Return |u| of each column of a field.

    Parameters
    ----------
    field : ndarray, shape (n_dofs, ...)
    mass : ndarray, shape (n_dofs,)
        :attr:`avatar_core.geometry.mesh.TetMesh.lumped_mass`.

    Returns
    -------
    ndarray, shape (...)
    """
    return np.asarray(np.sqrt(np.tensordot(mass, field**2, axes=1)), float)


def relative_l2(estimate: FloatArray, truth: FloatArray, mass: FloatArray) -> NDArray[np.float64]:
    """Return |u - u_ref| / |u_ref| of each column; arguments like :func:`l2_norm`."""
    return l2_norm(estimate - truth, mass) / l2_norm(truth, mass)


def mean_strain(mesh: TetMesh, displacement: FloatArray) -> float:
    """Return the root mean square strain of an organ, (int |sym grad u|^2 dx / V)^(1/2).

    Parameters
    ----------
    displacement : ndarray, shape (n_vertices, 3)
        Displacement [m], linear in each tetrahedron.
    """
    gradient = _gradients(mesh, displacement)
    return _mean(mesh, (gradient + gradient.swapaxes(1, 2)) / 2.0)


def mean_gradient(mesh: TetMesh, displacement: FloatArray) -> float:
    """Return the root mean square of |grad u| over an organ, strain and rotation together.

    Parameters
    ----------
    displacement : ndarray
        See :func:`mean_strain`.
    """
    return _mean(mesh, _gradients(mesh, displacement))


def _gradients(mesh: TetMesh, displacement: FloatArray) -> FloatArray:
    """Return grad u of each tetrahedron, shape (n_tets, 3, 3)."""
    at, moved = mesh.vertices[mesh.tets], displacement[mesh.tets]
    return np.asarray(np.linalg.solve(at[:, 1:] - at[:, :1], moved[:, 1:] - moved[:, :1]))


def _mean(mesh: TetMesh, tensors: FloatArray) -> float:
    square = (tensors**2).sum(axis=(1, 2))
    return float(np.sqrt(mesh.tet_volumes @ square / mesh.volume))


def require_orthonormal(
    functions: FloatArray, images: FloatArray, what: str, tolerance: float = 1e-6
) -> None:
    """Check the Gram matrix X^T A X' = [0; I], X' the last columns of X, in every entry.

    Parameters
    ----------
    functions : ndarray, shape (n, rank)
        X.
    images : ndarray, shape (n, m)
        A X' for the last m functions, with A a stiffness or a mass.
    what : str
        Name of the functions in the error.

    Raises
    ------
    ConvergenceError
        If an entry is off by more than the tolerance.
    """
    gram = functions.T @ images
    n, m = gram.shape
    deviation = float(np.abs(gram - np.eye(n, m, m - n)).max())
    if not deviation <= tolerance:
        raise ConvergenceError(
            f"{what} are not orthonormal: their Gram matrix is off by {deviation:.1e}; "
            "check the mesh for slivers"
        )
