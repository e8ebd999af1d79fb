"""A meshed organ with its problem and loads, for studies that build a part of a vademecum."""

from __future__ import annotations

from dataclasses import dataclass

from avatar_core.fem.elasticity import Elasticity, Element, Inclusion, Material
from avatar_core.fem.patch_loads import LoadSurface, load_surface
from avatar_core.geometry.mesh import Regions, regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tumour import volume_fraction_inside
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.parametric import build_parametric_vademecum
from avatar_core.offline.rule import BuildRule, Progress
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Provenance
from avatar_core.vademecum.tip_field import TipField, make_tip_field


@dataclass(frozen=True, eq=False)
class Organ:
    """An organ, ready for a build."""

    outline: SurfaceMesh
    regions: Regions
    loads: LoadSurface
    elasticity: Elasticity

    @classmethod
    def of(
        cls,
        surface: SurfaceMesh,
        n_vertices: int,
        element: Element | None = None,
        tumour: SurfaceMesh | None = None,
        patch_radius: float | None = None,
    ) -> Organ:
        """Return organ with regions by the anatomical rule, and a tumour of its own stiffness."""
        mesh = tetrahedralize(surface, n_vertices)
        regions = regions_by_rule(mesh)
        inclusion = None
        if tumour is not None:
            inclusion = Inclusion(volume_fraction_inside(mesh, tumour), 1.0)
        elasticity = Elasticity(mesh, Material(), regions.clamped, element, inclusion)
        return cls(surface, regions, load_surface(mesh, regions, patch_radius), elasticity)

    @property
    def tip_field(self) -> TipField:
        """Geometry that tips touch."""
        mesh, radius = self.elasticity.mesh, self.loads.patch_radius
        return make_tip_field(mesh, self.regions, radius, self.outline)

    @property
    def provenance(self) -> Provenance:
        """Surface that it was made from."""
        return Provenance(self.outline.name, self.outline.source_sha256)

    def linear(self, rule: BuildRule, progress: Progress) -> Vademecum:
        """Return the vademecum of its material."""
        common = (self.outline.name, self.elasticity, self.regions, self.loads)
        return build_vademecum(*common, self.tip_field, rule, self.provenance, progress)

    def parametric(
        self, coordinates: tuple[Coordinate, ...], rule: BuildRule, progress: Progress
    ) -> Vademecum:
        """Return the vademecum over some coordinates."""
        common = (self.outline.name, self.elasticity, self.regions, self.loads)
        return build_parametric_vademecum(
            *common, coordinates, self.tip_field, rule, self.provenance, progress
        )
