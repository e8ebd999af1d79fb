"""Finite element responses of an organ, and their interpolation through a grid.

The paper stores displacements u(x, s) at the points of one grid common to all organs. Interpolation
to the grid and back gives u(x) ~ sum_c t_c(x) sum_k l_k(x_c) u_k. Here l are the barycentric
coordinates of the mesh at the grid points x_c (outside, those of the closest point) and t trilinear
weights.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from avatar_core.common.arrays import FloatArray
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.norms import relative_l2
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import TetMesh

BoolArray = NDArray[np.bool_]


def unit_load_response(
    mesh: TetMesh, clamped: BoolArray, centers: FloatArray, radius: float
) -> FloatArray:
    """Return displacements under unit patch loads along x, y, z at each centre.

    The material is the default one. The result has the shape (n_vertices, 3, 3 n) [m/N].

    clamped : ndarray of bool, shape (n_faces,), over mesh.boundary_faces
    centers : ndarray, shape (n, 3) [m]
    radius : radius of the patches [m]
    """
    elasticity = Elasticity(mesh, Material(), clamped)
    solution = elasticity.solve(patch_loads(elasticity, centers, radius))
    return elasticity.at_vertices(solution).reshape(len(mesh.vertices), 3, -1)


def relative_errors(found: FloatArray, wanted: FloatArray, mesh: TetMesh) -> FloatArray:
    """Return |u - u_ref| / |u_ref| in L2 over the organ for each load, shape (n_loads,).

    found, wanted : ndarray, shape (n_vertices, 3, n_loads), at the vertices of the mesh
    """
    shape = (len(mesh.lumped_mass), -1)
    return relative_l2(found.reshape(shape), wanted.reshape(shape), mesh.lumped_mass)


def carried(matrix: sp.csr_matrix, field: FloatArray) -> FloatArray:
    """Apply a sparse map (n, n_vertices) to a field of shape (n_vertices, 3, m)."""
    return (matrix @ field.reshape(len(field), -1)).reshape(matrix.shape[0], *field.shape[1:])


def trilinear(
    points: FloatArray, origin: FloatArray, spacing: float
) -> tuple[FloatArray, sp.csr_matrix]:
    """Return points of an infinite grid around some points, and trilinear interpolation from them.

    However fine the grid, only these points are needed. Returns corners, ndarray, shape (m, 3) [m],
    and a sparse matrix, shape (n, m).
    """
    place = (points - origin) / spacing
    cell = np.floor(place).astype(np.int64)
    part = place - cell
    offsets = np.array(list(product((0, 1), repeat=3)))
    index = (cell[:, None] + offsets).reshape(-1, 3)
    weight = np.prod(np.where(offsets, part[:, None], 1.0 - part[:, None]), axis=2)
    corners, column = np.unique(index, axis=0, return_inverse=True)
    row = np.repeat(np.arange(len(points)), len(offsets))
    matrix = sp.csr_matrix((weight.ravel(), (row, column.ravel())), (len(points), len(corners)))
    return origin + spacing * corners, matrix
