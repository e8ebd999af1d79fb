"""Settings of the offline stage, and the reports of its progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

Progress = Callable[[str, float, float], None]  # stage, fraction of it, current error (NaN: none)
NO_ERROR = float("nan")


def silent(stage: str, fraction: float, error: float) -> None:
    """Report nothing."""


@dataclass(frozen=True)
class BuildRule:
    """Tolerance and sizes of a build.

    tolerance : mean relative L2 error over the build's own loads; the worst load may have
        8/3 times it
    max_modes : far-field modes at most
    oversampling : PGD finds this many times ``max_modes``, of which the best are kept; if these
        miss the tolerance, up to ``most_oversampling`` times
    near_inner, near_outer : the displacement near field is exact within, absent beyond, in
        patch radii
    near_growth : both grow by this factor where ``max_modes`` do not meet the tolerance
    contact_support : reach of the contact near field, in patch radii
    max_sample_bytes : memory for the columns kept in full, all if they fit, to measure errors on
    """

    tolerance: float = 0.045
    max_modes: int = 100
    oversampling: float = 1.2
    most_oversampling: float = 2.2
    near_inner: float = 1.8
    near_outer: float = 3.3
    near_growth: float = 1.4
    contact_support: float = 4.0
    max_sample_bytes: int = 400_000_000

    def with_wider_near_field(self) -> BuildRule:
        """The rule with its near field grown, once."""
        return replace(
            self,
            near_inner=self.near_growth * self.near_inner,
            near_outer=self.near_growth * self.near_outer,
            near_growth=1.0,
        )
