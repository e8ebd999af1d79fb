"""The response of an anatomy, computed on the registered template when it is added."""

from __future__ import annotations

from dataclasses import dataclass, field

from avatar_core.atlas.anatomy import Response
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.patch_loads import load_surface, patch_loads
from avatar_core.reduction.galerkin import compact_response
from avatar_core.shapes.correspondence import registered_positions
from avatar_core.shapes.registration import Registration


@dataclass(frozen=True)
class ResponseSolver:
    """Solver of an anatomy's response; picklable.

    Attributes
    ----------
    material : Material
        Material of all anatomies.
    rank : int
        Number of modes that are kept.

    Examples
    --------
    >>> av.ResponseSolver(rank=30).material.poisson_ratio
    0.48
    """

    material: Material = field(default_factory=Material)
    rank: int = 120

    def __call__(self, registration: Registration) -> Response:
        """Return the response to patch loads at the template's load positions on the organ."""
        template = registration.template
        loads = load_surface(template.mesh, template.regions)
        centers = registered_positions(registration, loads)
        elasticity = Elasticity(registration.mesh, self.material, template.regions.clamped)
        patches = patch_loads(elasticity, centers, loads.patch_radius).tocsr()
        found = compact_response(elasticity, patches, self.rank)
        return Response(
            found.space,
            found.load,
            found.residual_compliance,
            self.material,
            elasticity.element,
            loads.patch_radius,
        )
