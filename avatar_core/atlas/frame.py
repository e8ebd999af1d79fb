"""The frame in which the anatomies of an atlas are compared: one template, one grid, one rule."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from avatar_core.atlas.anatomy import AtlasError
from avatar_core.common.arrays import FloatArray
from avatar_core.geometry.level_set import GridBox
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import SimilarityTransform, Template, TemplateRule

LARGEST_ORGAN = (0.33, 0.26, 0.26)  # along x, y, z [m]
SPACING = 0.009  # gives about 49,000 points with LARGEST_ORGAN, as many as in the paper [m]
SLACK = 0.018  # on every side, since organs are aligned by shape and not by their centres [m]


@dataclass(frozen=True, eq=False)
class Frame:
    """Template, grid and rule of all anatomies of an atlas; fixed when it is created.

    Attributes
    ----------
    template : Template
        Template registered to every anatomy.
    box : GridBox
        Box around the template, at whose points signed distances are taken.
    rule : TemplateRule
        Rule of all registrations.
    """

    template: Template
    box: GridBox
    rule: TemplateRule = field(default_factory=TemplateRule)

    @property
    def n_points(self) -> int:
        """Number of points of the box."""
        return math.prod(self.box.shape)

    def place(self, surface: SurfaceMesh, alignment: SimilarityTransform) -> SurfaceMesh:
        """Return the organ moved to the template by rotation and translation; its size is kept.

        Parameters
        ----------
        alignment : SimilarityTransform
            Alignment of its registration, from the template to the organ.
        """
        center = self.template.mesh.centroid
        moved = (surface.vertices - alignment(center)) @ alignment.rotation + center
        return replace(surface, vertices=moved)

    def distance_vector(self, surface: SurfaceMesh, alignment: SimilarityTransform) -> FloatArray:
        """Return signed distances of the placed organ at the points of the box, (n_points,) [m].

        Raises AtlasError if the organ sticks out of the box.
        """
        placed = self.place(surface, alignment)
        if not self.box.margin(placed) > 0.0:
            raise AtlasError(_too_large(surface, self.box))
        return placed.skin.signed_distance(self.box.points)

    def require_room(self, surface: SurfaceMesh) -> None:
        """Raise AtlasError if the organ is too long for the box; needs no registration."""
        if not surface.extent.max() < (self.box.upper - self.box.origin).max():
            raise AtlasError(_too_large(surface, self.box))


def box_around(
    template: Template,
    largest: tuple[float, float, float] = LARGEST_ORGAN,
    spacing: float = SPACING,
) -> GridBox:
    """Return a box around the template for organs up to a size [m], with some slack.

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


def _too_large(surface: SurfaceMesh, box: GridBox) -> str:
    size = " x ".join(f"{side * 1e3:.0f}" for side in surface.extent)
    room = " x ".join(f"{side * 1e3:.0f}" for side in box.upper - box.origin)
    return (
        f"{surface.name}: an organ of {size} mm sticks out of the atlas's box of {room} mm; check "
        "--unit, or create an atlas with a larger --box"
    )
