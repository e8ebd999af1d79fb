"""The anatomies of an atlas from which a new patient's vademecum is made."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from avatar_core.atlas.anatomy import Anatomy, AtlasError
from avatar_core.atlas.model import MOST_NEIGHBORS, Atlas, Lazy, centred, first_equal
from avatar_core.common.arrays import FloatArray
from avatar_core.errors import AvatarError
from avatar_core.fem.elasticity import Material
from avatar_core.fem.patch_loads import LoadSurface, load_surface
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.shapes.registration import Registration, Template, TemplateRule
from avatar_core.shapes.weights import Vectors


class PatientError(AvatarError):
    """A patient's vademecum cannot be made from the base as requested."""


# Largest difference of the signed distances of two readings of one surface [m]
_SAME_SURFACE = 1e-7


def _unknown(surface: SurfaceMesh) -> Registration | None:
    return None


@dataclass(frozen=True, eq=False)
class PatientBase:
    """Anatomies with their responses, all on one template.

    Attributes
    ----------
    template, loads : Template, LoadSurface
        Template and the load positions of its mesh and regions.
    material : Material
        Material of all responses.
    names : tuple[str, ...]
        Names of the anatomies.
    vertices : Vectors
        n arrays of shape (n_template, 3) [m], the template registered to each anatomy.
    responses : Sequence[CompactResponse]
        One response per anatomy; may be a lazy sequence.
    distances : Sequence[ndarray] or None
        Signed distances of each anatomy on a common grid, n arrays of shape (n_grid,). May be a
        lazy sequence.
    distance_of : Callable[[SurfaceMesh, Registration], ndarray] or None
        Function that returns the signed distances of a new surface on the same grid.
    rule : TemplateRule
        Rule of all registrations.
    registration_of : Callable[[SurfaceMesh], Registration or None]
        Function that returns the registration of the anatomy with the same surface, if there is
        one.
    """

    template: Template
    loads: LoadSurface
    material: Material
    names: tuple[str, ...]
    vertices: Vectors
    responses: Sequence[CompactResponse]
    distances: Sequence[FloatArray] | None = None
    distance_of: Callable[[SurfaceMesh, Registration], FloatArray] | None = None
    rule: TemplateRule = field(default_factory=TemplateRule)
    registration_of: Callable[[SurfaceMesh], Registration | None] = _unknown

    @cached_property
    def same_as(self) -> tuple[int, ...]:
        """Number of the first anatomy with the same shape, mostly its own, for each anatomy."""
        return tuple(first_equal(centred(self.vertices)).tolist())

    @property
    def copies(self) -> tuple[int, ...]:
        """Numbers of the anatomies that repeat an earlier one; they get no weight."""
        return tuple(k for k, first in enumerate(self.same_as) if first != k)

    def without(self, leave_out: Collection[int] = ()) -> list[int]:
        """Return the anatomies that get no weight: some, their copies, and all further copies.

        Raises PatientError for a number that the base does not have.
        """
        n, same = len(self.names), self.same_as
        for number in leave_out:
            if not 0 <= number < n:
                raise PatientError(
                    f"no anatomy has the number {number} to leave out; choose from 0 to {n - 1}"
                )
        left = {same[number] for number in leave_out}
        return sorted({*self.copies, *(k for k in range(n) if same[k] in left)})

    def mesh_at(self, number: int, place: FloatArray) -> TetMesh:
        """Return the template registered to an anatomy, its centroid moved to a place (3,) [m]."""
        mesh = TetMesh(np.asarray(self.vertices[number], float), self.template.mesh.tets)
        # the shift is exactly 0, and the mesh the same bit for bit, where the anatomy lay
        return TetMesh(mesh.vertices + (place - mesh.centroid), mesh.tets)


def base_of(atlas: Atlas) -> PatientBase:
    """Return the anatomies of an atlas that have a response; each is read when it is used.

    Raises
    ------
    PatientError
        If no anatomy has a response, or they differ in material, element or patch radius.
    """
    kept = [i for i, anatomy in enumerate(atlas.anatomies) if anatomy.response is not None]
    anatomies = [atlas.anatomies[i] for i in kept]
    kinds = {replace(one.response, rank=0) for one in anatomies if one.response is not None}
    if not kinds:
        raise PatientError(
            "no anatomy of the atlas has a response; build it with 'avatar atlas create' and "
            "without --shapes-only"
        )
    if len(kinds) > 1:
        raise PatientError(
            "the atlas's responses were computed for different materials or patches; build it again"
        )
    (kind,) = kinds
    frame, n = atlas.frame, len(kept)
    return PatientBase(
        template=frame.template,
        loads=load_surface(frame.template.mesh, frame.template.regions, kind.patch_radius),
        material=kind.material,
        names=tuple(anatomy.name for anatomy in anatomies),
        vertices=[anatomy.registered for anatomy in anatomies],
        responses=Lazy(lambda k: atlas.read_response(anatomies[k]), n, MOST_NEIGHBORS),
        distances=Lazy(lambda k: atlas.read_distances(anatomies[k]), n, MOST_NEIGHBORS),
        distance_of=lambda surface, registration: frame.distance_vector(
            surface, registration.alignment
        ),
        rule=frame.rule,
        registration_of=partial(_known_registration, atlas, anatomies),
    )


def _known_registration(
    atlas: Atlas, anatomies: Sequence[Anatomy], surface: SurfaceMesh
) -> Registration | None:
    """Return the registration of the first anatomy that was made of the same surface, if any.

    A file may be read in another unit or by another label, and a surface may be moved later.
    Surfaces are therefore compared by their signed distances, which tell both shape and place.
    """
    for one in anatomies:
        if len(surface.vertices) != one.origin.n_vertices:
            continue
        if not math.isclose(surface.volume, one.volume, rel_tol=1e-9):
            continue
        try:
            distances = atlas.frame.distance_vector(surface, one.alignment)
        except AtlasError:
            continue  # it sticks out of the box where the anatomy lies
        if np.abs(distances - atlas.read_distances(one)).max() <= _SAME_SURFACE:
            return atlas.registration(one.name)
    return None


def leave_one_out(base: PatientBase, name: str, same: Collection[Collection[str]]) -> list[int]:
    """Return the anatomies to leave out for a patient: all of the same person or the same shape."""
    shapes = [
        {other for other, k in zip(base.names, base.same_as, strict=True) if k == first}
        for first in set(base.same_as)
    ]
    person, before = {name}, set[str]()
    while person != before:  # a copy of one scan belongs to the person of all others
        before = set(person)
        person = person.union(*(group for group in (*same, *shapes) if person & set(group)))
    return [i for i, other in enumerate(base.names) if other in person]


def numbers_of(base: PatientBase, names: Collection[str]) -> tuple[int, ...]:
    """Return the numbers of some anatomies.

    Raises PatientError for a name that the base does not have.
    """
    for name in names:
        if name not in base.names:
            raise PatientError(f"no anatomy '{name}' in the atlas; 'avatar atlas show' names them")
    return tuple(base.names.index(name) for name in names)
