"""Loads that may have deformed an organ, in few coefficients, and the displacement they cause.

The traction on the accessible surface is a Gaussian field of the length l and the standard
deviation s. In eigenfunctions of the surface's Laplacian, -div grad phi_i = lambda_i phi_i, its
coefficients are independent, with variances (Solin & Sarkka, Statistics and Computing 30, 2020)

    s^2 2 pi l^2 exp(-l^2 lambda_i / 2),

so that l and s change a diagonal and nothing else. Beside it the organ's weight may have turned:
a uniform body force, of which the vademecum holds the sag.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.vademecum.model import Vademecum

N_FUNCTIONS = 50  # of each direction; the shortest waves of a liver's front are some 5 cm
WEIGHT_SPREAD = 5e3  # of a turned weight along each axis, half of a liver's own [N/m^3]
_LEAST_AREA = 1e-3  # of a position, over the mean one


@dataclass(frozen=True, eq=False)
class LoadBasis:
    """Coefficients of loads, and the forces that they stand for.

    eigenvalues : ndarray, shape (n,), lambda [1/m^2]
    forces : ndarray, shape (n_positions, n), of each function at each load position [N per Pa m]
    n_weight : 3 if the vademecum holds the organ's sag, else 0
    """

    eigenvalues: FloatArray
    forces: FloatArray
    n_weight: int

    @property
    def size(self) -> int:
        """Number of coefficients: of the traction along x, y and z, then of the weight."""
        return 3 * len(self.eigenvalues) + self.n_weight

    def spread(self, traction: float, length: float) -> FloatArray:
        """Prior standard deviations of the coefficients, shape (size,).

        Parameters
        ----------
        traction : s [Pa]; length : l [m]
        """
        decay = np.exp(-(length**2) * self.eigenvalues / 4.0)
        each = traction * np.sqrt(2.0 * np.pi) * length * decay
        return np.concatenate([np.tile(each, 3), np.full(self.n_weight, WEIGHT_SPREAD)])

    def at_positions(self, coefficients: FloatArray) -> FloatArray:
        """Forces at load positions, shape (n_positions, 3, m) [N], of (size, m) coefficients."""
        n = len(self.eigenvalues)
        parts = coefficients[: 3 * n].reshape(3, n, -1)
        return np.asarray(np.einsum("pn,dnm->pdm", self.forces, parts))

    def displacement(
        self, vademecum: Vademecum, vertices: IntArray, coefficients: FloatArray
    ) -> FloatArray:
        """Displacement of some vertices by (size, m) coefficients, shape (n_vertices, 3, m) [m]."""
        forces = self.at_positions(coefficients).astype(np.float32)
        whole = vademecum.field.under(np.arange(len(forces)), forces)
        moved = _rows(vademecum.blocks.at_vertices(whole), vertices).astype(float)
        if self.n_weight and vademecum.body is not None:
            sag = _rows(vademecum.far.space, vertices) @ vademecum.body.weight
            moved += sag @ coefficients[-self.n_weight :]
        return moved.reshape(len(vertices), 3, -1)


def load_basis(vademecum: Vademecum, n: int = N_FUNCTIONS) -> LoadBasis:
    """The smoothest loads of a vademecum."""
    eigenvalues, functions, area = _eigenfunctions(vademecum.surface, n)
    n_weight = 0 if vademecum.body is None else 3
    return LoadBasis(eigenvalues, functions * area[:, None], n_weight)


def _eigenfunctions(surface: LoadSurface, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """lambda (n,) [1/m^2], phi (n_positions, n) with int phi^2 da = 1, area of each position."""
    vertices = np.ascontiguousarray(surface.centers, float)
    faces = np.ascontiguousarray(_triangles(surface), np.int64)
    area = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal()
    area = np.maximum(area, _LEAST_AREA * area.mean())
    scale = sp.diags(1.0 / np.sqrt(area))
    laplacian = (scale @ -igl.cotmatrix(vertices, faces) @ scale).tocsc()
    n = min(n, len(vertices) - 2)
    shift = -1e-6 * abs(laplacian).max()  # below the zero of each piece of the surface
    start = np.random.default_rng(0).standard_normal(len(area))
    value, vector = sla.eigsh(laplacian, n, sigma=shift, v0=start, tol=1e-6)
    return np.maximum(value, 0.0), vector / np.sqrt(area)[:, None], area


def _triangles(surface: LoadSurface) -> IntArray:
    """Triangles between all load positions: each face, or its four quarters."""
    six = surface.face_positions
    if six.shape[1] == 3:
        return six
    return np.concatenate([six[:, [0, 3, 5]], six[:, [3, 1, 4]], six[:, [5, 4, 2]], six[:, 3:]])


def _rows(space: FloatArray, vertices: IntArray) -> FloatArray:
    """Rows of some vertices of a field (3 n_vertices, n)."""
    return space[(3 * vertices[:, None] + np.arange(3)).ravel()]
