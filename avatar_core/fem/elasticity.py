"""Small-strain elasticity on tetrahedra, solved on an element that does not lock.

The weak form (paper Eq. 4 without the load coordinate): find u in H1_0 with

    int_Omega 2 mu eps(u):eps(v) + lambda div(u) div(v) dx = int_Gamma t . v da   for all v.

Quadratic tetrahedra (P2) are used up to nu = 0.49. Above, the Taylor-Hood pair (P2 displacement, P1
pressure) replaces lambda div(u) by a pressure p with int (div u - p / lambda) q dx = 0. Linear
tetrahedra (P1) lock at the nu of liver: at 0.48 their compliance is 0.72 of the true one. They are
there for timing very large meshes, never as a default.

With an inclusion, e.g. a tumour, Young's modulus is (1 + (c - 1) chi) E. The contrast is c, and chi
is the volume fraction of each tetrahedron inside. The stiffness is then affine in mu, lambda, c mu
and c lambda, which the coordinates of a vademecum use. It is also affine in the stiffness of every
support (:mod:`avatar_core.fem.supports`) and of every strip of a cut
(:mod:`avatar_core.fem.resection`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import rslab
import scipy.sparse as sp
from scipy.spatial import cKDTree

from avatar_core.errors import ConvergenceError, MaterialError, MeshError
from avatar_core.fem.resection import Resection, opened_to, require_parts_held
from avatar_core.fem.stiffness_terms import StiffnessTerms
from avatar_core.fem.supports import Support, require_held, with_stiffness
from avatar_core.geometry.mesh import TetMesh, make_mesh

Element = Literal["P1", "P2", "Taylor-Hood"]

# P2 stays within 2 % of Taylor-Hood up to here and locks beyond.
POISSON_RATIO_P2 = 0.49
_TRIED = 6  # loads, of two positions, on which single precision is tried
_BACKWARD = 1e-5  # imbalance in single precision, over the largest diagonal times displacement
_REFINED = 1e-4  # last relative change of a refined solution, whose own error is its square
SINGLE_ERROR = (
    1e-3  # largest relative error of single precision; that of the modes is six times as large
)


@dataclass(frozen=True)
class Material:
    """Isotropic linear elastic material; the defaults are the liver of the paper, Sec. 3.1.

    Attributes
    ----------
    young_modulus : float
        Young's modulus E > 0 [Pa].
    poisson_ratio : float
        Poisson's ratio, 0 <= nu < 0.5.

    Examples
    --------
    >>> soft = av.Material(young_modulus=5e3, poisson_ratio=0.45)
    >>> round(soft.plane_strain_modulus)
    6270
    """

    young_modulus: float = 0.17e6
    poisson_ratio: float = 0.48

    def __post_init__(self) -> None:
        if not (np.isfinite(self.young_modulus) and self.young_modulus > 0):
            raise MaterialError(
                f"Young's modulus is {self.young_modulus} Pa; it must be positive (liver: 0.17e6)"
            )
        if not 0 <= self.poisson_ratio < 0.5:
            raise MaterialError(
                f"Poisson's ratio is {self.poisson_ratio}; it must lie in [0, 0.5): an "
                "incompressible organ is approached by 0.4999"
            )

    @property
    def lame(self) -> tuple[float, float]:
        """Lame parameters (lambda, mu) [Pa]."""
        young, nu = self.young_modulus, self.poisson_ratio
        return young * nu / ((1 + nu) * (1 - 2 * nu)), young / (2 * (1 + nu))

    @property
    def plane_strain_modulus(self) -> float:
        """E* = E / (1 - nu^2), the modulus against a rigid tip (Hertz 1882) [Pa]."""
        return self.young_modulus / (1.0 - self.poisson_ratio**2)

    @property
    def element(self) -> Element:
        """The element that does not lock at this Poisson's ratio."""
        return "P2" if self.poisson_ratio <= POISSON_RATIO_P2 else "Taylor-Hood"


