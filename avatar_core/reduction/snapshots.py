"""Proper orthogonal decomposition, the rival of PGD: the best that any n modes can do.

The modes of snapshots U are the left singular vectors of M^(1/2) U D^-1 (Eckart & Young,
Psychometrika 1, 1936). M is the mass of the norm in space. D is the size of each snapshot where
errors are relative. POD needs every snapshot, and so every solution, before it begins.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from avatar_core.errors import ConvergenceError
from avatar_core.reduction.separated import SeparatedField


def pod(
    snapshots: ArrayLike, rank: int, mass: ArrayLike | None = None, relative: bool = False
) -> SeparatedField:
    """Return the leading POD modes of snapshots, U ~ X Y^T with X^T M X = I.

    Parameters
    ----------
    snapshots : array_like, shape (n_dofs, n_loads)
        U, one solution a column.
    rank : int
        Number of modes at most, at least 0.
    mass : array_like, shape (n_dofs,), optional
        M, lumped, of the norm in space, positive. The default is 1 everywhere.
    relative : bool
        Whether each snapshot counts relative to its own norm.

    Returns
    -------
    SeparatedField
        Space functions X, shape (n_dofs, r), and load functions Y = U^T M X, shape (n_loads, r).

    Raises
    ------
    ConvergenceError
        If all snapshots are zero, a number is not finite, the rank is negative or a mass is not
        positive.

    Examples
    --------
    >>> U = np.linalg.solve(K.toarray(), F)
    >>> best = av.mor.pod(U, rank=12)
    >>> np.allclose(best.evaluate(), U)
    True
    """
    u = np.asarray(snapshots, float)
    if u.ndim != 2 or not np.isfinite(u).all() or not u.any():
        raise ConvergenceError(
            f"snapshots of shape {u.shape} have no modes; give finite columns that are not all zero"
        )
    if rank < 0:
        raise ConvergenceError(f"the rank is {rank}; give 0 or more modes")
    lumped = np.ones(len(u)) if mass is None else np.asarray(mass, float)
    if lumped.shape != (len(u),) or not (np.isfinite(lumped) & (lumped > 0.0)).all():
        raise ConvergenceError(
            f"the mass of shape {lumped.shape} is no norm; give {len(u)} positive numbers"
        )
    root = np.sqrt(lumped)[:, None]
    scaled = root * u
    size = np.linalg.norm(scaled, axis=0)
    counted = scaled / np.where(size > 0.0, size, 1.0) if relative else scaled
    left, value, _ = np.linalg.svd(counted, full_matrices=False)
    left = left[:, : min(rank, np.count_nonzero(value > value[0] * np.finfo(float).eps))]
    return SeparatedField(left / root, scaled.T @ left)
