"""The members of an atlas."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import AvatarError
from avatar_core.fem.elasticity import Element, Material
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.shapes.registration import RegistrationQuality, SimilarityTransform


class AtlasError(AvatarError):
    """An atlas cannot do what was asked of it."""


@dataclass(frozen=True, eq=False)
class Response(CompactResponse):
    """The response of one anatomy on the registered template, in the anatomy's own RAS axes.

    material, element, patch_radius [m] : with which it was computed
    """

    material: Material
    element: Element
    patch_radius: float


@dataclass(frozen=True, eq=False)
class Anatomy:
    """One organ of an atlas.

    name : unique in the atlas
    surface : SurfaceMesh in its own coordinates, with unit, axes and hash of its file
    volume : [m3]
    alignment : SimilarityTransform from the template to the organ
    distances : ndarray, shape (n_points,), signed distance on the atlas's box [m]
    registered : ndarray, shape (n_template_vertices, 3), the template registered to the organ [m]
    quality : RegistrationQuality
    converged : whether the registration converged
    response : Response; None if it was not computed
    """

    name: str
    surface: SurfaceMesh
    volume: float
    alignment: SimilarityTransform
    distances: FloatArray
    registered: FloatArray
    quality: RegistrationQuality
    converged: bool
    response: Response | None = None


@dataclass(frozen=True)
class Duplicate:
    """A member that repeats an earlier one; it has no weight in any barycenter.

    name, of : names of the member and of the earlier one
    same_file : whether their files are identical; otherwise their distances are equal
    """

    name: str
    of: str
    same_file: bool

    def __str__(self) -> str:
        how = "is the same file as" if self.same_file else "has the same shape as"
        return f"{self.name} {how} {self.of}: kept, but not counted again"


def free_name(name: str, taken: Collection[str]) -> str:
    """The name, with a number appended if it is taken."""
    if name not in taken:
        return name
    number = 2
    while f"{name}-{number}" in taken:
        number += 1
    return f"{name}-{number}"


def require_shapes(anatomy: Anatomy, n_points: int, n_vertices: int) -> None:
    """Raise AtlasError unless the arrays fit the box, the template and each other."""
    response = anatomy.response
    fits = anatomy.distances.shape == (n_points,) and anatomy.registered.shape == (n_vertices, 3)
    if response is not None:
        rank = response.space.shape[-1]
        fits = fits and response.space.shape == (3 * n_vertices, rank)
        fits = fits and response.load.ndim == 2 and response.load.shape[1] == rank
        fits = fits and response.residual_compliance.shape == (len(response.load) // 3, 3, 3)
    if not fits:
        raise AtlasError(
            f"{anatomy.name}: its arrays do not fit the atlas's box and template; build it with "
            "this atlas"
        )
