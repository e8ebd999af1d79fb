"""Resolved contact of rigid frictionless tips with the elastic organ: Signorini's problem.

A tip is pushed in along -n to the depth d below a place x_0. It takes the room above -d + f(r),
with its profile f (:mod:`avatar_core.geometry.tip`), the distance r from its axis, and z = (x -
x_0).n. In small strain and along the fixed direction n, the surface keeps out of that room where

    -u.n >= d + z - f(r),   p >= 0,   p (-u.n - d - z + f(r)) = 0   for r < radius.

p is the traction along -n per area of the surface (Signorini 1933; Kikuchi & Oden, Contact Problems
in Elasticity, 1988). p is linear on the boundary's triangles, cut off at the tip's rim, and the
condition holds on average over each of its hats. K^-1 is condensed to C = B^T K^-1 B on the hats
that a tip can reach. A small linear complementarity problem remains for each depth: C p - b >= 0, p
>= 0, p.(C p - b) = 0.

A frictionless ball has no moment about its centre. These tractions have one if the contact lies to
the side of n. :func:`through_centre` gives the n without a moment.

The error falls with the elements; :func:`avatar_core.geometry.refinement.refine` makes them small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import brentq, nnls

from avatar_core.errors import ContactError, ConvergenceError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.triangles import subdivided_rule, triangle_shape
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.tip import Tip

REACH = 1.4  # radius of the candidate surface over the contact radius on a half-space
_FACING = 0.2  # least cosine of a face's normal to the axis
_PIECES = 4  # pieces of a face's edge, for the quadrature: the rim cuts faces
_LEAST_AREA = 0.02  # area of a hat within the rim, over the mean area
_BATCH = 64  # columns solved at once
_MOST_CHANGES = 60  # changes of the active set


@dataclass(frozen=True, eq=False)
class Push:
    """A tip over a place, pushed in along the axis.

    Attributes
    ----------
    point : ndarray, shape (3,)
        x_0 on the surface, where the depth is zero [m].
    axis : ndarray, shape (3,)
        Unit vector out of the organ.
    """

    tip: Tip
    point: np.ndarray
    axis: np.ndarray


@dataclass(frozen=True, eq=False)
class Touch:
    """Force and contact of one tip.

    Attributes
    ----------
    depth : float
        d [m].
    force : float
        Force of the organ on the tip along the axis [N].
    radius : float
        Radius of the disc with the area of the contact [m].
    lean : ndarray, shape (3,)
        Vector across the axis: the tangent of the angle between the axis and the line from the
        centre of pressure to the ball's centre. Zero for other tips.
    vertices : ndarray of int, shape (n,)
        Vertices of the mesh under pressure.
    pressures : ndarray, shape (n,)
        p at these vertices [Pa].
    """

    depth: float
    force: float
    radius: float
    lean: np.ndarray
    vertices: np.ndarray
    pressures: np.ndarray


@dataclass(frozen=True, eq=False)
class Contact:
    """The contact of one or several tips at once.

    Attributes
    ----------
    touches : tuple[Touch, ...]
        Contact of each tip.
    loads : ndarray, shape (3 n_nodes,)
        Nodal forces on the organ [N].
    violation : float
        Worst mean penetration over a hat, over the largest depth.
    """

    touches: tuple[Touch, ...]
    loads: np.ndarray
    violation: float

    @property
    def forces(self) -> np.ndarray:
        """Force on each tip along its axis, shape (n_tips,) [N]."""
        return np.array([touch.force for touch in self.touches])


@dataclass(frozen=True, eq=False)
class _Zone:
    """The hats that one tip can reach; hats at its rim are cut off there.

    vertices : (m,), vertices of the hats
    loads : sparse (3 n_nodes, m), nodal forces of unit pressures along -n [m2]
    areas : (m,), integral of each hat [m2]
    heights : (m,), integral of each hat times (z - f) [m3]
    aside : (m, 3), mean place across the axis [m]
    below : (m,), depth of the touching point below the ball's centre, 0 for other tips [m]
    outermost : (m,) bool, hats beyond which the tip goes on
    """

    vertices: np.ndarray
    loads: sp.csc_matrix
    areas: np.ndarray
    heights: np.ndarray
    aside: np.ndarray
    below: np.ndarray
    outermost: np.ndarray


class CondensedContact:
    """An organ condensed to the surface that some tips can reach, for depths up to a largest one.

    One factorization and one condensation serve all tips, alone or together.

    Parameters
    ----------
    elasticity : Elasticity
        Elasticity on a mesh fine around the tips.
    pushes : Sequence[Push]
        One push for each tip.
    deepest : ndarray, shape (n_pushes,), or float
        Largest depth asked for later [m].
    reach : float
        Radius of the candidate surface over the contact radius on a half-space.
    progress : Callable[[float], None] or None
        Called with the finished fraction of the condensation.

    Raises
    ------
    ContactError
        If a tip meets no surface that faces it.
    """

    def __init__(
        self,
        elasticity: Elasticity,
        pushes: Sequence[Push],
        deepest: np.ndarray | float,
        reach: float = REACH,
        progress: Callable[[float], None] | None = None,
    ) -> None:
        self.elasticity, self.pushes = elasticity, tuple(pushes)
        self.deepest = np.broadcast_to(np.asarray(deepest, float), (len(self.pushes),))
        pairs = zip(self.pushes, self.deepest, strict=True)
        self._zones = [_zone(elasticity, push, depth, reach) for push, depth in pairs]
        loads, self._columns = _distinct(self._zones, self.pushes)
        self._compliance = _condensed(elasticity, loads, progress)

    @property
    def first_depths(self) -> np.ndarray:
        """Depth at which each tip first touches, to an element, shape (n_pushes,) [m].

        The depth is far below zero in a hollow narrower than the tip, whose sides touch first.
        """
        return np.array([(-zone.heights / zone.areas).min() for zone in self._zones])

    def solve(self, acting: Sequence[int], depths: Sequence[float]) -> Contact:
        """Return the contact of some of the pushes at once.

        Parameters
        ----------
        acting : Sequence[int]
            Numbers of the pushes that act.
        depths : Sequence[float]
            d of each of them [m].

        Raises
        ------
        ContactError
            If a depth is larger than the deepest, or the contact leaves the candidate surface.
        ConvergenceError
            If no set of active pressures satisfies the conditions.
        """
        zones = [self._zones[k] for k in acting]
        for k, depth in zip(acting, depths, strict=True):
            if not depth <= self.deepest[k] * (1 + 1e-9):
                raise ContactError(
                    f"a depth of {1e3 * depth:g} mm is beyond the deepest prepared, "
                    f"{1e3 * self.deepest[k]:g} mm; prepare a larger one"
                )
        columns = np.concatenate([self._columns[k] for k in acting])
        needed = np.concatenate(
            [zone.heights + d * zone.areas for zone, d in zip(zones, depths, strict=True)]
        )
        compliance = self._compliance[np.ix_(columns, columns)]
        pressure = complementary(compliance, needed)
        areas = np.concatenate([zone.areas for zone in zones])
        worst = ((needed - compliance @ pressure) / areas).max() / max(max(depths), 1e-12)
        split = np.split(pressure, np.cumsum([len(zone.areas) for zone in zones])[:-1])
        parts = list(zip(zones, depths, split, strict=True))
        loads = sum(zone.loads @ p for zone, _, p in parts)
        return Contact(tuple(_touch(*part) for part in parts), np.asarray(loads), float(worst))

    def displacements(self, contacts: Sequence[Contact]) -> np.ndarray:
        """Return displacements of the mesh's vertices, shape (n_contacts, n_vertices, 3) [m]."""
        solution = self.elasticity.solve(np.stack([contact.loads for contact in contacts], axis=1))
        return self.elasticity.at_vertices(solution).T.reshape(len(contacts), -1, 3)


