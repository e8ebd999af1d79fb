"""The members of an atlas."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import AvatarError
from avatar_core.fem.elasticity import Element, Material
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.shapes.registration import RegistrationQuality, SimilarityTransform


class AtlasError(AvatarError):
    """An atlas cannot do what was asked of it."""


@dataclass(frozen=True)
class ResponseKind:
    """Method by which a response was computed.

    material : material of the finite element solutions
    element : element of the finite element solutions
    patch_radius : radius of the load patches [m]
    rank : number of modes
    """

    material: Material
    element: Element
    patch_radius: float
    rank: int


@dataclass(frozen=True, eq=False)
class Response(CompactResponse):
    """The response of one anatomy on the registered template, in the anatomy's own RAS axes.

    material, element, patch_radius [m] : of the finite element solutions
    """

    material: Material
    element: Element
    patch_radius: float

    @property
    def kind(self) -> ResponseKind:
        """Method by which it was computed."""
        return ResponseKind(self.material, self.element, self.patch_radius, self.load.shape[1])


@dataclass(frozen=True)
class Origin:
    """The surface from which an anatomy was made.

    Attributes
    ----------
    sha256 : str
        SHA-256 of its file; empty for a generated surface.
    unit, axes : str
        Unit and axes of the file.
    n_vertices : int
        Number of vertices of the surface.
    notices : tuple[str, ...]
        Changes made on reading, one line each.
    """

    sha256: str
    unit: str
    axes: str
    n_vertices: int
    notices: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Anatomy:
    """The shape of one organ of an atlas, by which it is found among others.

    Its level set and its response are read when they are used; see
    :class:`avatar_core.atlas.model.Atlas`.

    Attributes
    ----------
    name : str
        Name, unique in the atlas.
    key : str
        Hash of the surface and its reading.
    volume : float
        Volume [m3].
    alignment : SimilarityTransform
        Similarity from the template to the organ.
    registered : ndarray, shape (n_template_vertices, 3)
        The template registered to the organ [m].
    converged : bool
        Whether the registration converged.
    response : ResponseKind or None
        Kind of its response; None without a response.
    """

    name: str
    key: str
    origin: Origin
    volume: float
    alignment: SimilarityTransform
    registered: FloatArray
    quality: RegistrationQuality
    converged: bool
    response: ResponseKind | None = None


@dataclass(frozen=True, eq=False)
class WholeAnatomy:
    """An anatomy with everything that its folder holds.

    Attributes
    ----------
    distances : ndarray, shape (n_points,)
        Signed distance at the points of the atlas's box [m].
    response : Response or None
        None if it was not computed.
    """

    shape: Anatomy
    distances: FloatArray
    response: Response | None = None


@dataclass(frozen=True)
class Duplicate:
    """A member that has the shape of an earlier one; it has no weight in any barycenter.

    name, of : names of the member and of the earlier one
    """

    name: str
    of: str

    def __str__(self) -> str:
        return f"{self.name} has the same shape as {self.of}: kept, but not counted again"


def free_name(name: str, taken: Collection[str]) -> str:
    """Return the name, with a number appended if it is taken."""
    if name not in taken:
        return name
    number = 2
    while f"{name}-{number}" in taken:
        number += 1
    return f"{name}-{number}"
