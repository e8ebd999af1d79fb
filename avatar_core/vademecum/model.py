"""The computational vademecum: an organ's precomputed response to a load anywhere on its surface.

u(x, s) is one field, separated by regions of the load surface and by blocks of the organ. It
consists of global modes, common to all loads, and modes of the region that s lies in
(:mod:`avatar_core.reduction.block_field`). The contact compliance C(s, s') is the patch-averaged
displacement at s per patch force at s'. It is the Galerkin compliance Y Y^T of the global modes and
further ones, plus the exact remainder tapered to the neighborhood. It is symmetric positive
definite by construction, and exact at the load positions themselves.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from avatar_core.errors import ConvergenceError, LoadError
from avatar_core.fem.elasticity import Element, Material
from avatar_core.fem.patch_loads import LoadSurface, SurfacePoint
from avatar_core.fem.patch_on_plane import missed_between
from avatar_core.fem.resection import Resection
from avatar_core.fem.supports import Support
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.reduction.block_field import BlockField, Blocks
from avatar_core.reduction.near_field import LocalBlocks
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.at_values import Valued, at_values, ranges
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.display import ORGAN, WALLS, Display
from avatar_core.vademecum.large_deformation import LargeCertificate, LargeDeformation, Push
from avatar_core.vademecum.modal_mass import BodyResponse
from avatar_core.vademecum.parametric import ParametricResponse
from avatar_core.vademecum.record import Convergence, Provenance, VademecumInfo
from avatar_core.vademecum.tip_field import TipField

SCHEMA_VERSION = "6.2"
_AT_ONCE = 64  # points of a batch, so that its forces fill some megabytes


@dataclass(frozen=True)
class Vademecum:
    """An organ's precomputed mechanical response.

    Attributes
    ----------
    far : SeparatedField
        Global modes: space (3 n_vertices, rank) [m], load (3 n_positions, rank).
    blocks : Blocks
        Blocks of the mesh's vertices.
    field : BlockField
        Displacement over these blocks under unit forces in x, y, z at each load position [m/N].
    trailing : ndarray, shape (3 n_positions, n)
        Load functions of further modes. The contact compliance alone uses them.
    contact_near : LocalBlocks
        Tapered remainder of the contact compliance at load positions, symmetric [m/N].
    tip_field : TipField
        Smooth distance, shape and access of the surface under a tip.
    parametric : ParametricResponse or None
        Coordinates of the material. All fields above hold at one choice of their values
        (:meth:`at`).
    contrast : float or None
        Young's modulus inside the tumour over that outside; None without a tumour.
    supports : tuple of Support
        Springs that hold the organ beside the clamp of ``regions``.
    resection : Resection or None
        State of the cut: how far it is opened. None without a cut.
    large : LargeDeformation or None
        Response to large pushes, with the load's magnitude as a coordinate.
    body : BodyResponse or None
        Mass and weight in the global modes.
    display : Display or None
        Finer surface, and structures inside. None for the boundary of the mesh alone.

    Examples
    --------
    >>> u = v.displacement_at(point, 2.0)  # 2 N along the inward normal
    >>> u.shape == v.mesh.vertices.shape
    True
    >>> v.displacement_at(v.surface.centers[:5], [1.0, 1.0, 2.0, 2.0, 3.0]).shape[0]
    5
    >>> stiff = v.at(young=10e3, poisson=0.45)
    >>> stiff.material.poisson_ratio, v.ranges["poisson"]
    (0.45, (0.4, 0.48))
    """

    name: str
    mesh: TetMesh
    regions: Regions
    material: Material
    element: Element
    surface: LoadSurface
    far: SeparatedField
    blocks: Blocks
    field: BlockField
    trailing: np.ndarray
    contact_near: LocalBlocks
    tip_field: TipField
    convergence: Convergence
    provenance: Provenance
    certificate: Certificate | None = None
    parametric: ParametricResponse | None = None
    contrast: float | None = None
    supports: tuple[Support, ...] = ()
    resection: Resection | None = None
    large: LargeDeformation | None = None
    body: BodyResponse | None = None
    display: Display | None = None
    id: str = dataclasses.field(default="", compare=False)
    nbytes: int = dataclasses.field(default=0, compare=False)

    @property
    def n_modes(self) -> int:
        """Modes that show the displacement at a place: global ones, and those of its region."""
        return self.field.rank

    @property
    def contact_load(self) -> np.ndarray:
        """Y of the contact compliance Y Y^T + remainder, shape (3 n_positions, n)."""
        return np.hstack([self.far.load, self.trailing])

    def displacement(self, positions: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Displacement of all vertices under unit forces in x, y, z, shape (3 n_vertices, 3).

        Parameters
        ----------
        positions, weights : ndarray, shape (n,), a point of the surface as interpolated by
            :meth:`avatar_core.fem.patch_loads.LoadSurface.weights`
        """
        return self.blocks.at_vertices(self.field.combined(positions, weights))

    def compliance(
        self,
        positions: np.ndarray,
        weights: np.ndarray,
        other_positions: np.ndarray | None = None,
        other_weights: np.ndarray | None = None,
    ) -> np.ndarray:
        """Contact compliance between two surface points (the same by default), (3, 3) [m/N]."""
        if other_positions is None or other_weights is None:
            other_positions, other_weights = positions, weights
        left = self._contact_load_at(positions, weights)
        right = self._contact_load_at(other_positions, other_weights)
        n_positions = self.surface.n_positions
        near = self.contact_near.combined(other_positions, other_weights, n_positions)
        return left @ right.T + np.einsum("i,iab->ab", weights, near.reshape(-1, 3, 3)[positions])

    def _contact_load_at(self, positions: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Y at a point of the surface, shape (3, n)."""
        n = self.surface.n_positions
        parts = (
            np.einsum("i,idk->dk", weights, load.reshape(n, 3, load.shape[1])[positions])
            for load in (self.far.load, self.trailing)
        )
        return np.hstack(list(parts))

    def push(self, positions: np.ndarray, weights: np.ndarray, force: float) -> Push:
        """The organ under a force along the inward normal of a point of the surface.

        Parameters
        ----------
        positions, weights : ndarray, shape (n,), as of :meth:`displacement`
        force : f, negative to pull [N]
        """
        inward = -weights @ self.surface.normals[positions]
        inward /= np.linalg.norm(inward)
        moved = force * (self.displacement(positions, weights) @ inward)
        depth = force * float(inward @ self.compliance(positions, weights) @ inward)
        linear = Push(moved, depth, within=True)
        if self.large is None:
            return linear
        return self.large.added_to(linear, self.blocks, positions, weights)

    def push_to(
        self, positions: np.ndarray, weights: np.ndarray, depth: float
    ) -> tuple[float, Push]:
        """Force [N] that moves the patch inward by a depth [m], by Newton's method, and its push.

        Raises
        ------
        ConvergenceError
            If no force does within 30 steps.
        """
        force = depth / self.push(positions, weights, 1e-9).depth * 1e-9
        for _ in range(30):
            found, step = self.push(positions, weights, force), 1e-6 * force
            if abs(found.depth - depth) <= 1e-9 * abs(depth):
                return force, found
            slope = (self.push(positions, weights, force + step).depth - found.depth) / step
            force += (depth - found.depth) / slope
        raise ConvergenceError(
            f"no force was found that pushes {1e3 * depth:g} mm deep here; ask for less depth"
        )

    def displacement_at(self, point: ArrayLike, force: ArrayLike) -> np.ndarray:
        """Return the displacement of all vertices under a force at a point, or each of several.

        Where the vademecum holds large deformation, the part of the force along the normal deforms
        the organ nonlinearly; the part along the surface is added linearly.

        Parameters
        ----------
        point : array_like, shape (3,) or (k, 3)
            Points at most 5 mm off the accessible surface [m].
        force : float or array_like, shape (3,), (k,) or (k, 3)
            Force at each point, along the inward normal or as a vector [N].

        Returns
        -------
        ndarray, shape (n_vertices, 3) or (k, n_vertices, 3)
            Displacements [m]. Those of several points are not added.

        Raises
        ------
        LoadError
            If a point lies off the accessible surface, a number is not finite, or there is not one
            force for each point.
        """
        points, forces = np.asarray(point, float), np.asarray(force, float)
        if points.ndim < 2:
            if forces.size not in (1, 3):
                raise LoadError("a force is one or three finite numbers; give newtons")
            one = forces.reshape(1, 3) if forces.size == 3 else forces.reshape(1)
            return np.asarray(self.displacement_at(points.reshape(1, -1), one)[0])
        k = len(points)
        if points.shape != (k, 3) or forces.shape not in ((), (k,), (k, 3)):
            raise LoadError(
                f"points of shape {points.shape} with forces of shape {forces.shape}; give k "
                "points of three coordinates, and one number or three for each"
            )
        if not np.isfinite(forces).all():
            raise LoadError("a force is one or three finite numbers; give newtons")
        places = self.surface.nearest_each(points)
        normals = np.array([place.normal for place in places]).reshape(k, 3)
        vectors = forces if forces.ndim == 2 else -np.broadcast_to(forces, k)[:, None] * normals
        moved = np.empty((k, len(self.mesh.vertices), 3))
        for first in range(0, k, _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            moved[part] = self._moved(places[part], vectors[part])
        if self.large is not None:
            pressing = -np.einsum("kd,kd->k", vectors, normals)
            for i in np.flatnonzero(pressing):
                place = places[i]
                own = self.compliance(place.positions, place.weights)
                depth = float(pressing[i] * (place.normal @ own @ place.normal))
                linear = Push(moved[i].ravel(), depth, within=True)
                bent = self.large.added_to(linear, self.blocks, place.positions, place.weights)
                moved[i] = bent.displacement.reshape(-1, 3)
        return moved

    def _moved(self, places: Sequence[SurfacePoint], forces: np.ndarray) -> np.ndarray:
        """Return the linear displacement under forces (k, 3), each at its place, (k, n, 3) [m]."""
        k, unit = len(places), np.eye(3, dtype=np.float32)
        positions = np.array([place.positions for place in places])
        loads = np.zeros((*positions.shape, 3, k, 3), np.float32)
        for i, place in enumerate(places):
            loads[i, :, :, i] = place.weights.astype(np.float32)[:, None, None] * unit
        field = self.field.under(positions.ravel(), loads.reshape(-1, 3, 3 * k))
        by_axis = self.blocks.at_vertices(field).reshape(-1, k, 3)
        return np.asarray((by_axis * forces).sum(axis=2)).T.reshape(k, -1, 3)

    def compliance_at(self, point: ArrayLike, other: ArrayLike | None = None) -> np.ndarray:
        """Contact compliance at a point, or between two, shape (3, 3) [m/N].

        Entry (i, j) is the mean displacement of the patch at ``point`` along axis i under a unit
        force along axis j on the patch at ``other``, by default the same. Along the normal of one
        patch, what the interpolation between load positions misses is added
        (:mod:`avatar_core.fem.patch_on_plane`).

        Parameters
        ----------
        point, other : array_like, shape (3,) [m], at most 5 mm off the accessible surface

        Raises
        ------
        LoadError
            If a point lies off the accessible surface.
        """
        here = self.surface.nearest(point)
        there = here if other is None else self.surface.nearest(other)
        found = self.compliance(here.positions, here.weights, there.positions, there.weights)
        if other is not None:
            return found
        radius = self.surface.patch_radius
        places = self.surface.centers / radius
        missed = missed_between(places, here.positions[None], here.weights[None])[0]
        stiffness = self.material.plane_strain_modulus * radius
        return found + missed / stiffness * np.outer(here.normal, here.normal)

    def at(self, values: Mapping[str, float] | None = None, /, **named: float) -> Vademecum:
        """The same organ at other values of its coordinates; takes some tenths of a second.

        Parameters
        ----------
        values : mapping of str to float, optional
            Values by name of a coordinate, for names with a dot, e.g. ``{"support.dome": 1e6}``.
        **named : float
            Values by name, e.g. ``poisson=0.45``. A coordinate that is not given keeps its value.
            ``young`` [Pa] is a coordinate of every vademecum, since displacements are proportional
            to 1 / E. Where supports hold the organ, their stiffness must be a coordinate too.

        Raises
        ------
        CoordinateError, MaterialError
            If the vademecum has no such coordinate, or the value lies out of its range.
        """
        found = at_values(self._valued, self.parametric, {**(values or {}), **named})
        return replace(self, **vars(found))

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of each coordinate, by name, while the others stay.

        "young" is among them only where supports limit it.
        """
        return ranges(self._valued, self.parametric)

    @property
    def _valued(self) -> Valued:
        return Valued(**{field.name: getattr(self, field.name) for field in fields(Valued)})

    def with_certificate(self, certificate: Certificate) -> Vademecum:
        """The same vademecum with a certificate of its errors."""
        return replace(self, certificate=certificate)

    def with_notices(self, *notices: str) -> Vademecum:
        """The same vademecum with more notices of its build."""
        said = (*self.provenance.notices, *notices)
        return replace(self, provenance=replace(self.provenance, notices=said))

    def with_large_certificate(self, certificate: LargeCertificate) -> Vademecum:
        """The same vademecum with a certificate of its errors at large deformation."""
        assert self.large is not None
        return replace(self, large=replace(self.large, certificate=certificate))

    @property
    def surface_vertices(self) -> np.ndarray:
        """Rest positions of the displayed vertices, shape (n, 3) float32 [m]."""
        if self.display is not None:
            return self.display.vertices
        return self.mesh.vertices[self.mesh.surface_vertices].astype(np.float32)

    @property
    def surface_faces(self) -> np.ndarray:
        """Displayed triangles over :attr:`surface_vertices`, of structures too, shape (m, 3)."""
        if self.display is not None:
            return self.display.faces
        return np.searchsorted(self.mesh.surface_vertices, self.mesh.boundary_faces)

    @property
    def organ_faces(self) -> np.ndarray:
        """Those of :attr:`surface_faces` that are the organ's own, shape (m, 3)."""
        return self.surface_faces if self.display is None else self.display.faces_of(0)

    @property
    def structures(self) -> dict[str, np.ndarray]:
        """Triangles of what is displayed inside, by name, over :attr:`surface_vertices`."""
        display = self.display
        if display is None:
            return {}
        names = [name for name in display.names if name not in (ORGAN, WALLS)]
        return {name: display.faces_of(1 + k) for k, name in enumerate(names)}

    @property
    def cut_walls(self) -> np.ndarray:
        """Triangles of both walls of a cut, over :attr:`surface_vertices`, shape (m, 3)."""
        display = self.display
        if display is None or display.names[-1] != WALLS:
            return np.zeros((0, 3), np.int32)
        return display.faces_of(len(display.names) - 1)

    @property
    def clamped_faces(self) -> np.ndarray:
        """Which of :attr:`organ_faces` are clamped, shape (m,) bool."""
        return self._displayed(self.regions.clamped)

    @property
    def supported_faces(self) -> np.ndarray:
        """Which of :attr:`organ_faces` springs hold, shape (m,) bool."""
        faces = [support.faces for support in self.supports]
        return self._displayed(np.any([np.zeros_like(self.regions.clamped), *faces], axis=0))

    @property
    def accessible_faces(self) -> np.ndarray:
        """Which of :attr:`organ_faces` tools reach, shape (m,) bool."""
        return self._displayed(self.regions.accessible)

    def _displayed(self, region: np.ndarray) -> np.ndarray:
        """A region of the mesh's boundary, on the faces of the displayed organ."""
        if self.display is None:
            return region
        held = np.zeros(len(self.mesh.vertices))
        held[self.mesh.boundary_faces[region]] = 1.0
        part = (held[self.display.corners] * self.display.weights).sum(axis=1)
        return np.asarray((part[self.organ_faces] > 0.5).all(axis=1))

    def info(self) -> VademecumInfo:
        """The summary."""
        c = self.certificate or Certificate.unknown()
        return VademecumInfo(
            id=self.id,
            name=self.name,
            source=self.provenance.source,
            schema_version=SCHEMA_VERSION,
            axes=self.provenance.axes,
            n_vertices=len(self.mesh.vertices),
            n_surface_vertices=len(self.mesh.surface_vertices),
            n_load_positions=self.surface.n_positions,
            n_modes=self.n_modes,
            n_regions=self.field.n_regions,
            bytes=self.nbytes,
            young_modulus=self.material.young_modulus,
            poisson_ratio=self.material.poisson_ratio,
            patch_radius=self.surface.patch_radius,
            volume=self.mesh.volume,
            converged=self.convergence.converged,
            l2_mean=c.l2_mean,
            l2_worst=c.l2_worst,
            contact_mean=c.contact_mean,
            contact_worst=c.contact_worst,
            force_mean=c.tip_force_mean,
            force_worst=c.tip_force_worst,
            build_cpu_seconds=c.build_cpu_seconds,
        )
