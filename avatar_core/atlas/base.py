"""The anatomies of an atlas from which a new patient's vademecum is made."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from avatar_core.atlas.model import Atlas
from avatar_core.common.arrays import FloatArray
from avatar_core.errors import AvatarError
from avatar_core.fem.elasticity import Material
from avatar_core.fem.patch_loads import LoadSurface, load_surface
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.shapes.registration import Registration, RegistrationRule, Template


class PatientError(AvatarError):
    """A patient's vademecum cannot be made from the base as requested."""


@dataclass(frozen=True, eq=False)
class PatientBase:
    """Anatomies with their responses, all on one template.

    template, loads : Template and the load positions of its mesh and regions
    material : Material of all responses
    names : of the anatomies
    vertices : ndarray, shape (n, n_template, 3) [m], the template registered to each anatomy
    responses : one CompactResponse per anatomy; may be a lazy sequence
    copies : numbers of anatomies that repeat an earlier one, and get no weight
    distances : signed distances of each anatomy on a common grid, shape (n, n_grid), or None
    distance_of : signed distances of a new surface on the same grid, or None
    rule : RegistrationRule of all registrations
    registrations : of the anatomies, by the hash of their file
    """

    template: Template
    loads: LoadSurface
    material: Material
    names: tuple[str, ...]
    vertices: FloatArray
    responses: Sequence[CompactResponse]
    copies: tuple[int, ...] = ()
    distances: Sequence[FloatArray] | None = None
    distance_of: Callable[[SurfaceMesh, Registration], FloatArray] | None = None
    rule: RegistrationRule = field(default_factory=RegistrationRule)
    registrations: dict[str, Registration] = field(default_factory=dict)


def base_of(atlas: Atlas) -> PatientBase:
    """The anatomies of an atlas that have a response.

    Raises
    ------
    PatientError
        If none has one, or they differ in material, element or patch radius.
    """
    kept = [i for i, anatomy in enumerate(atlas.anatomies) if anatomy.response is not None]
    responses = [atlas.anatomies[i].response for i in kept]
    members = [response for response in responses if response is not None]
    if not members:
        raise PatientError(
            "no anatomy of the atlas has a response; build it with 'avatar atlas create' and "
            "without --shapes-only"
        )
    first = members[0]
    made_with = {(one.material, one.element, one.patch_radius) for one in members}
    if len(made_with) > 1:
        raise PatientError(
            "the atlas's responses were computed for different materials or patches; build it again"
        )
    anatomies = [atlas.anatomies[i] for i in kept]
    loads = load_surface(atlas.template.mesh, atlas.template.regions, first.patch_radius)
    return PatientBase(
        template=atlas.template,
        loads=loads,
        material=first.material,
        names=tuple(anatomy.name for anatomy in anatomies),
        vertices=np.array([anatomy.registered for anatomy in anatomies]),
        responses=members,
        copies=tuple(k for k, i in enumerate(kept) if atlas.same_as[i] != i),
        distances=[anatomy.distances for anatomy in anatomies],
        distance_of=lambda surface, registration: atlas.distance_vector(
            surface, registration.alignment
        ),
        rule=atlas.rule,
        registrations={
            one.surface.source_sha256: atlas.registration(one.name)
            for one in anatomies
            if one.surface.source_sha256
        },
    )


def leave_one_out(base: PatientBase, name: str, same: Collection[Collection[str]]) -> list[int]:
    """Numbers of the anatomies to leave out for a patient: itself and those of the same person."""
    persons = [set(group) for group in same if name in group]
    return [
        i
        for i, other in enumerate(base.names)
        if other == name or any(other in group for group in persons)
    ]


def numbers_of(base: PatientBase, names: Collection[str]) -> tuple[int, ...]:
    """Numbers of some anatomies.

    Raises PatientError for a name that the base does not have.
    """
    for name in names:
        if name not in base.names:
            raise PatientError(f"no anatomy '{name}' in the atlas; 'avatar atlas show' names them")
    return tuple(base.names.index(name) for name in names)
