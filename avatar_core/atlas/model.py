"""An atlas: anatomies compared on one grid and one template.

Every organ is moved to the template by the rigid part of its registration, which keeps its size,
and represented by its signed distances at the points of one box. The inner products of these
vectors are stored: adding an organ costs one registration, one vector and one row of products.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from avatar_core.atlas.anatomy import Anatomy, AtlasError, Duplicate, free_name, require_shapes
from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.geometry.level_set import GridBox
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.lle import Gram, fit
from avatar_core.shapes.registration import (
    Registration,
    RegistrationRule,
    SimilarityTransform,
    Template,
)

LARGEST_ORGAN = (0.33, 0.26, 0.26)  # along x, y, z [m]
SPACING = 0.009  # gives about 49,000 points with LARGEST_ORGAN, as many as in the paper [m]
SLACK = 0.018  # on every side, since organs are aligned by shape and not by their centres [m]


@dataclass(frozen=True, eq=False)
class Atlas:
    """Anatomies that can be compared.

    template : Template, registered to every anatomy
    box : GridBox around the template; like the template, fixed when the atlas is created
    rule : RegistrationRule of all registrations
    anatomies : in the order in which they were added
    gram : Gram, inner products of their distance vectors

    Raises AtlasError if names repeat or shapes do not fit.
    """

    template: Template
    box: GridBox
    rule: RegistrationRule = field(default_factory=RegistrationRule)
    anatomies: tuple[Anatomy, ...] = ()
    gram: Gram = field(default_factory=lambda: Gram(np.zeros(0), np.zeros((0, 0))))

    def __post_init__(self) -> None:
        n = len(self.anatomies)
        n_points = int(np.prod(self.box.shape)) if n else 0
        if self.gram.products.shape != (n, n) or self.gram.origin.shape != (n_points,):
            raise AtlasError("the Gram matrix does not fit the anatomies; build the atlas again")
        if len(set(self.names)) != n:
            raise AtlasError("two anatomies have the same name; rename one")
        for anatomy in self.anatomies:
            require_shapes(anatomy, n_points, len(self.template.mesh.vertices))

    def __len__(self) -> int:
        return len(self.anatomies)

    def __getitem__(self, name: str) -> Anatomy:
        return self.anatomies[self.index(name)]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the anatomies, in their order."""
        return tuple(anatomy.name for anatomy in self.anatomies)

    @property
    def vectors(self) -> tuple[FloatArray, ...]:
        """Distance vectors, n arrays of shape (n_points,) [m], not copied."""
        return tuple(anatomy.distances for anatomy in self.anatomies)

    def index(self, name: str) -> int:
        """Number of an anatomy.

        Raises AtlasError if there is none of that name.
        """
        if name not in self.names:
            raise AtlasError(f"no anatomy '{name}' in the atlas; 'avatar atlas show' names them")
        return self.names.index(name)

    # --- growing ------------------------------------------------------------------------------

    def with_anatomies(self, newcomers: Iterable[Anatomy]) -> Atlas:
        """The atlas with more members; nothing is computed again for those it has.

        A name that is taken gets a number: liver, liver-2, ...

        Raises AtlasError if a newcomer's arrays do not fit.
        """
        members, names = list(self.anatomies), set(self.names)
        for newcomer in newcomers:
            name = free_name(newcomer.name, names)
            names.add(name)
            members.append(replace(newcomer, name=name))
        n_points, n_vertices = int(np.prod(self.box.shape)), len(self.template.mesh.vertices)
        for newcomer in members[len(self) :]:
            require_shapes(newcomer, n_points, n_vertices)
        gram = _grown(self.gram, [anatomy.distances for anatomy in members])
        return replace(self, anatomies=tuple(members), gram=gram)

    def without_anatomies(self) -> Atlas:
        """The atlas as it was created, without members."""
        return Atlas(self.template, self.box, self.rule)

    # --- what is the same ---------------------------------------------------------------------

    @cached_property
    def same_as(self) -> IntArray:
        """Number of the first member with the same file or shape, mostly its own, shape (n,)."""
        if not self.anatomies:
            return np.zeros(0, dtype=np.int64)
        same = fit(self.vectors, 1, gram=self.gram).same_as.copy()
        first: dict[str, int] = {}
        for i, anatomy in enumerate(self.anatomies):
            source = anatomy.surface.source_sha256 or f"generated {i}"
            same[i] = same[min(same[i], first.setdefault(source, i))]
        return same

    @property
    def duplicates(self) -> tuple[Duplicate, ...]:
        """Members that repeat an earlier one."""
        found = []
        for i in np.flatnonzero(self.same_as != np.arange(len(self))):
            one, other = self.anatomies[i], self.anatomies[self.same_as[i]]
            source = one.surface.source_sha256
            same_file = bool(source) and source == other.surface.source_sha256
            found.append(Duplicate(one.name, other.name, same_file))
        return tuple(found)

    # --- comparing ----------------------------------------------------------------------------

    def place(self, surface: SurfaceMesh, alignment: SimilarityTransform) -> SurfaceMesh:
        """The organ moved to the template by rotation and translation; its size is kept.

        alignment : of its registration, from the template to the organ
        """
        center = self.template.mesh.centroid
        moved = (surface.vertices - alignment(center)) @ alignment.rotation + center
        return replace(surface, vertices=moved)

    def distance_vector(self, surface: SurfaceMesh, alignment: SimilarityTransform) -> FloatArray:
        """Signed distances of the placed organ at the points of the box, shape (n_points,) [m].

        Raises AtlasError if it sticks out of the box.
        """
        placed = self.place(surface, alignment)
        if not self.box.margin(placed) > 0.0:
            raise AtlasError(_too_large(surface, self.box))
        return placed.skin.signed_distance(self.box.points)

    def require_room(self, surface: SurfaceMesh) -> None:
        """Raise AtlasError if the organ is too long for the box; needs no registration."""
        if not surface.extent.max() < (self.box.upper - self.box.origin).max():
            raise AtlasError(_too_large(surface, self.box))

    def registration(self, name: str) -> Registration:
        """The registration of an anatomy, without its history."""
        one = self[name]
        mesh = TetMesh(one.registered, self.template.mesh.tets)
        return Registration(self.template, mesh, one.alignment, one.quality, (), one.converged)


