"""Settings of the offline stage, and the reports of its progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from avatar_core.common.arrays import IntArray
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.reduction.regional import RegionalRule, regions_of

Progress = Callable[[str, float, float], None]  # stage, fraction of it, current error (NaN: none)
NO_ERROR = float("nan")

_GLOBAL_PART = 0.4  # fraction of the modes that a place may have
_REGION_POSITIONS = 30  # least mean number of load positions of a region


def silent(stage: str, fraction: float, error: float) -> None:
    """Report nothing."""


@dataclass(frozen=True)
class BuildRule:
    """Tolerance and sizes of a build.

    Attributes
    ----------
    tolerance : float
        Mean relative L2 error over the build's own loads.
    worst_over_mean : float
        Allowed error of the worst load, over the tolerance.
    max_modes : int
        Largest number of modes that show the displacement at a place: global plus regional.
    global_modes : int
        Largest number of global modes, common to all regions; at most 40 % of ``max_modes``.
    contact_modes : int
        Largest number of modes of the contact compliance, global modes included.
    region_area : float
        Area of the load surface for each region, in squared patch radii. On average a region has at
        least 30 load positions.
    contact_support : float
        Reach of the contact near field, in patch radii.

    Examples
    --------
    >>> av.OrganOptions(rule=av.BuildRule(max_modes=60)).rule.tolerance
    0.006
    """

    tolerance: float = 0.006
    worst_over_mean: float = 4.0
    max_modes: int = 100
    global_modes: int = 16
    contact_modes: int = 240
    region_area: float = 4.5
    contact_support: float = 5.0

    @property
    def n_global(self) -> int:
        """Number of global modes."""
        return max(1, min(self.global_modes, round(_GLOBAL_PART * self.max_modes)))

    @property
    def regional(self) -> RegionalRule:
        """Limits of a region's modes beside the global ones."""
        most = self.max_modes - self.n_global
        return RegionalRule(self.tolerance, self.worst_over_mean * self.tolerance, most)

    def regions(self, surface: LoadSurface) -> IntArray:
        """Return the region of each load position, shape (n_positions,) int32."""
        wanted = round(surface.area / (self.region_area * surface.patch_radius**2))
        return regions_of(surface.centers, min(wanted, surface.n_positions // _REGION_POSITIONS))

    def is_met(self, mean: float, worst: float) -> bool:
        """Return whether errors over the build's own loads are as small as asked for."""
        return mean <= self.tolerance and worst <= self.worst_over_mean * self.tolerance