def factors_at(
    material: Material,
    contrast: float | None,
    supports: Sequence[Support] = (),
    resection: Resection | None = None,
) -> np.ndarray:
    """Return theta_q of K = sum_q theta_q K_q.

    The factors are mu and lambda, with an inclusion c mu and c lambda, then each spring's k.
    """
    lam, mu = material.lame
    theta = [mu, lam] if contrast is None else [mu, lam, contrast * mu, contrast * lam]
    ties = () if resection is None else resection.factors
    return np.array([*theta, *(support.stiffness for support in supports), *ties])


@dataclass(frozen=True, eq=False)
class Inclusion:
    """A part of the organ with another stiffness and the same Poisson's ratio.

    Attributes
    ----------
    volume_fraction : ndarray, shape (n_tets,)
        chi, the volume fraction of each tetrahedron inside.
    contrast : float
        Young's modulus inside over that outside, c > 0.
    """

    volume_fraction: np.ndarray
    contrast: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.contrast) and self.contrast > 0):
            raise MaterialError(
                f"the contrast is {self.contrast}; it is a ratio of Young's moduli and positive"
            )


class Elasticity:
    """The discrete elastic problem of one mesh and material, held by a clamp or supports.

    Displacements are vectors of ``3 n_nodes`` values, ``3 node + component``; nodes are the mesh
    vertices in their order, then (P2, Taylor-Hood) the edge midpoints.

    Parameters
    ----------
    clamped : ndarray of bool, shape (n_faces,)
        Mask over ``mesh.boundary_faces``. Without clamp and supports the organ is free, and only
        :attr:`stiffness` can be used.
    element : Element or None
        "P1", "P2", "Taylor-Hood" or None for ``material.element``.
    inclusion : Inclusion or None
        Inclusion or None; not with Taylor-Hood.
    supports : Sequence[Support]
        Springs beside the clamp; where two overlap, both act.
    resection : Resection or None
        Opening of the mesh's cut; None for a mesh without a cut.

    Raises
    ------
    MaterialError
        For an inclusion in a nearly incompressible organ.
    """

    def __init__(
        self,
        mesh: TetMesh,
        material: Material,
        clamped: np.ndarray,
        element: Element | None = None,
        inclusion: Inclusion | None = None,
        supports: Sequence[Support] = (),
        resection: Resection | None = None,
    ) -> None:
        self.mesh, self.material, self.inclusion = mesh, material, inclusion
        self.supports, self.resection = tuple(supports), resection
        self._clamped_faces, self._refines = clamped, False
        self.element: Element = element or material.element
        if inclusion is not None and self.element == "Taylor-Hood":
            raise MaterialError(
                f"an inclusion with Poisson's ratio above {POISSON_RATIO_P2} is not supported; "
                f"take at most {POISSON_RATIO_P2}"
            )
        self._terms = StiffnessTerms(
            mesh,
            self.element != "P1",
            inclusion.volume_fraction if inclusion else None,
            [mesh.boundary_faces[support.faces] for support in self.supports],
            resection,
        )
        self._skfem_mesh = self._terms.mesh
        self.n_nodes = self._terms.n_nodes
        self.clamped_nodes = np.unique(self.face_nodes[clamped])

    def refined(self) -> Elasticity:
        """Return the same problem with every tetrahedron split into eight.

        Vertices keep their numbers.
        """
        fine = self._skfem_mesh.refined(1)
        tets = fine.t.T.copy()
        turned = TetMesh(fine.p.T, tets).tet_volumes < 0
        tets[turned] = tets[turned][:, [0, 2, 1, 3]]
        mesh = make_mesh(fine.p.T, tets)
        clamped_at = self.mesh.vertices[self.mesh.boundary_faces]
        parent = cKDTree(clamped_at.mean(axis=1))
        center = mesh.vertices[mesh.boundary_faces].mean(axis=1)
        # a quarter's centroid lies nearest to its own parent's or in the parent's plane
        candidates = parent.query(center, k=4)[1]
        inside = np.array(
            [
                [_contains(clamped_at[face], point) for face in row]
                for row, point in zip(candidates, center, strict=True)
            ]
        )
        owner = candidates[np.arange(len(center)), inside.argmax(axis=1)]
        inclusion = self.inclusion
        if inclusion is not None:
            within = self._skfem_mesh.element_finder()
            parent_tet = within(*mesh.vertices[mesh.tets].mean(axis=1).T)
            inclusion = replace(inclusion, volume_fraction=inclusion.volume_fraction[parent_tet])
        supports = [replace(support, faces=support.faces[owner]) for support in self.supports]
        return Elasticity(
            mesh, self.material, self._clamped_faces[owner], self.element, inclusion, supports
        )

    def at(
        self,
        material: Material,
        contrast: float | None = None,
        stiffness: Mapping[str, float] | None = None,
        opened: float | None = None,
    ) -> Elasticity:
        """Return the same problem and element at other values, with the same matrices.

        Parameters
        ----------
        contrast : float or None
            Contrast of the inclusion.
        stiffness : Mapping[str, float] or None
            Stiffness of supports, by name [N/m^3]; those not given keep theirs.
        opened : float or None
            Opening of the cut, 0 to 1.
        """
        other = copy(self)
        other.material = material
        other.supports = with_stiffness(self.supports, stiffness or {})
        if self.inclusion is not None and contrast is not None:
            other.inclusion = replace(self.inclusion, contrast=contrast)
        other.resection = opened_to(self.resection, opened)
        for name in ("stiffness", "_factor", "_single_factor"):
            other.__dict__.pop(name, None)
        return other

    @cached_property
    def face_nodes(self) -> np.ndarray:
        """Nodes of each boundary face: 3 (P1) or 6 (corners, then edges 01, 12, 20) columns."""
        return self._terms.nodes_of(self.mesh.boundary_faces)

    @property
    def factors(self) -> np.ndarray:
        """Factors theta_q at this problem's material, :func:`factors_at`."""
        contrast = self.inclusion.contrast if self.inclusion else None
        return factors_at(self.material, contrast, self.supports, self.resection)

    @property
    def n_material(self) -> int:
        """Number of :attr:`factors` of the material; the factors of springs follow."""
        return 2 if self.inclusion is None else 4

    @cached_property
    def stiffness(self) -> sp.csr_matrix:
        """K with springs and without the clamp, shape (3 n_nodes,) * 2 [N/m] (P1 and P2)."""
        matrices = self._terms.unit_stiffness + self._terms.spring_mass
        return sum(t * matrix for t, matrix in zip(self.factors, matrices, strict=True)).tocsr()

    @property
    def diagonal(self) -> np.ndarray:
        """Diagonal of K, with Taylor-Hood without its volumetric part, (3 n_nodes,) [N/m]."""
        if self.element == "Taylor-Hood":
            return np.asarray(self._shear_and_springs.diagonal())
        return np.asarray(self.stiffness.diagonal())

    @property
    def _shear_and_springs(self) -> sp.csr_matrix:
        """K of Taylor-Hood without its pressures."""
        springs = zip(self.factors[self.n_material :], self._terms.spring_mass, strict=True)
        shear = self.material.lame[1] * self._terms.mixed[0]
        return sum((stiffness * mass for stiffness, mass in springs), shear).tocsr()

    def apply_term(self, q: int, displacement: np.ndarray) -> np.ndarray:
        """Return K_q u of one of :attr:`factors`, (3 n_nodes, n): [m^2], for springs [m^3]."""
        if q >= self.n_material:
            return np.asarray(self._terms.spring_mass[q - self.n_material] @ displacement)
        if self.element != "Taylor-Hood":
            return np.asarray(self._terms.unit_stiffness[q] @ displacement)
        shear, coupling, _ = self._terms.mixed
        if q == 0:
            return np.asarray(shear @ displacement)
        change = np.asfortranarray(coupling @ displacement)
        return np.asarray(coupling.T @ self._terms.pressure_factor.solve_many(change))

    @cached_property
    def _free(self) -> np.ndarray:
        free = np.ones((self.n_nodes, 3), bool)
        free[self.clamped_nodes] = False
        return np.flatnonzero(free)

    @cached_property
    def _factor(self) -> rslab.Ldlt:
        return rslab.ldlt(self._system, threads=1)  # two take a third more processor time

    @cached_property
    def _single_factor(self) -> rslab.Ldlt:
        return rslab.ldlt(self._system.astype(np.float32), threads=1)

    def factorize(self, single: bool = False) -> None:
        """Compute the factor of the system now, before several threads ask for it at once."""
        _ = self._single_factor if single or self._refines else self._factor

    @property
    def _system(self) -> sp.csc_matrix:
        """The matrix over the free degrees of freedom, and the pressures of Taylor-Hood."""
        if len(self.clamped_nodes) == 0 and not self.supports:
            raise MaterialError(
                "an organ without a clamp has no equilibrium; clamp some faces or give supports"
            )
        self._require_all_held()
        free = self._free
        if self.element == "Taylor-Hood":
            _, coupling, mass = self._terms.mixed
            coupling = coupling[:, free]
            shear = self._shear_and_springs[free][:, free]
            system = sp.bmat([[shear, -coupling.T], [-coupling, -mass / self.material.lame[0]]])
        else:
            system = self.stiffness[free][:, free]
        return sp.csc_matrix(system)

    def _require_all_held(self) -> None:
        """Raise MaterialError or MeshError if a part of the organ can move freely.

        The factorization of a singular system need not fail, and loads elsewhere do not reveal it.
        """
        mesh, young = self.mesh, self.material.young_modulus
        piece = mesh.pieces[mesh.boundary_tets]
        clamped, n_pieces = np.unique(piece[self._clamped_faces]), int(mesh.pieces.max()) + 1
        loose = np.setdiff1d(np.arange(n_pieces), clamped)
        if self.resection is not None:
            held = (self._clamped_faces, self.supports, young)
            require_parts_held(mesh, self.resection, *held)
        elif self.supports:
            for k in loose:
                require_held(mesh, self.supports, young, piece == k)
        elif len(loose):
            raise MeshError(
                f"{len(loose)} of {n_pieces} pieces connected by faces are not clamped; "
                "clamp a face of each or remove them"
            )

    @property
    def mass(self) -> sp.csr_matrix:
        """Consistent mass of one component for a unit density, (n_nodes, n_nodes) [m^3]."""
        return self._terms.mass

    @property
    def factor_bytes(self) -> int:
        """Memory of the factorization [bytes]."""
        return 12 * int(self._factor.factor_nnz)  # a value and its part of an index

    def solve(self, loads: np.ndarray | sp.spmatrix, single: bool = False) -> np.ndarray:
        """Return the displacements u = K^-1 f under nodal forces, zero at the clamp.

        Parameters
        ----------
        loads : ndarray or sparse, shape (3 n_nodes, n)
            Nodal forces [N].
        single : bool
            Solve in single precision, which takes half the time; see :meth:`single_error`.

        Returns
        -------
        ndarray, shape (3 n_nodes, n)
            Displacements [m].

        Raises
        ------
        MaterialError, MeshError
            For an organ, or a piece of it, that neither clamp nor supports hold.
        ConvergenceError
            If the factorization failed and the solution does not balance the load.
        """
        if self._refines and not single:
            dense = loads.toarray() if sp.issparse(loads) else np.asarray(loads)  # type: ignore[union-attr]
            if (refined := self._refined(dense)) is not None:
                return refined
        free, factor = self._free, self._single_factor if single else self._factor
        kind, most = (np.float32, 1e-2) if single else (np.float64, 1e-6)
        loads = loads.tocsr() if sp.issparse(loads) else np.asarray(loads)  # type: ignore[union-attr]
        right = np.zeros((factor.n, loads.shape[1]), kind, order="F")
        some = loads[free]
        right[: len(free)] = some.toarray() if sp.issparse(some) else some
        displacement = np.zeros(loads.shape, kind)
        displacement[free] = factor.solve_many(right)[: len(free)]
        balanced = self.apply(displacement[:, :1].astype(float))[free]
        imbalance = np.abs(balanced - right[: len(free), :1]).max()
        allowed = most * np.abs(right[:, :1]).max()
        if single:  # forces that nearly cancel are smaller than the rounding of their terms
            allowed += _BACKWARD * np.abs(self.diagonal * displacement[:, 0]).max()
        if not imbalance <= allowed:
            raise ConvergenceError(
                f"the linear solution leaves {imbalance:.1e} N out of balance; "
                "check the mesh for slivers"
            )
        return displacement

    def refining(self) -> Elasticity:
        """Return the same problem, solved in double precision by the factor in single precision.

        Each solution is refined by solutions for its residual (Langou et al., Proc. SC 2006). Two
        or three solutions in single precision replace one in double precision, and no
        double-precision factor is needed, which takes twice the time and memory. Where refinement
        does not converge, the double-precision factor is computed after all.
        """
        if self._refines:
            return self
        other = copy(self)
        other._refines = True
        return other

    def _refined(self, loads: np.ndarray) -> np.ndarray | None:
        """Return the solutions by refinement; None where it does not converge."""
        found, left, before = np.zeros(loads.shape), loads, np.inf
        while True:
            change = self.solve(left, single=True)
            found += change
            moved = _largest_ratio(change, found)
            if moved < _REFINED:
                return found
            if not moved < 0.1 * before:
                return None
            before, left = moved, loads - self.apply(found)

    def single_error(self, loads: sp.spmatrix) -> float:
        """Return the relative error of solutions in single precision, the largest of some loads.

        One step of refinement finds it: the solution for the residual in double precision. P2 has
        1e-4 at nu = 0.48 and 7e-4 at 0.49, Taylor-Hood 5e-5 at 0.495.
        """
        found = self.solve(loads, single=True).astype(float)
        left = np.asarray(loads - self.apply(found))
        error = np.linalg.norm(self.solve(left, single=True), axis=0)
        return float((error / np.linalg.norm(found, axis=0)).max())

    def single_serves(self, loads: sp.spmatrix) -> bool:
        """Return whether single precision is good enough for loads, by a trial on the first."""
        return self.single_error(loads.tocsc()[:, :_TRIED]) < SINGLE_ERROR

    def apply(self, displacement: np.ndarray) -> np.ndarray:
        """Return internal forces K u, shape (3 n_nodes, n) [N]; reactions appear at the clamp."""
        if self.element != "Taylor-Hood":
            return self.stiffness @ displacement
        terms = enumerate(self.factors)
        return np.asarray(sum(theta * self.apply_term(q, displacement) for q, theta in terms))

    def at_vertices(self, displacement: np.ndarray) -> np.ndarray:
        """Return the vertex part of nodal displacements, shape (3 n_vertices, n)."""
        return displacement[: 3 * len(self.mesh.vertices)]


def _contains(triangle: np.ndarray, point: np.ndarray) -> bool:
    """Return whether a point of the triangle's plane lies in it, with a little slack."""
    edges = (triangle[1] - triangle[0], triangle[2] - triangle[0])
    weight = np.linalg.lstsq(np.stack(edges, axis=1), point - triangle[0], rcond=None)[0]
    gap = point - triangle[0] - weight @ np.stack(edges)
    on_plane = np.linalg.norm(gap) < 1e-6 * np.linalg.norm(edges[0])
    return bool(on_plane and weight.min() > -1e-6 and weight.sum() < 1 + 1e-6)


def _largest_ratio(change: np.ndarray, solution: np.ndarray) -> float:
    """Return the largest ratio of the norms of columns; zero for columns that vanish."""
    part, whole = (np.linalg.norm(a.astype(float), axis=0) for a in (change, solution))
    return float((part / np.maximum(whole, 1e-300)).max(initial=0.0))
