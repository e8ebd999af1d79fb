"""Bodies of revolution in the undeformed coordinates (r, z), on quadratic quadrilaterals.

Without rotation about the axis, the deformation gradient in the directions (r, theta, z) is

    F = [[1 + u_r,r, 0, u_r,z], [0, 1 + u_r / r, 0], [u_z,r, 0, 1 + u_z,z]],

and the stored energy int psi(F) 2 pi r dr dz, psi of any material of
:mod:`avatar_core.fem.hyperelastic_materials`. Elements of full integration do not lock noticeably
up to the nu of 0.49 at which large deformation is solved (:mod:`avatar_core.fem.hyperelasticity`).
"""

from __future__ import annotations

import numpy as np
import rslab
import scipy.sparse as sp
from skfem import Basis, ElementQuad2, FacetBasis, MeshQuad

from avatar_core.fem.hyperelastic_materials import HyperelasticMaterial, determinant

# The entries of F that axial symmetry leaves: (r, r), (r, z), (z, r), (z, z), (theta, theta)
_ROW, _COLUMN = np.array([0, 0, 2, 2, 1]), np.array([0, 2, 0, 2, 1])
_DEGREE = 5  # degree of the quadrature, 3 x 3 points


class AxisymmetricBody:
    """A cylinder r <= ``ticks[-1]``, -z <= ``ticks[-1]``, clamped at its side and its bottom.

    Displacements (u_r, u_z) have the shape (n_nodes, 2), forces (2 n_nodes,).

    ticks : ndarray, edges of the elements along r and along -z, rising from 0

    places : ndarray, shape (n_nodes, 2), r and z of the nodes
    free : ndarray, degrees of freedom that are neither clamped nor on the axis
    top : ndarray of int, shape (n_edges, 9), nodes of the elements at the surface z = 0
    top_shape : ndarray, shape (n_edges, n_points, 9), values of their shape functions at the
        quadrature points of the surface
    top_radius, top_area : ndarray, shape (n_edges, n_points), r and 2 pi r dr at these points
    """

    def __init__(self, ticks: np.ndarray, material: HyperelasticMaterial) -> None:
        self.material = material
        mesh = MeshQuad.init_tensor(ticks, -ticks[::-1])
        inner = Basis(mesh, ElementQuad2(), intorder=_DEGREE)
        facets = mesh.facets_satisfying(_on_top, True)
        top = FacetBasis(mesh, ElementQuad2(), facets=facets, intorder=_DEGREE)
        self.nodes, self.top = inner.element_dofs.T, top.element_dofs.T
        self.places = inner.doflocs.T
        self._strain, self.volume = _strains(inner)
        self.top_shape = np.stack([np.asarray(shape[0]) for shape in top.basis], axis=-1)
        self.top_radius = top.global_coordinates()[0]
        self.top_area = 2.0 * np.pi * self.top_radius * top.dx
        r, z = inner.doflocs
        held = (r > ticks[-1] - 1e-9) | (z < 1e-9 - ticks[-1])
        self.free = np.flatnonzero(~np.stack([held | (r < 1e-9), held], axis=1).ravel())
        self._entries = self._lower_triangle()
        pattern = self._assembled(np.ones((len(self.nodes) + len(self.top), 18, 18)))
        self._analysis = rslab.analyze(pattern, path="ldlt", threads=1)

    @property
    def n_nodes(self) -> int:
        """Number of displacement nodes."""
        return len(self.places)

    def deformation_gradient(self, u: np.ndarray) -> np.ndarray:
        """Return F, shape (n_elements, 9, 3, 3)."""
        local = u[self.nodes].reshape(len(self.nodes), -1)
        F = np.zeros((*self.volume.shape, 3, 3))
        F[..., _ROW, _COLUMN] = np.einsum("eqak,ea->eqk", self._strain, local)
        return F + np.eye(3)

    def min_det(self, u: np.ndarray) -> float:
        """Return the least det F over the quadrature points."""
        return float(determinant(self.deformation_gradient(u)).min())

    def energy(self, u: np.ndarray) -> float:
        """Return int psi 2 pi r dr dz."""
        return float((self.volume * self.material.energy(self.deformation_gradient(u))).sum())

    def forces(self, u: np.ndarray) -> np.ndarray:
        """Return the internal forces, the derivative of the energy."""
        stress = self.material.stress(self.deformation_gradient(u))[..., _ROW, _COLUMN]
        return self.gathered(
            self.nodes, np.einsum("eqak,eqk,eq->ea", self._strain, stress, self.volume)
        )

    def gathered(self, nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the sum of the forces at the nodes of elements or edges, shape (2 n_nodes,)."""
        return np.bincount(_dofs(nodes).ravel(), values.ravel(), 2 * self.n_nodes)

    def factorize(self, u: np.ndarray, surface: np.ndarray) -> rslab.Ldlt:
        """Return LDL^T of the tangent over the free dofs.

        u : ndarray, shape (n_nodes, 2), displacement
        surface : ndarray, shape (n_edges, 18, 18), matrices that the surface adds to the tangent
        """
        A = self.material.tangent(self.deformation_gradient(u))
        A = A[..., _ROW[:, None], _COLUMN[:, None], _ROW, _COLUMN] * self.volume[..., None, None]
        left, right = (
            part.transpose(0, 2, 1, 3).reshape(len(self.nodes), 18, -1)
            for part in (self._strain @ A, self._strain)
        )
        inner = left @ right.transpose(0, 2, 1)
        return self._analysis.factor(self._assembled(np.concatenate([inner, surface])).data)

    def _lower_triangle(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which entries of the element matrices count, and their rows and columns."""
        number = np.full(2 * self.n_nodes, -1)
        number[self.free] = np.arange(len(self.free))
        dofs = number[_dofs(np.concatenate([self.nodes, self.top])).reshape(-1, 18)]
        row, column = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        kept = (column >= 0) & (row >= column)
        return kept, row[kept], column[kept]

    def _assembled(self, blocks: np.ndarray) -> sp.csc_matrix:
        """Return sum of the element matrices (n, 18, 18), first the body's, then its surface's."""
        kept, row, column = self._entries
        n = len(self.free)
        return sp.csc_matrix((blocks[kept], (row, column)), shape=(n, n))


def _dofs(nodes: np.ndarray) -> np.ndarray:
    """Return the degrees of freedom (..., n, 2) of u_r and u_z of each node."""
    return 2 * nodes[..., None] + np.arange(2)


def _on_top(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(x[1]) < 1e-9)


def _strains(basis: Basis) -> tuple[np.ndarray, np.ndarray]:
    """Return dF / du over ``_ROW`` and ``_COLUMN``, and 2 pi r dr dz.

    dF / du has the shape (n_elements, n_points, 18, 5).
    """
    r = basis.global_coordinates()[0]
    strain = np.zeros((*r.shape, 18, 5))
    for a, shape in enumerate(basis.basis):
        by_r, by_z = shape[0].grad
        strain[..., 2 * a, 0], strain[..., 2 * a, 1] = by_r, by_z
        strain[..., 2 * a + 1, 2], strain[..., 2 * a + 1, 3] = by_r, by_z
        strain[..., 2 * a, 4] = np.asarray(shape[0]) / r
    return strain, 2.0 * np.pi * r * basis.dx
