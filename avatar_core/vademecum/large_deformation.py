"""Load magnitude as a coordinate: terms that large deformation adds to the linear response.

A tip presses with a force f along the inward normal; f < 0 where a jaw pulls. With the linear depth
a = gamma(s) f of its patch, gamma = n . C(s, s) n, the organ moves by

    u(x, s, a) = a u_1(x, s) / gamma(s) + sum_k |a|^k V_k(x, s),      k = 2, 3
    d(s, a)    = a + sum_k beta_k(s) |a|^k,

u_1 the linear vademecum, d the depth that is really reached. V_k and beta_k are terms of the
asymptotic-numerical series (:mod:`avatar_core.reduction.asymptotic_series`), separated region by
region of the load surface. Pushes and pulls have terms of their own, because two terms replace
four. They hold up to |a| = a_max(s); beyond, both continue tangentially. Stress is proportional to
Young's modulus, so that V_k and beta_k do not depend on it.

Only the response of a patch to its own normal force is nonlinear. Coupling between patches and
forces along the surface stay linear; :mod:`avatar_core.certify.combinations` measures this error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import MaterialError
from avatar_core.fem.elasticity import Material
from avatar_core.fem.hyperelastic_materials import (
    HyperelasticMaterial,
    NeoHookean,
    StVenantKirchhoff,
)
from avatar_core.reduction.block_field import BlockField, Blocks

POWERS = (2, 3)
PUSH, PULL = 0, 1  # sides of a = 0

LargeMaterial = Literal["neo-hookean", "st-venant-kirchhoff"]


@dataclass(frozen=True)
class LargeCertificate:
    """Errors over all pushes and pulls within the stored range.

    n_sites, n_pushes : numbers of compared sites and pushes
    n_lost : sites where equilibrium was lost before the range ended
    depth : deepest push compared [m]
    n_pulls, pull_l2_mean, pull_l2_worst, pull_contact_mean, pull_linear_l2_mean : for outward
        forces
    oblique_contact_mean, two_tools_contact_mean, gravity_contact_mean : errors of the force with
        other effects (:mod:`avatar_core.certify.combinations`); NaN: not measured
    """

    l2_mean: float
    l2_worst: float
    contact_mean: float
    contact_worst: float
    linear_l2_mean: float
    linear_contact_mean: float
    n_sites: int
    n_pushes: int
    n_lost: int
    depth: float
    reach_median: float
    reach_least: float
    oblique_contact_mean: float = float("nan")
    two_tools_contact_mean: float = float("nan")
    gravity_contact_mean: float = float("nan")
    n_pulls: int = 0
    pull_l2_mean: float = float("nan")
    pull_l2_worst: float = float("nan")
    pull_contact_mean: float = float("nan")
    pull_linear_l2_mean: float = float("nan")


@dataclass(frozen=True, eq=False)
class Push:
    """An organ pushed by a force along the inward normal, or pulled by a negative one.

    Attributes
    ----------
    displacement : ndarray, shape (3 n_vertices,)
        Displacement [m].
    depth : float
        Inward depth of the patch [m].
    within : bool
        Whether the force lies in the computed range.
    """

    displacement: FloatArray
    depth: float
    within: bool


@dataclass(frozen=True, eq=False)
class LargeDeformation:
    """The terms of second and third order; k counts them.

    Attributes
    ----------
    material : LargeMaterial
        Material of large strains; its small strains are those of the vademecum.
    terms : BlockField
        V_2 and V_3 of pushes, then of pulls, as loads at a position [m^(1-k)].
    depth : ndarray, shape (2, 2, n_positions)
        beta_k of pushes and of pulls [m^(1-k)].
    reach : ndarray, shape (2, n_positions)
        a_max of pushes and of pulls [m].
    certificate : LargeCertificate or None
    """

    material: LargeMaterial
    terms: BlockField
    depth: FloatArray
    reach: FloatArray
    certificate: LargeCertificate | None = None

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        return self.terms.nbytes + self.depth.nbytes + self.reach.nbytes

    def added_to(
        self, linear: Push, blocks: Blocks, positions: np.ndarray, weights: FloatArray
    ) -> Push:
        """Return a linear push with the terms of second and third order at the same point.

        blocks : blocks of the vademecum
        positions, weights : ndarray, shape (n,), of the point
        """
        side, size = (PUSH if linear.depth >= 0.0 else PULL), abs(linear.depth)
        reach = float(self.reach[side, positions].min())
        power = powers(size, reach)
        terms = self.terms.combined(positions, weights)[..., 2 * side : 2 * side + 2]
        displacement = linear.displacement + blocks.at_vertices(terms) @ power
        depth = linear.depth + float(power @ (self.depth[side][:, positions] @ weights))
        return Push(displacement, depth, size <= reach)


def hyperelastic(name: str, linear: Material) -> HyperelasticMaterial:
    """Return the material of a name, continuing a linear one.

    Raises
    ------
    MaterialError
        For an unknown name.
    """
    known: dict[str, type[NeoHookean | StVenantKirchhoff]] = {
        "neo-hookean": NeoHookean,
        "st-venant-kirchhoff": StVenantKirchhoff,
    }
    if name not in known:
        raise MaterialError(f"material '{name}' is unknown; choose {' or '.join(known)}")
    return known[name](linear)


def powers(a: float, reach: float) -> FloatArray:
    """Return a^k of a >= 0 up to the reach and tangentially beyond, k = 2, 3."""
    inside = min(a, reach)
    return np.array([inside**k + k * inside ** (k - 1) * (a - inside) for k in POWERS])