def through_centre(push: Push, touch: Touch) -> Push:
    """Return the push of the same ball in the same place, its axis turned by ``touch.lean``.

    Its force then acts along the line from the centre of pressure to the ball's centre. A few turns
    find the axis with no lean. Other tips do not change.
    """
    axis = push.axis - touch.lean
    axis /= np.linalg.norm(axis)
    to_centre = push.tip.offset - touch.depth
    return Push(push.tip, push.point + to_centre * (push.axis - axis), axis)


def half_space_radius(tip: Tip, depth: float) -> float:
    """Return the contact radius a on a half-space at a depth [m]; at most the tip's own radius."""
    if tip.shape == "flat":
        return tip.radius

    def missing(a: float) -> float:
        return float(tip.depth(np.array(a))) - depth

    low, high = 1e-6 * tip.radius, (1.0 - 1e-6) * tip.radius
    if missing(high) <= 0:
        return tip.radius
    return float(brentq(missing, low, high)) if missing(low) < 0 else low


def complementary(compliance: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """Return p >= 0 with C p - b >= 0 and p.(C p - b) = 0, by a primal-dual active set.

    Source: Hintermueller, Ito & Kunisch, SIAM J. Optim. 13:865 (2002). If the set comes back to an
    earlier one, non-negative least squares find p: |L^T p - L^-1 b| with C = L L^T.

    compliance : ndarray, shape (n, n), C, symmetric positive definite
    needed : ndarray, shape (n,), b

    Raises
    ------
    ConvergenceError
        If C is not positive definite or least squares stop early too.
    """
    try:
        return _by_active_set(compliance, needed)
    except (LinAlgError, RuntimeError) as error:
        raise ConvergenceError(
            f"no set of active pressures satisfies the contact conditions ({error}); "
            "check the mesh for slivers under the tip"
        ) from error


def _by_active_set(compliance: np.ndarray, needed: np.ndarray) -> np.ndarray:
    active = needed > 0
    for _ in range(_MOST_CHANGES):
        pressure = _balanced(compliance, needed, active)
        changed = np.where(active, pressure > 0, compliance @ pressure < needed)
        if np.array_equal(changed, active):
            return pressure
        active = changed
    factor = cholesky(compliance, lower=True)
    start = nnls(factor.T, solve_triangular(factor, needed, lower=True))[0]
    return np.maximum(_balanced(compliance, needed, start > 0), 0.0)


def _balanced(compliance: np.ndarray, needed: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Return the pressures with C p = b on the active hats, zero on the others."""
    pressure = np.zeros(len(needed))
    if active.any():
        block = cho_factor(compliance[np.ix_(active, active)])
        pressure[active] = cho_solve(block, needed[active])
    return pressure


def _touch(zone: _Zone, depth: float, pressure: np.ndarray) -> Touch:
    active = pressure > 0
    load = zone.areas * pressure
    below = float(load @ zone.below)
    if (active & zone.outermost).any():
        raise ContactError(
            "the contact is larger than the surface prepared for it; raise its reach"
        )
    return Touch(
        depth=float(depth),
        force=float(load.sum()),
        radius=float(np.sqrt(zone.areas[active].sum() / np.pi)),
        lean=(load @ zone.aside) / below if below > 0.0 else np.zeros(3),
        vertices=zone.vertices[active],
        pressures=pressure[active],
    )


def _zone(elasticity: Elasticity, push: Push, deepest: float, reach: float) -> _Zone:
    """Return the hats within reach of a tip, integrated on the faces that face it."""
    mesh = elasticity.mesh
    radius = reach * half_space_radius(push.tip, deepest) + 2.0 * _edge_at(mesh, push.point)
    radius = min(push.tip.radius, radius)
    faces = _facing(elasticity, push, 1.5 * np.hypot(radius, deepest))
    barycentric, weight = subdivided_rule(_PIECES)
    corners = mesh.boundary_faces[faces]
    points = np.einsum("qk,fkd->fqd", barycentric, mesh.vertices[corners]) - push.point
    rho, z = _cylindrical(points, push.axis)
    under = rho < push.tip.radius
    area = mesh.face_areas[faces][:, None] * weight * under
    height = z - np.where(under, push.tip.height(np.minimum(rho, push.tip.radius)), 0.0)
    n = len(mesh.vertices)

    def over_hats(values: np.ndarray) -> np.ndarray:
        moments = np.einsum("fq,qk->fk", values, barycentric)
        return np.bincount(corners.ravel(), weights=moments.ravel(), minlength=n)

    areas, heights = over_hats(area), over_hats(area * height)
    far = _cylindrical(mesh.vertices - push.point, push.axis)[0] > radius
    kept = areas > (_LEAST_AREA * areas[areas > 0].mean() if area.any() else 0.0)
    chosen = kept & ~far if radius < push.tip.radius else kept
    if not chosen.any():
        raise ContactError("the tip meets no surface that faces it; check its place and its axis")
    at_border = np.zeros(n, bool)
    at_border[corners[(kept & ~chosen)[corners].any(axis=1)]] = True
    vertices = np.flatnonzero(chosen)
    across = points - z[..., None] * push.axis
    aside = np.stack([over_hats(area * x) for x in np.moveaxis(across, -1, 0)], axis=1)
    aside = aside[vertices] / areas[vertices, None]
    below = np.zeros(len(vertices))
    if push.tip.shape == "sphere":
        rim = np.minimum(np.linalg.norm(aside, axis=1), push.tip.radius)
        below = push.tip.radius - push.tip.height(rim)
    loads = _hat_loads(elasticity, faces, area, barycentric)[:, vertices]
    return _Zone(
        vertices,
        sp.kron(loads, -push.axis[:, None], format="csc"),
        areas[vertices],
        heights[vertices],
        aside,
        below,
        at_border[vertices],
    )


def _facing(elasticity: Elasticity, push: Push, distance: float) -> np.ndarray:
    """Return the boundary faces that face the axis and come within a distance of the place."""
    mesh = elasticity.mesh
    corners = mesh.vertices[mesh.boundary_faces]
    near = np.linalg.norm(corners - push.point, axis=2).min(axis=1) < distance
    facing = mesh.face_area_normals @ push.axis > _FACING * mesh.face_areas
    return np.flatnonzero(near & facing)


def _edge_at(mesh: TetMesh, point: np.ndarray) -> float:
    """Return the length of the edges of the boundary at a point [m]."""
    centroids = mesh.vertices[mesh.boundary_faces].mean(axis=1)
    nearest = np.linalg.norm(centroids - point, axis=1).argmin()
    return float(np.sqrt(2.0 * mesh.face_areas[nearest]))


def _cylindrical(offset: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance from an axis, and the position along it."""
    z = offset @ axis
    return np.sqrt(np.maximum((offset**2).sum(axis=-1) - z**2, 0.0)), z


def _hat_loads(
    elasticity: Elasticity, faces: np.ndarray, area: np.ndarray, barycentric: np.ndarray
) -> sp.csc_matrix:
    """Return int N_a psi_i da of nodes a and hats i, shape (n_nodes, n_vertices)."""
    nodes, corners = elasticity.face_nodes[faces], elasticity.mesh.boundary_faces[faces]
    shape = barycentric if elasticity.element == "P1" else triangle_shape(barycentric)
    blocks = np.einsum("fq,qa,qk->fak", area, shape, barycentric)
    row = np.repeat(nodes[:, :, None], 3, axis=2).ravel()
    column = np.repeat(corners[:, None, :], shape.shape[1], axis=1).ravel()
    size = (elasticity.n_nodes, len(elasticity.mesh.vertices))
    return sp.csc_matrix((blocks.ravel(), (row, column)), shape=size)


def _distinct(
    zones: Sequence[_Zone], pushes: Sequence[Push]
) -> tuple[sp.csc_matrix, list[np.ndarray]]:
    """Return the different hats of all tips, and each tip's numbers in them.

    Tips at one place have all hats in common but those at their rims. A hat is identified by its
    vertex, its area and its axis.
    """
    names = [
        np.column_stack(
            [zone.vertices, zone.areas / 1e-15, np.tile(push.axis / 1e-9, (len(zone.areas), 1))]
        )
        for zone, push in zip(zones, pushes, strict=True)
    ]
    everything = np.round(np.concatenate(names)).astype(np.int64)
    _, first, number = np.unique(everything, axis=0, return_index=True, return_inverse=True)
    loads = sp.hstack([zone.loads for zone in zones], format="csc")[:, first]
    return loads, np.split(number.ravel(), np.cumsum([len(zone.areas) for zone in zones])[:-1])


def _condensed(
    elasticity: Elasticity, loads: sp.csc_matrix, progress: Callable[[float], None] | None
) -> np.ndarray:
    """Return C = B^T K^-1 B, shape (m, m) [m3/Pa]."""
    compliance = np.empty((loads.shape[1], loads.shape[1]))
    for start in range(0, loads.shape[1], _BATCH):
        batch = slice(start, start + _BATCH)
        compliance[:, batch] = loads.T @ elasticity.solve(loads[:, batch])
        if progress is not None:
            progress(min(1.0, (start + _BATCH) / loads.shape[1]))
    return 0.5 * (compliance + compliance.T)
