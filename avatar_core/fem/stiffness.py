"""Stiffness matrices of isotropic elasticity from products of scalar gradients.

Everything follows from G_iajb = int chi d_i phi_a d_j phi_b dx. Here phi_a are the shape functions
of one component, and chi is the volume fraction of the material in each tetrahedron:

    int chi div(u) div(v)          ->  G_iajb,
    int chi 2 eps(u):eps(v)        ->  delta_ij sum_k G_kakb + G_jaib,

with i, a of the test function v and j, b of the trial function u. This takes a fifth of the time of
a vector-valued form. The form's 30 x 30 local entries are mostly products of the same few
gradients.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from skfem import CellBasis

from avatar_core.common.arrays import FloatArray


def unit_stiffness(
    basis: CellBasis, nodes: np.ndarray, volume_fraction: FloatArray | None = None
) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """Return the shear part for mu = 1 and the volumetric part for lambda = 1.

    basis : scikit-fem's scalar basis, whose quadrature is exact for products of gradients
    nodes : ndarray of int, shape (n_tets, n_shape), node of each shape function
    volume_fraction : ndarray, shape (n_tets,), or None, chi; None for 1

    Returns
    -------
    shear, volume : sparse, shape (3 n_nodes, 3 n_nodes)
        Matrices [m], numbered 3 node + component.
    """
    weight = basis.dx if volume_fraction is None else basis.dx * volume_fraction[:, None]
    gradient = np.array([shape[0].grad for shape in basis.basis])  # (n_shape, 3, n_tets, n_points)
    gradient = np.ascontiguousarray(gradient.transpose(2, 0, 1, 3))
    n_tets, n_shape = gradient.shape[:2]
    rows = gradient.reshape(n_tets, 3 * n_shape, -1)
    product = (rows * weight[:, None, :]) @ rows.transpose(0, 2, 1)
    product = product.reshape(n_tets, n_shape, 3, n_shape, 3).transpose(0, 1, 3, 2, 4)
    pattern = _Pattern(nodes)
    volume = pattern.assemble(product)
    shear = product.transpose(0, 1, 2, 4, 3).copy()
    trace = np.trace(product, axis1=3, axis2=4)
    for i in range(3):
        shear[..., i, i] += trace
    return pattern.assemble(shear), volume


class _Pattern:
    """Places of the 3 x 3 blocks of each tetrahedron in the matrix of all nodes."""

    def __init__(self, nodes: np.ndarray) -> None:
        n_tets, n_shape = nodes.shape
        self.n_nodes = int(nodes.max()) + 1
        pair = nodes[:, :, None].astype(np.int64) * self.n_nodes + nodes[:, None, :]
        key, place = np.unique(pair, return_inverse=True)
        row, self._column = np.divmod(key, self.n_nodes)
        self._start = np.searchsorted(row, np.arange(self.n_nodes + 1))
        n_local = n_tets * n_shape**2
        self._sum = sp.csr_matrix(
            (np.ones(n_local), (place.ravel(), np.arange(n_local))), shape=(len(key), n_local)
        )

    def assemble(self, blocks: FloatArray) -> sp.csr_matrix:
        """Return the sum of all blocks, shape (n_tets, n_shape, n_shape, 3, 3)."""
        data = (self._sum @ blocks.reshape(-1, 9)).reshape(-1, 3, 3)
        size = 3 * self.n_nodes
        return sp.bsr_matrix((data, self._column, self._start), shape=(size, size)).tocsr()