def box_around(
    template: Template,
    largest: tuple[float, float, float] = LARGEST_ORGAN,
    spacing: float = SPACING,
) -> GridBox:
    """Box around the template that holds organs up to a size [m], with some slack.

    Raises AtlasError if a size or the spacing is not positive, or the grid is unreasonable.
    """
    if not (spacing > 0 and all(0 < side < 2.0 for side in largest)):
        raise AtlasError(
            f"a box of {' x '.join(f'{side:g}' for side in largest)} m with spacing {spacing:g} m; "
            "choose sizes below 2 m and a spacing above 0"
        )
    sides = np.array(largest) + 2 * SLACK
    nx, ny, nz = (int(n) + 1 for n in np.ceil(sides / spacing - 1e-9))
    if min(nx, ny, nz) < 8 or nx * ny * nz > 20_000_000:
        raise AtlasError(
            f"a grid of {nx} x {ny} x {nz} points; choose a spacing (--spacing) that gives at "
            "least 8 along each side and at most 20 million"
        )
    vertices = template.mesh.vertices
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    x, y, z = middle - spacing * (np.array([nx, ny, nz]) - 1) / 2
    return GridBox((float(x), float(y), float(z)), spacing, (nx, ny, nz))


def _grown(gram: Gram, vectors: Sequence[FloatArray]) -> Gram:
    """The Gram matrix with rows for the vectors that it lacks."""
    n = len(gram.products)
    if n == 0:
        return Gram.of(vectors) if vectors else gram
    for i in range(n, len(vectors)):
        gram = gram.grown(vectors[:i], vectors[i])
    return gram


def _too_large(surface: SurfaceMesh, box: GridBox) -> str:
    size = " x ".join(f"{side * 1e3:.0f}" for side in surface.extent)
    room = " x ".join(f"{side * 1e3:.0f}" for side in box.upper - box.origin)
    return (
        f"{surface.name}: an organ of {size} mm sticks out of the atlas's box of {room} mm; check "
        "--unit, or create an atlas with a larger --box"
    )
