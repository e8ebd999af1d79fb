"""The organ of a vademecum as the planning page shows it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from avatar_core.common.supports import SUPPORT
from avatar_core.contact.tool_path import middle_of_access, starts_apart
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.coordinates import RESECTION
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import VademecumInfo
from avatar_core.vademecum.resected import margins, part_volumes
from avatar_ros.loop.settings import MATERIAL
from avatar_ros.prepare.scenes import usable_material
from avatar_ros.ui.view.measuring import hit, is_within

CLEARANCE = 0.015  # height of a new organ's tools over the surface [m]
YOUNG_RANGE = (0.5e3, 1e6)  # range of choices [Pa]: the force is proportional to E


@dataclass(frozen=True, eq=False)
class Organ:
    """An organ at rest.

    vertices : ndarray, shape (n, 3) float32, points of the cloud [m]; faces : (m, 3), of the organ
    structures : faces of the structures inside, by name; walls : of a cut's walls
    clamped, sprung, accessible : ndarray of bool, shape (m,)
    centre : centre of the bounding box [m]; size : its longest side [m]
    start, normal : a point in the middle of the accessible surface [m], and the normal there
    ranges : lowest, highest and present value of each coordinate of the material, by name
    """

    id: str
    name: str
    vademecum: Vademecum
    info: VademecumInfo
    vertices: np.ndarray
    faces: np.ndarray
    structures: dict[str, np.ndarray]
    walls: np.ndarray
    clamped: np.ndarray
    sprung: np.ndarray
    accessible: np.ndarray
    centre: np.ndarray
    size: float
    start: np.ndarray
    normal: np.ndarray
    ranges: dict[str, tuple[float, float, float]]

    @staticmethod
    def of(v: Vademecum) -> Organ:
        """Return the organ of a vademecum."""
        vertices = v.surface_vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        j = middle_of_access(v)
        young = v.material.young_modulus
        held = v.ranges
        here = {"young": young, "poisson": v.material.poisson_ratio, "contrast": v.contrast or 1.0}
        here |= {SUPPORT + support.name: support.stiffness for support in v.supports}
        here |= {RESECTION: v.resection.opened} if v.resection else {}
        least, most = held.pop("young", (0.0, math.inf))
        low_young, high_young = (float(np.clip(end, least, most)) for end in YOUNG_RANGE)
        held = {"young": (min(low_young, young), max(high_young, young)), **held}
        settable = MATERIAL.values()  # other supports are chosen in a scene
        return Organ(
            id=v.id,
            name=v.name,
            vademecum=v,
            info=v.info(),
            vertices=vertices,
            faces=v.organ_faces,
            structures=v.structures,
            walls=v.cut_walls,
            clamped=v.clamped_faces,
            sprung=v.supported_faces,
            accessible=v.accessible_faces,
            centre=0.5 * (low + high),
            size=float((high - low).max()),
            start=v.surface.centers[j],
            normal=v.surface.normals[j] / np.linalg.norm(v.surface.normals[j]),
            ranges={n: (*held[n], here[n]) for n in held if n in settable},
        )

    def above(self, height: float) -> np.ndarray:
        """Return a point over the middle of the accessible surface [m]."""
        return np.asarray(self.start + height * self.normal)

    def starts(self, tips: Sequence[Tip]) -> np.ndarray:
        """Return where tools begin, over the accessible surface, shape (n, 3) [m].

        The first is over its middle, and each other one as far from the earlier ones as possible.
        """
        surface, places = self.vademecum.surface, starts_apart(self.vademecum, len(tips))
        normals = surface.normals[places]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        heights = np.array([tip.offset + CLEARANCE for tip in tips])
        return np.asarray(surface.centers[places] + heights[:, None] * normals)

    def outward(self, point: np.ndarray) -> np.ndarray:
        """Return the outward normal of the accessible surface nearest to a point."""
        surface = self.vademecum.surface
        j = int(np.argmin(np.linalg.norm(surface.centers - point, axis=1)))
        return np.asarray(surface.normals[j] / np.linalg.norm(surface.normals[j]))

    def lifted(self, point: np.ndarray, clearance: float) -> np.ndarray:
        """Return a point off the organ at rest, straight out from another, however deep that is.

        clearance : distance from the other point, or from where the way out leaves the organ [m]
        """
        out = self.outward(point)
        met = hit(point, out, self.vertices, self.faces)
        if met is not None and is_within(met, out, self.vertices):
            point = met.at(self.vertices)
        return np.asarray(point + clearance * out)

    def usable(self, material: dict[str, float]) -> dict[str, float]:
        """Return the given values by coordinate that the contact node uses for this organ."""
        return usable_material(self.vademecum, material)[0]

    def summary(self) -> str:
        """Return name, volume, material as built and certified displacement error, as HTML."""
        info = self.info
        errors = (
            f"Certified error of the displacement: {info.l2_mean:.1%} on average, "
            f"{info.l2_worst:.1%} at worst."
        )
        return (
            f"<b>{escape(self.name)}</b>, {info.volume * 1e6:.0f} ml, "
            f"E {info.young_modulus / 1e3:.4g} kPa, nu {info.poisson_ratio:.3g}. "
            + (errors if np.isfinite(info.l2_mean) else "Errors: not measured.")
            + self._parts()
        )

    def _parts(self) -> str:
        """Return the volumes of a resection's parts, and its distance from structures at rest."""
        if self.vademecum.resection is None:
            return ""
        first, second = part_volumes(self.vademecum)
        share = second / (first + second)
        text = f" The cut leaves {1e6 * first:.0f} and {1e6 * second:.0f} ml ({share:.0%})."
        for name, margin in margins(self.vademecum).items():
            text += f" {escape(name)}: {1e3 * margin:.0f} mm from it at rest."
        return text
