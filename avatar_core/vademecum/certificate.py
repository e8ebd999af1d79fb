"""The certificate of a vademecum's errors; :mod:`avatar_core.offline.certify` measures them."""

from __future__ import annotations

from dataclasses import dataclass, field

from avatar_core.vademecum.accuracy import AccuracyCurve
from avatar_core.vademecum.force_error import ForceError


@dataclass(frozen=True)
class Certificate:
    """Relative errors (fractions) on unseen loads, mean and worst, and the cost.

    l2 : |u - u_FE| / |u_FE| over all vertices, mass-weighted, each load and direction
    contact : |C - C_FE|_F / |C_FE|_F of the 3 x 3 compliance of the loaded patch
    force : |F / F_FE - 1| of the normal force for an imposed normal indentation
    tip_force : the same for a tip anywhere on the accessible faces, with the compliance that the
        contact step uses, smoothed so that the force does not show the edges of the mesh
    vertex_contact_worst : contact error at load positions of the build, on fresh solves
    n_loads : unseen load positions; ``seed`` draws them
    build_cpu_seconds : user + system time of everything, meshing and this certificate included
    mesh_l2, mesh_contact : change of the reference when the mesh is refined once (NaN: not asked)
    force_error : estimate of the force error at a place, calibrated on the same loads
    curve : the same errors for coarser details of the displacement, and the time of a step
    """

    l2_mean: float
    l2_worst: float
    contact_mean: float
    contact_worst: float
    force_mean: float
    force_worst: float
    tip_force_mean: float
    tip_force_worst: float
    vertex_contact_worst: float
    n_loads: int
    seed: int
    modes: int
    build_cpu_seconds: float = float("nan")
    mesh_l2: float = float("nan")
    mesh_contact: float = float("nan")
    force_error: ForceError = field(default_factory=ForceError)
    curve: AccuracyCurve | None = None

    @classmethod
    def unknown(cls) -> Certificate:
        """A certificate without any figures."""
        nan = float("nan")
        return cls(nan, nan, nan, nan, nan, nan, nan, nan, nan, 0, 0, 0)
