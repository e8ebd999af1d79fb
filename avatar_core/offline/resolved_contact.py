"""Resolved contacts at one place of an organ: the reference forces for the online contact law.

The organ's own mesh is refined around the place for the smallest and the largest contact at once.
It is fitted there to the surface, factorized once, and condensed to the part that all tips together
can reach.

Balls are pressed in along the normal of the place. Their position stays, while the axis of their
tractions is turned until it leads through the centre of pressure and the ball's centre. Without
friction a ball has no moment. Beside a fold, that changed the force by up to a tenth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from avatar_core.errors import ContactError, MeshError
from avatar_core.fem.elasticity import Elasticity, Inclusion, Material
from avatar_core.fem.signorini import (
    CondensedContact,
    Contact,
    Push,
    half_space_radius,
    through_centre,
)
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.refinement import Grading, onto_surface, refine
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.geometry.tumour import volume_fraction_inside

SPHERES = tuple(Tip("sphere", radius) for radius in (1.5e-3, 3e-3, 5e-3, 10e-3))
DEPTHS = (1e-3, 2e-3, 5e-3)
LEANING = np.tan(np.radians(2.0))  # off the axis, beyond which it is turned,
_TURNS = 3  # at most; 20 degrees become 2 and 0.3 degrees
_REACHES = (1.6, 2.8)  # reach of a contact pressed through its middle: the first that suffices
_FITTED = (2.0, 1.5, 1.2)  # radii of the mesh fitted to the surface, over the largest contact's


@dataclass(frozen=True)
class Resolution:
    """Size of the elements around a contact, :class:`avatar_core.geometry.refinement.Grading`.

    Attributes
    ----------
    core : float
        Longest edge at the centre, over the radius of the smallest contact.
    inner : float
        Growth of the longest edge over the distance from the axis, up to the largest contact.
    outer : float
        Its growth beyond and below.
    reach : float
        Radius of the candidate surface over the contact radius on a half-space; a hollow place
        needs more than a flat one.
    """

    core: float = 0.3
    inner: float = 0.25
    outer: float = 0.5
    reach: float = 2.0


@dataclass(frozen=True, eq=False)
class ResolvedPlace:
    """Resolved contacts of tips at one place.

    Attributes
    ----------
    elasticity : Elasticity
        Problem of the organ, refined at the place.
    condensed : CondensedContact
        Condensed contact of the tips one by one along the normal.
    contacts : tuple[tuple[Contact, ...], ...]
        contacts[i][k] of tip i at depth k.
    axes : ndarray, shape (n_tips, n_depths, 3)
        Directions of their forces, out of the organ.
    """

    elasticity: Elasticity
    condensed: CondensedContact
    contacts: tuple[tuple[Contact, ...], ...]
    axes: np.ndarray

    @property
    def forces(self) -> np.ndarray:
        """Forces along the axes, shape (n_tips, n_depths) [N]."""
        return np.array([[contact.forces[0] for contact in row] for row in self.contacts])


def contacts_at(
    surface: SurfaceMesh | None,
    mesh: TetMesh,
    regions: Regions,
    material: Material,
    place: np.ndarray,
    normal: np.ndarray,
    tips: Sequence[Tip] = SPHERES,
    depths: Sequence[float] = DEPTHS,
    resolution: Resolution = Resolution(),
    progress: Callable[[float], None] | None = None,
    tumour: tuple[SurfaceMesh, float] | None = None,
) -> ResolvedPlace:
    """Return contacts of several tips, one by one, at several depths along the normal of one place.

    Parameters
    ----------
    surface : SurfaceMesh or None
        Surface to which the mesh is fitted around the place; None to keep its facets.
    mesh : TetMesh
        Mesh of the organ.
    regions : Regions
        Regions of the mesh.
    place : ndarray, shape (3,)
        Place on the surface (or the facets), where depths are zero [m].
    normal : ndarray, shape (3,)
        Outward normal. Tips are pushed in against it, and all tips but balls press along it.
    depths : Sequence[float]
        Depths of a tip's lowest point below the place [m].
    progress : Callable[[float], None] or None
        See :class:`avatar_core.fem.signorini.CondensedContact`.
    tumour : tuple[SurfaceMesh, float] or None
        Surface of a tumour and the contrast of Young's moduli.

    Raises
    ------
    MeshError
        If the mesh would become too large, or cannot be fitted to the surface.
    ContactError, ConvergenceError
        See :class:`avatar_core.fem.signorini.CondensedContact`.
    """
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    elasticity = refined_organ(
        surface, mesh, regions, material, [place], [normal], tips, depths, resolution, tumour
    )
    pushes = [Push(tip, np.asarray(place, float), normal) for tip in tips]
    condensed = CondensedContact(elasticity, pushes, max(depths), resolution.reach, progress)
    found = [
        [_without_moment(elasticity, push, condensed.solve([i], [depth])) for depth in depths]
        for i, push in enumerate(pushes)
    ]
    return ResolvedPlace(
        elasticity,
        condensed,
        tuple(tuple(contact for contact, _ in row) for row in found),
        np.array([[push.axis for _, push in row] for row in found]),
    )


def _without_moment(elasticity: Elasticity, push: Push, contact: Contact) -> tuple[Contact, Push]:
    """Return the contact of a ball whose force goes through its centre, and its push."""
    for _ in range(_TURNS):
        (touch,) = contact.touches
        if np.linalg.norm(touch.lean) < LEANING:
            break
        push = through_centre(push, touch)
        contact = _alone(elasticity, push, touch.depth)
    return contact, push


def _alone(elasticity: Elasticity, push: Push, depth: float) -> Contact:
    for reach in _REACHES[:-1]:
        with suppress(ContactError):
            return CondensedContact(elasticity, [push], depth, reach).solve([0], [depth])
    return CondensedContact(elasticity, [push], depth, _REACHES[-1]).solve([0], [depth])


def refined_organ(
    surface: SurfaceMesh | None,
    mesh: TetMesh,
    regions: Regions,
    material: Material,
    places: Sequence[np.ndarray],
    normals: Sequence[np.ndarray],
    tips: Sequence[Tip] = SPHERES,
    depths: Sequence[float] = DEPTHS,
    resolution: Resolution = Resolution(),
    tumour: tuple[SurfaceMesh, float] | None = None,
) -> Elasticity:
    """Return the organ's elastic problem on a mesh that resolves contacts at some places.

    For parameters see :func:`contacts_at`. Places and normals have the shape (n, 3); all tips and
    depths are expected at each.

    Raises
    ------
    MeshError
        If the mesh would become too large, or cannot be fitted to the surface.
    """
    radii = [half_space_radius(tip, depth) for tip in tips for depth in (min(depths), max(depths))]
    core, largest = resolution.core * min(radii), max(radii)
    gradings = [
        Grading(place, normal, core, largest, resolution.inner, resolution.outer)
        for place, normal in zip(places, normals, strict=True)
    ]
    mesh, regions = refine(mesh, regions, gradings)
    if surface is not None:
        for place in places:
            mesh = _fitted(mesh, surface, place, largest)
    inclusion = None
    if tumour is not None:
        inclusion = Inclusion(volume_fraction_inside(mesh, tumour[0]), tumour[1])
    return Elasticity(mesh, material, regions.clamped, inclusion=inclusion)


def _fitted(mesh: TetMesh, surface: SurfaceMesh, place: np.ndarray, largest: float) -> TetMesh:
    """Return the mesh on the surface around a place, as far out as no tetrahedron inverts."""
    for factor in _FITTED[:-1]:
        try:
            return onto_surface(mesh, surface, place, factor * largest)
        except MeshError:
            continue
    return onto_surface(mesh, surface, place, _FITTED[-1] * largest)
