"""Large deformation on quadratic tetrahedra: the energy of an organ and its two derivatives.

The weak form, in the undeformed organ: find u in H1_0 with

    int_Omega P(I + grad u) : grad v dx = int_Gamma t . v da   for all v,

the stationary points of Pi(u) = int psi(I + grad u) dx - f . u. Loads are dead: the nodal forces f
of :mod:`avatar_core.fem.patch_loads` keep their direction. :mod:`avatar_core.fem.newton` finds u.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import rslab
import scipy.sparse as sp
from skfem import Basis, ElementTetP2, MeshTet

from avatar_core.common.jit import compiled
from avatar_core.errors import MaterialError
from avatar_core.fem.elasticity import POISSON_RATIO_P2, Elasticity
from avatar_core.fem.hyperelastic_materials import HyperelasticMaterial, determinant
from avatar_core.geometry.mesh import TetMesh

# Four points, one for each coefficient of the linear F of an element. Only a rigid motion is then
# free of energy. The rule is exact for the stiffness at rest.
_QUADRATURE_DEGREE = 2
# Corners of the reference element: a strain that is linear in an element is extreme there.
_CORNERS = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


class Hyperelasticity:
    """The discrete hyperelastic problem of one mesh, material and clamp.

    Displacements are vectors of ``3 n_nodes`` values, in the order of ``self.linear``, the small
    strain problem on the same nodes: its ``patch_loads`` are loads here.

    Parameters
    ----------
    clamped : ndarray of bool, shape (n_faces,)
        Mask over ``mesh.boundary_faces``.

    Raises
    ------
    MaterialError
        For a Poisson's ratio at which quadratic tetrahedra lock, or an organ without a clamp.
    """

    def __init__(self, mesh: TetMesh, material: HyperelasticMaterial, clamped: np.ndarray) -> None:
        nu = material.linear.poisson_ratio
        if nu > POISSON_RATIO_P2:
            raise MaterialError(
                f"Poisson's ratio is {nu}; large deformation is solved up to {POISSON_RATIO_P2}, "
                "beyond which its elements lock"
            )
        if not clamped.any():
            raise MaterialError("an organ without a clamp has no equilibrium; clamp some faces")
        self.mesh, self.material = mesh, material
        self.linear = Elasticity(mesh, material.linear, clamped, "P2")
        tets = MeshTet(np.ascontiguousarray(mesh.vertices.T), np.ascontiguousarray(mesh.tets.T))
        basis = Basis(tets, ElementTetP2(), intorder=_QUADRATURE_DEGREE)
        self.nodes = np.ascontiguousarray(basis.element_dofs.T)  # as Elasticity numbers them
        self.gradients, self.volumes = _gradients(basis), basis.dx
        corners = Basis(tets, ElementTetP2(), quadrature=(_CORNERS, np.full(4, 1.0 / 24.0)))
        self._corner_gradients = _gradients(corners)

    @property
    def n_nodes(self) -> int:
        """Number of displacement nodes."""
        return self.linear.n_nodes

    @cached_property
    def free(self) -> np.ndarray:
        """Degrees of freedom that are not clamped, shape (n_free,)."""
        free = np.ones((self.n_nodes, 3), bool)
        free[self.linear.clamped_nodes] = False
        return np.flatnonzero(free)

    def deformation_gradient(self, displacement: np.ndarray) -> np.ndarray:
        """Return F = I + grad u at the quadrature points, shape (n_tets, 4, 3, 3)."""
        return self._deformation_gradient(displacement, self.gradients)

    def _deformation_gradient(self, displacement: np.ndarray, gradients: np.ndarray) -> np.ndarray:
        local = displacement.reshape(-1, 3)[self.nodes]
        return np.eye(3) + local.transpose(0, 2, 1)[:, None] @ gradients

    def min_det(self, displacement: np.ndarray) -> float:
        """Return least det F over quadrature points and corners; negative where one is inverted."""
        inside = determinant(self.deformation_gradient(displacement)).min()
        corners = self._deformation_gradient(displacement, self._corner_gradients)
        return float(min(inside, determinant(corners).min()))

    def energy(self, displacement: np.ndarray) -> float:
        """Return stored energy int psi dx [J]; infinite where a quadrature point is inverted."""
        F = self.deformation_gradient(displacement)
        if determinant(F).min() <= 0.0:
            return float("inf")
        return float((self.volumes * self.material.energy(F)).sum())

    def forces(self, displacement: np.ndarray) -> np.ndarray:
        """Return internal forces int P : grad v dx, (3 n_nodes,) [N]; reactions at the clamp."""
        stress = self.material.stress(self.deformation_gradient(displacement))
        weighted = self.volumes[..., None, None] * stress
        local = (self.gradients @ weighted.transpose(0, 1, 3, 2)).sum(axis=1)
        dofs = 3 * self.nodes[..., None] + np.arange(3)
        return np.bincount(dofs.ravel(), weights=local.ravel(), minlength=3 * self.n_nodes)

    def tangent(self, displacement: np.ndarray) -> sp.csc_matrix:
        """Return the lower triangle of the stiffness d forces / du over the free dofs [N/m].

        The pattern, and the order of ``data``, is the same for every displacement.
        """
        A = self.material.tangent(self.deformation_gradient(displacement))
        indices, indptr, slot = self._pattern
        data = np.zeros(len(indices) + 1)  # the last entry collects those of clamped nodes
        _assemble(self.gradients, self.volumes, A, slot, data)
        n = len(self.free)
        return sp.csc_matrix((data[:-1], indices, indptr), shape=(n, n))

    def factorize(self, tangent: sp.csc_matrix) -> rslab.Ldlt:
        """Return LDL^T of a tangent, which may be indefinite.

        ``inertia`` counts the pivots' signs.
        """
        return self._analysis.factor(tangent.data)

    @cached_property
    def rest_factor(self) -> rslab.Ldlt:
        """LDL^T of the tangent at rest, the stiffness of small strain."""
        return self.factorize(self.tangent(np.zeros(3 * self.n_nodes)))

    @cached_property
    def _analysis(self) -> rslab.LdltSymbolic:
        indices, indptr, _ = self._pattern
        n = len(self.free)
        pattern = sp.csc_matrix((np.ones(len(indices)), indices, indptr), shape=(n, n))
        return rslab.analyze(pattern, path="ldlt", threads=1)

    @cached_property
    def _pattern(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """CSC indices, CSC column starts, and the slot in ``data`` of every element entry.

        The slots, shape (n_tets, 465), follow the lower triangle of the element matrix row by row.
        """
        n = len(self.free)
        number = np.full(3 * self.n_nodes, -1, np.int64)
        number[self.free] = np.arange(n)
        dofs = number[3 * self.nodes[..., None] + np.arange(3)].reshape(-1, 30)
        row, column = np.tril_indices(30)
        high = np.maximum(dofs[:, row], dofs[:, column])
        low = np.minimum(dofs[:, row], dofs[:, column])
        entries, slot = np.unique(np.where(low < 0, n * n, low * n + high), return_inverse=True)
        entries = entries[entries < n * n]
        indptr = np.searchsorted(entries, n * np.arange(n + 1))
        slot = slot.reshape(low.shape).astype(np.int32)
        return (entries % n).astype(np.int32), indptr.astype(np.int32), slot


def _gradients(basis: Basis) -> np.ndarray:
    """Return gradients of the shape functions, shape (n_tets, n_points, 10, 3) [1/m]."""
    gradients = np.stack([shape[0].grad for shape in basis.basis])  # (10, 3, element, point)
    return np.ascontiguousarray(gradients.transpose(2, 3, 0, 1))


@compiled()
def _assemble(gradients, volumes, tangent, slot, data):  # type: ignore[no-untyped-def]
    """Add K_(ai)(bk) = sum_q V_q G_aJ A_iJkL G_bL of every element to the CSC values.

    gradients (n_tets, n_points, 10, 3), volumes (n_tets, n_points), tangent
    (n_tets, n_points, 3, 3, 3, 3), slot (n_tets, 465), data (n_entries + 1,)
    """
    block = np.empty((30, 30))
    half = np.empty((3, 3, 3))
    for e in range(len(slot)):
        block[:] = 0.0
        for q in range(volumes.shape[1]):
            G, A = gradients[e, q], tangent[e, q]
            for b in range(10):
                for i in range(3):
                    for j in range(3):
                        for k in range(3):
                            along = A[i, j, k, 0] * G[b, 0] + A[i, j, k, 1] * G[b, 1]
                            half[i, j, k] = volumes[e, q] * (along + A[i, j, k, 2] * G[b, 2])
                for a in range(b, 10):
                    for i in range(3):
                        for k in range(3):
                            block[3 * a + i, 3 * b + k] += (
                                G[a, 0] * half[i, 0, k]
                                + G[a, 1] * half[i, 1, k]
                                + G[a, 2] * half[i, 2, k]
                            )
        entry = 0
        for row in range(30):
            for column in range(row + 1):
                data[slot[e, entry]] += block[row, column]
                entry += 1
