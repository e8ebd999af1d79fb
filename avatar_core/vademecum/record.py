"""The record of a vademecum's making: its source, the search for its modes, and a summary."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avatar_core.reduction.pgd import EnrichmentReport


@dataclass(frozen=True)
class Provenance:
    """Origin of a vademecum: enough to build it again.

    Attributes
    ----------
    source : str
        File name of the surface, ``source_sha256`` its hash.
    unit, axes : str
        Unit and axes applied on reading.
    versions : tuple[str, ...]
        "package version" of everything that took part.
    parameters : tuple[str, ...]
        "name=value" of the build.
    notices : tuple[str, ...]
        Notices of the reader of the surface and of the build.
    """

    source: str
    source_sha256: str
    unit: str = "m"
    axes: str = "RAS"
    versions: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()


@dataclass(frozen=True)
class RankError:
    """Relative L2 error over the build's own loads with ``rank`` modes at a place."""

    rank: int
    mean: float
    worst: float


@dataclass(frozen=True)
class Convergence:
    """Record of the search for modes.

    Attributes
    ----------
    converged : bool
        Whether the tolerance was met within the mode limit.
    tolerance : float
        Requested mean relative L2 error over the build's own loads.
    enrichments : tuple[EnrichmentReport, ...]
        One report for each enrichment.
    rank_errors : tuple[RankError, ...]
        Error against number of modes at a place.
    every_mean, every_worst : float
        Relative L2 error of the field under every load of the build, in three directions at each
        position. NaN for a patient whose loads are not all solved.
    """

    converged: bool
    tolerance: float
    enrichments: tuple[EnrichmentReport, ...] = ()
    rank_errors: tuple[RankError, ...] = ()
    every_mean: float = float("nan")
    every_worst: float = float("nan")

    def with_errors(self, errors: np.ndarray) -> Convergence:
        """Return the same record with the errors of the field, any shape."""
        return replace(self, every_mean=float(errors.mean()), every_worst=float(errors.max()))


@dataclass(frozen=True)
class VademecumInfo:
    """Summary of a vademecum; the fields of avatar_interfaces/msg/VademecumInfo.

    Attributes
    ----------
    force_mean, force_worst : float
        Relative error at a depth, anywhere on the surface that tips reach.
    """

    id: str
    name: str
    source: str
    schema_version: str
    axes: str
    n_vertices: int
    n_surface_vertices: int
    n_load_positions: int
    n_modes: int
    n_regions: int
    bytes: int
    young_modulus: float
    poisson_ratio: float
    patch_radius: float
    volume: float
    converged: bool
    l2_mean: float
    l2_worst: float
    contact_mean: float
    contact_worst: float
    force_mean: float
    force_worst: float
    build_cpu_seconds: float
