"""Terms of the stiffness, a sum of constant matrices with factors of the material.

K = sum_q theta_q K_q,    theta = mu, lambda; c mu, c lambda of an inclusion; k of each spring

The springs of each support come first, then those of each strip of a cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import rslab
import scipy.sparse as sp
from skfem import Basis, BilinearForm, ElementTetP1, ElementTetP2, ElementVector, MeshTet
from skfem.helpers import div

from avatar_core.fem.resection import Resection
from avatar_core.fem.stiffness import unit_stiffness
from avatar_core.fem.supports import boundary_mass
from avatar_core.geometry.mesh import TetMesh


@BilinearForm
def divergence(u, q, w):  # type: ignore[no-untyped-def]
    """Return q div(u), the coupling of displacement and pressure."""
    return q * div(u)


@BilinearForm
def pressure_mass(p, q, w):  # type: ignore[no-untyped-def]
    """Return p q."""
    return p * q


@BilinearForm
def scalar_mass(u, v, w):  # type: ignore[no-untyped-def]
    """Return u v, one component."""
    return u * v


class StiffnessTerms:
    """The constant matrices of a stiffness, common to all values of the material.

    quadratic : whether displacements are quadratic (P2, Taylor-Hood) or linear (P1)
    volume_fraction : ndarray, shape (n_tets,), volume fraction of an inclusion in each tetrahedron,
        or None
    supported : vertices of the faces of each support, ndarrays of shape (n, 3)
    resection : resection that ties the sides of a cut, or None
    """

    def __init__(
        self,
        mesh: TetMesh,
        quadratic: bool,
        volume_fraction: np.ndarray | None,
        supported: Sequence[np.ndarray],
        resection: Resection | None,
    ) -> None:
        self._organ, self._quadratic, self._volume_fraction = mesh, quadratic, volume_fraction
        self._supported, self._resection = supported, resection
        self._mesh = MeshTet(
            np.ascontiguousarray(mesh.vertices.T), np.ascontiguousarray(mesh.tets.T)
        )
        self._shape = ElementTetP2() if quadratic else ElementTetP1()
        self._basis = Basis(self._mesh, self._shape, intorder=2)
        self.n_nodes = self._basis.N

    @cached_property
    def unit_stiffness(self) -> tuple[sp.csr_matrix, ...]:
        """K_q of mu, lambda and those of an inclusion, (3 n_nodes, 3 n_nodes) [m].

        P1 and P2 use them; Taylor-Hood uses the first as well.
        """
        node = np.argsort(self.nodes_first(self._basis))[self._basis.element_dofs.T]
        if self._volume_fraction is None:
            return unit_stiffness(self._basis, node)
        outside = unit_stiffness(self._basis, node, 1.0 - self._volume_fraction)
        return outside + unit_stiffness(self._basis, node, self._volume_fraction)

    @property
    def mesh(self) -> MeshTet:
        """scikit-fem's mesh."""
        return self._mesh

    @cached_property
    def spring_mass(self) -> tuple[sp.csr_matrix, ...]:
        """Matrices int u.v da over each support, int [u].[v] da over each strip of a cut.

        Shapes (3 n_nodes, 3 n_nodes) [m^2].
        """
        order = self.nodes_first(self._basis)
        masses = (boundary_mass(self._mesh, self._shape, faces) for faces in self._supported)
        grounded = tuple(
            sp.kron(mass[order][:, order], sp.identity(3), format="csr") for mass in masses
        )
        if self._resection is None:
            return grounded
        nodes = np.stack([self.nodes_of(side) for side in self._organ.cut_faces])
        return grounded + self._resection.jump_mass(self._organ, nodes, self.n_nodes)

    def nodes_of(self, faces: np.ndarray) -> np.ndarray:
        """Return nodes of faces (n, 3): 3 (P1) or 6 (corners, then edges 01, 12, 20) columns."""
        if not self._quadratic:
            return faces
        n_vertices = self._mesh.nvertices
        edges = np.sort(self._mesh.edges, axis=0).astype(np.int64)
        key = edges[0] * n_vertices + edges[1]
        order = np.argsort(key)
        pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).astype(np.int64)
        found = np.searchsorted(key[order], pairs[..., 0] * n_vertices + pairs[..., 1])
        return np.concatenate([faces, n_vertices + order[found]], axis=1)

    @cached_property
    def mixed(self) -> tuple[sp.csr_matrix, sp.csr_matrix, sp.csr_matrix]:
        """Shear stiffness for mu = 1 [m], divergence [m^2] and pressure mass [m^3] of Taylor-Hood.

        Shapes (3 n_nodes, 3 n_nodes), (n_pressures, 3 n_nodes) and (n_pressures, n_pressures).
        """
        pressure = Basis(self._mesh, ElementTetP1(), intorder=2)
        displacement = Basis(self._mesh, ElementVector(self._shape), intorder=2)
        coupling = divergence.assemble(displacement, pressure).tocsr()
        coupling = coupling[:, self.nodes_first(displacement)]
        return self.unit_stiffness[0], coupling, pressure_mass.assemble(pressure).tocsr()

    @cached_property
    def mass(self) -> sp.csr_matrix:
        """Matrix int N_a N_b dx, shape (n_nodes, n_nodes) [m^3]."""
        matrix = scalar_mass.assemble(Basis(self._mesh, self._shape, intorder=4)).tocsr()
        order = self.nodes_first(self._basis)
        return matrix[order][:, order]

    @cached_property
    def pressure_factor(self) -> rslab.Ldlt:
        """The factorized pressure mass."""
        return rslab.ldlt(sp.csc_matrix(self.mixed[2]), threads=1)

    def nodes_first(self, basis: Basis) -> np.ndarray:
        """Return scikit-fem's number of each degree of freedom, in our order."""
        dofs = basis.nodal_dofs.T
        if self._quadratic:
            dofs = np.concatenate([dofs, basis.edge_dofs.T])
        return np.ascontiguousarray(dofs).ravel()
