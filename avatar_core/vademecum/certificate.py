"""The certificate of a vademecum's errors; :mod:`avatar_core.certify` measures them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from avatar_core.errors import StorageError
from avatar_core.vademecum.accuracy import AccuracyCurve
from avatar_core.vademecum.force_error import ForceError


@dataclass(frozen=True)
class ContactSites:
    """Relative errors (fractions) of the force on real tips against resolved contacts.

    The contacts are those of spheres of several radii at several depths at some places of the
    organ; see :mod:`avatar_core.certify.contact_sites`.

    Attributes
    ----------
    n_contacts, n_places : int
        Numbers of resolved contacts and places; 0: not asked for.
    mean, p95, worst : float
        Mean, 95th percentile and maximum of |F / F_resolved - 1| along the normal.
    coverage : float
        Fraction of the contacts whose error is at most the step's estimate.
    overestimate : float
        Median of the estimated error over the true one.
    factor : float
        Factor on the law's part of the estimated error, by which these contacts are covered; 1
        without contacts.
    """

    n_contacts: int = 0
    n_places: int = 0
    mean: float = float("nan")
    p95: float = float("nan")
    worst: float = float("nan")
    coverage: float = float("nan")
    overestimate: float = float("nan")
    factor: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.factor) and self.factor > 0.0):
            raise StorageError(
                f"the factor of the contact sites is {self.factor:g}, not above 0; build the file "
                "again"
            )


@dataclass(frozen=True)
class Certificate:
    """Relative errors (fractions) on unseen loads, mean and worst, and the cost.

    Attributes
    ----------
    l2_mean, l2_worst : float
        |u - u_FE| / |u_FE| over all vertices, mass-weighted, each load and direction.
    contact_mean, contact_worst : float
        |C - C_FE|_F / |C_FE|_F of the 3 x 3 compliance of the loaded patch.
    force_mean, force_worst : float
        |F / F_FE - 1| of the normal force for an imposed normal indentation.
    tip_force_mean, tip_force_worst : float
        The same error for a tip anywhere on the accessible faces. The compliance is the contact
        step's, smoothed so that the force does not show the mesh's edges.
    n_loads, seed : int
        Number of unseen load positions, and the seed that draws them.
    modes : int
        Number of modes of the certified displacement.
    build_cpu_seconds : float
        User + system time of everything, meshing and this certificate included [s].
    mesh_l2, mesh_contact : float
        Change of the reference when the mesh is refined once (NaN: not asked).
    force_error : ForceError
        Estimate of the force error at a place, calibrated on the same loads.
    contact_sites : ContactSites
        Errors of real tips against resolved contact, if asked for.
    curve : AccuracyCurve or None
        The same errors for coarser details of the displacement, and the time of a step.

    Examples
    --------
    >>> 0.0 < v.certificate.l2_mean < v.certificate.l2_worst < 0.2
    True
    """

    l2_mean: float
    l2_worst: float
    contact_mean: float
    contact_worst: float
    force_mean: float
    force_worst: float
    tip_force_mean: float
    tip_force_worst: float
    n_loads: int
    seed: int
    modes: int
    build_cpu_seconds: float = float("nan")
    mesh_l2: float = float("nan")
    mesh_contact: float = float("nan")
    force_error: ForceError = field(default_factory=ForceError)
    contact_sites: ContactSites = field(default_factory=ContactSites)
    curve: AccuracyCurve | None = None

    @classmethod
    def unknown(cls) -> Certificate:
        """Return a certificate without any figures."""
        nan = float("nan")
        return cls(nan, nan, nan, nan, nan, nan, nan, nan, 0, 0, 0)
