"""Model order reduction: responses to many loads in few modes.

::

    problem = mor.LoadProblem(K, F)                       # K u(s) = f(s), sparse or an Elasticity
    pgd = mor.solve_pgd(problem, mor.PGDRule(max_modes=20, tolerance=1e-3))
    best = mor.pod(snapshots, 20)                         # the rival, of all solutions
    there = mor.solve_galerkin(K, F, pgd.space)           # in the space of a given basis

Finite element problems and solutions come in; separated fields u(x, s, p) = sum_k X_k(x) Y_k(s)
Z_k(p) go out. The methods are Proper Generalized Decomposition (paper, Sec. 2.1), principal
components region by region, and Galerkin projection. Asymptotic series in the load and the exact
near field of the contact compliance complete them. The public name of this package is
``avatar_core.mor``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from avatar_core.common.lazy import lazy

_ORIGIN = {
    "EnrichmentReport": "reduction.pgd",
    "LoadProblem": "reduction.pgd",
    "PGDRule": "reduction.pgd",
    "PGDSolution": "reduction.pgd",
    "RegionModes": "reduction.regional",
    "RegionalRule": "reduction.regional",
    "SeparatedField": "reduction.separated",
    "SparseOperator": "reduction.operator",
    "pod": "reduction.snapshots",
    "regions_of": "reduction.regional",
    "separate_regions": "reduction.regional",
    "solve_galerkin": "reduction.galerkin",
    "solve_pgd": "reduction.pgd",
}

__all__ = [*_ORIGIN]

if TYPE_CHECKING:
    from avatar_core.reduction.galerkin import solve_galerkin as solve_galerkin
    from avatar_core.reduction.operator import SparseOperator as SparseOperator
    from avatar_core.reduction.pgd import EnrichmentReport as EnrichmentReport
    from avatar_core.reduction.pgd import LoadProblem as LoadProblem
    from avatar_core.reduction.pgd import PGDRule as PGDRule
    from avatar_core.reduction.pgd import PGDSolution as PGDSolution
    from avatar_core.reduction.pgd import solve_pgd as solve_pgd
    from avatar_core.reduction.regional import RegionalRule as RegionalRule
    from avatar_core.reduction.regional import RegionModes as RegionModes
    from avatar_core.reduction.regional import regions_of as regions_of
    from avatar_core.reduction.regional import separate_regions as separate_regions
    from avatar_core.reduction.separated import SeparatedField as SeparatedField
    from avatar_core.reduction.snapshots import pod as pod
else:
    __getattr__, __dir__ = lazy(__name__, _ORIGIN)
