"""Supports that a build is asked for: which part of a liver, how firmly, fixed or kept free.

No stiffness per area of a liver's attachments was found in the literature. Attachments matter more
than the material, and are fitted to a patient's motion (Nikolaev & Cotin, "Estimation of boundary
conditions for patient-specific liver simulation during augmented surgery", IJCARS 15:1107, 2020;
Mendizabal, Tagliabue & Dall'Alba, IJCARS 18:1295, 2023). The values of ``TYPICAL`` are therefore
guesses, from a layer of modulus E and thickness d, k = E / d:

    cava_groove   a vein's wall, 0.62 MPa (Umale et al., J. Biomech. 44:1678, 2011), and a vein's
                  radius of 12 mm: 5e7
    bare_area     loose connective tissue between liver and diaphragm, some 5 kPa and 5 mm: 1e6
    triangular    folds of two layers, along the edge of a strip as wide as a mesh's triangle: 1e6
    falciform     a thin fold, loose in most positions: 1e5

Each may be wrong by a factor of 100. Where this matters, keep it as a coordinate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar_core.common.supports import ATTACHMENTS, SUPPORT
from avatar_core.errors import CoordinateError, MaterialError, MeshError
from avatar_core.fem.supports import Support, require_stiffness
from avatar_core.geometry.attachments import attachments_by_rule
from avatar_core.geometry.groups import REGIONS, faces_of_groups, read_groups
from avatar_core.geometry.mesh import Regions, TetMesh, accessible_by_rule, checked, touching
from avatar_core.reduction.coordinates import Coordinate

TYPICAL = {  # [N/m^3]
    "cava_groove": 5e7,
    "bare_area": 1e6,
    "right_triangular": 1e6,
    "left_triangular": 1e6,
    "falciform": 1e5,
}
CLAMPED = "clamped"


@dataclass(frozen=True)
class SupportOption:
    """One support of a build.

    Attributes
    ----------
    name : str
        Name of an attachment by rule, or of a group of a file.
    stiffness : float
        Stiffness per area [N/m^3]; infinity for a clamp.
    coordinate : Coordinate or None
        Range of the stiffness, if it stays free; a vademecum begins at ``stiffness``.

    Raises
    ------
    MaterialError
        For a stiffness that no support has, or a name that no coordinate can have.

    Examples
    --------
    >>> av.SupportOption("falciform", 1e5).stiffness  # [N/m^3]
    100000.0
    >>> print(av.SupportOption.parse("bare_area=1e5:1e9").coordinate.name)
    support.bare_area
    """

    name: str
    stiffness: float
    coordinate: Coordinate | None = None

    def __post_init__(self) -> None:
        if not self.name.isidentifier() or self.name in REGIONS:
            raise MaterialError(
                f"a support is called '{self.name}'; give {', '.join(ATTACHMENTS)}, or the name "
                "of a group of points in letters, digits and _"
            )
        if self.stiffness != math.inf:
            require_stiffness(self.name, self.stiffness)

    @classmethod
    def parse(cls, text: str) -> SupportOption:
        """Parse ``NAME``, ``NAME=STIFFNESS``, ``NAME=LOW:HIGH`` or ``NAME=clamped``.

        These are forms of the command line; a name alone takes its value of ``TYPICAL``.
        """
        name, _, value = (part.strip() for part in text.partition("="))
        if ":" in value:
            coordinate = Coordinate.parse(f"{SUPPORT}{name}={value}")
            typical = TYPICAL.get(name, coordinate.value_at(0.5))
            here = float(np.clip(typical, coordinate.low, coordinate.high))
            return cls(name, here, coordinate)
        if value == CLAMPED:
            return cls(name, math.inf)
        try:
            return cls(name, float(value) if value else TYPICAL[name])
        except (ValueError, KeyError) as error:
            raise CoordinateError(
                f"support '{text}': write NAME=STIFFNESS [N/m^3], NAME=LOW:HIGH to choose it "
                f"later, NAME=clamped, or NAME alone for one of {', '.join(TYPICAL)}"
            ) from error

    def __str__(self) -> str:
        if self.coordinate is not None:
            return str(self.coordinate).removeprefix(SUPPORT)
        value = CLAMPED if self.stiffness == math.inf else f"{self.stiffness:g}"
        return f"{self.name}={value}"


def held_by(
    mesh: TetMesh, options: Sequence[SupportOption], groups: Path | None = None
) -> tuple[Regions, tuple[Support, ...]]:
    """Return the result of :func:`held_at` for the attachments by rule and a file of groups."""
    given = {} if groups is None else faces_of_groups(mesh, read_groups(groups))
    return held_at(mesh, options, attachments_by_rule(mesh) | given)


def held_at(
    mesh: TetMesh, options: Sequence[SupportOption], places: Mapping[str, np.ndarray]
) -> tuple[Regions, tuple[Support, ...]]:
    """Return the regions of an organ held by supports instead of the clamp, and its supports.

    Tools reach the faces that look forward and are not held, unless the places say otherwise.

    Parameters
    ----------
    places : Mapping[str, ndarray]
        Faces of each support, ndarrays of bool, shape (n_faces,). Also ``clamped`` and
        ``accessible``, unless they are left to the supports and the rule.

    Raises
    ------
    MaterialError, MeshError
        For a support that is nowhere, or without faces.
    """
    clamped = places.get(CLAMPED, np.zeros(len(mesh.boundary_faces), bool)).copy()
    held = clamped.copy()
    supports = []
    for option in options:
        if option.name not in places:
            known = ", ".join(name for name in places if name not in REGIONS)
            raise MeshError(f"there is no support '{option.name}'; choose one of {known}")
        faces = places[option.name]
        held |= faces
        if option.stiffness == math.inf:
            clamped |= faces
        else:
            supports.append(Support(option.name, faces, option.stiffness))
    covered = held | touching(mesh, clamped)
    accessible = places.get("accessible", accessible_by_rule(mesh, covered)) & ~covered
    return checked(Regions(clamped, accessible), on_supports=bool(supports)), tuple(supports)
