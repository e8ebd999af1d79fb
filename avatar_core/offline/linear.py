"""The offline stage: from an organ's mesh to its vademecum.

1. every patch is solved once; what lies near it, its energy and its norm are kept;
2. PGD finds the modes, and an orthogonal mixing sorts them by displacement norm;
3. the rank is the smallest that meets the tolerance on the build's own loads; where none does,
   the near field grows, and the fields of a few outliers are stored in full;
4. the near field becomes the exact remainder, tapered.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from avatar_core.contact.ball_shift import make_felt_field
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import LoadSurface, patch_loads
from avatar_core.geometry.mesh import Regions
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.exact_response import (
    ExactResponse,
    FarFieldResidual,
    contact_near,
    displacement_near,
    exact_response,
    remainder,
)
from avatar_core.offline.rule import NO_ERROR, BuildRule, Progress, silent
from avatar_core.reduction.near_field import LocalBlocks, plateau, wendland
from avatar_core.reduction.pgd import LoadProblem, PGDRule, PGDSolution, solve_pgd
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.modal_mass import (
    LEAST_MODES,
    N_BODY,
    BodyResponse,
    body_functions,
    body_response,
)
from avatar_core.vademecum.model import Convergence, Provenance, RankError, Vademecum

_MAX_OUTLIERS = 0.01  # part of the load positions whose fields may be stored in full
_WORST_OVER_MEAN = 8 / 3  # the worst load may be this much worse than the mean asked for
_ENOUGH = 1.25  # factor below the tolerance that the found modes must reach, as not all are kept


def build_vademecum(
    name: str,
    elasticity: Elasticity,
    regions: Regions,
    surface: LoadSurface,
    rule: BuildRule,
    provenance: Provenance,
    progress: Progress = silent,
    outline: SurfaceMesh | None = None,
) -> Vademecum:
    """Compute the vademecum of one organ; see the module docstring for the stages.

    ``outline`` is the surface of which the mesh was made, which tools touch; None for the mesh's
    own boundary.

    A tolerance that is not met within ``max_modes`` still gives a complete vademecum, whose
    ``convergence.converged`` is False.
    """
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    response = exact_response(elasticity, surface, loads, rule, progress, single=True)
    residual = FarFieldResidual(elasticity, surface, response, rule)
    rule, with_body = _with_room_for_body(rule)
    solution, weights = find_modes(elasticity, loads, response, residual, rule, progress)
    modes = SeparatedField(elasticity.at_vertices(solution.space), solution.load)
    mixing = modes.mixing_by_norm(elasticity.mesh.lumped_mass, weights)
    modes = SeparatedField(modes.space @ mixing, modes.load @ mixing)
    errors = _rank_errors(modes, residual, rule)
    rank, converged = _choose_rank(errors, rule)
    if not converged and rule.near_growth > 1.0:
        rule = rule.with_wider_near_field()
        residual = FarFieldResidual(elasticity, surface, response, rule)
        errors = _rank_errors(modes, residual, rule)
        rank, converged = _choose_rank(errors, rule)
    far, body = modes.truncate(rank), None
    if with_body:
        far, body = _with_body(elasticity, loads, solution.space @ mixing[:, :rank], far.load)
    outliers = np.empty(0, np.int64)
    if not converged:
        outliers, final = _outliers(far, residual, rule)
        errors = (*errors, final)
        converged = is_met(final.mean, final.worst, rule)
    return Vademecum(
        name=name,
        mesh=elasticity.mesh,
        regions=regions,
        material=elasticity.material,
        element=elasticity.element,
        surface=surface,
        far=SeparatedField(far.space.astype(np.float32), far.load.astype(np.float32)),
        near=displacement_near(far, response, surface, rule, outliers),
        contact_near=contact_near(far, response, surface, rule),
        tip_field=make_felt_field(elasticity.mesh, regions, surface.patch_radius, outline),
        body=body,
        convergence=Convergence(converged, rule.tolerance, solution.history, errors),
        provenance=provenance,
    )


def _with_room_for_body(rule: BuildRule) -> tuple[BuildRule, bool]:
    """The rule without the modes reserved for body functions, if it has enough modes."""
    if rule.max_modes < LEAST_MODES:
        return rule, False
    return replace(rule, max_modes=rule.max_modes - N_BODY), True


def _with_body(
    elasticity: Elasticity, loads: sp.csr_matrix, space: np.ndarray, load: np.ndarray
) -> tuple[SeparatedField, BodyResponse]:
    """The far field with the body's functions beside its modes (3 n_nodes, rank)."""
    own = body_functions(elasticity, space)
    space, load = np.hstack([space, own]), np.hstack([load, loads.T @ own])
    body = body_response(elasticity, space)
    return SeparatedField(elasticity.at_vertices(space), load), body


def with_rank(vademecum: Vademecum, rank: int, rule: BuildRule) -> Vademecum:
    """The vademecum that a build with fewer modes would have given.

    The near fields absorb the near part of the dropped modes, so that the response at the load
    positions stays exact.
    """
    surface, far = vademecum.surface, vademecum.far
    if rank >= far.rank:
        return vademecum
    dropped = SeparatedField(far.space[:, rank:], far.load[:, rank:])
    radius = surface.patch_radius
    inner, outer = rule.near_inner * radius, rule.near_outer * radius

    def grown(
        near: LocalBlocks, factor: np.ndarray, points: np.ndarray, contact: bool
    ) -> LocalBlocks:
        distance = np.linalg.norm(surface.centers[near.position] - points[near.target], axis=1)
        fade = (
            wendland(distance, rule.contact_support * radius)
            if contact
            else plateau(distance, inner, outer)
        )
        zero = replace(near, block=np.zeros_like(near.block))
        tail = remainder(zero, -factor, dropped.load, fade)
        return replace(near, block=near.block + tail.block)

    return replace(
        vademecum,
        far=far.truncate(rank),
        body=None,
        near=grown(vademecum.near, dropped.space, vademecum.mesh.vertices, False),
        contact_near=grown(vademecum.contact_near, dropped.load, surface.centers, True),
    )


def find_modes(
    elasticity: Elasticity,
    loads: sp.csr_matrix,
    response: ExactResponse,
    residual: FarFieldResidual,
    rule: BuildRule,
    progress: Progress,
) -> tuple[PGDSolution, np.ndarray]:
    """PGD in the energy norm, and the weights of the loads that it ended with.

    Every column is divided by its own L2 norm, so that the relative error of a load at a stiff
    place counts as much as that at a soft one; weights grow with the remaining error.
    """
    base = 1.0 / response.norm**2
    weights = base.copy()

    least = int(np.ceil(rule.oversampling * rule.max_modes))
    limit = int(np.ceil(max(rule.oversampling, rule.most_oversampling) * rule.max_modes))
    found, current = 0, NO_ERROR

    def follow_error(space: np.ndarray, load: np.ndarray) -> np.ndarray | None:
        nonlocal found, current
        found += load.shape[1]
        error = residual.subtract(elasticity.at_vertices(space), load)
        current = float(error.mean())
        if found >= least and is_met(_ENOUGH * error.mean(), _ENOUGH * error.max(), rule):
            return None
        weights[residual.loads] = base[residual.loads] * (error / error.mean()) ** 2
        return weights.copy()

    solution = solve_pgd(
        LoadProblem(elasticity, loads.tocsr(), base, response.energy, response.single),
        PGDRule(limit, tolerance=1e-6),
        lambda rank: progress("modes", rank / limit, current),
        follow_error,
    )
    return solution, weights


def _rank_errors(
    modes: SeparatedField, residual: FarFieldResidual, rule: BuildRule
) -> tuple[RankError, ...]:
    """Error on the kept loads against the number of modes, near field included."""
    residual.reset()
    errors = []
    last = min(rule.max_modes, modes.rank)
    ranks = sorted({*range(5, last, 5), last})
    for before, rank in zip([0, *ranks[:-1]], ranks, strict=True):
        error = residual.subtract(modes.space[:, before:rank], modes.load[:, before:rank])
        errors.append(RankError(rank, float(error.mean()), float(error.max())))
    return tuple(errors)


def _choose_rank(errors: tuple[RankError, ...], rule: BuildRule) -> tuple[int, bool]:
    for error in errors:
        if is_met(error.mean, error.worst, rule):
            return error.rank, True
    return errors[-1].rank, False


def _outliers(
    far: SeparatedField, residual: FarFieldResidual, rule: BuildRule
) -> tuple[np.ndarray, RankError]:
    """Sampled positions above the limit of the worst load, and the error once they are stored.

    They lie beside the clamp, where displacements are small and unlike those of other loads.
    """
    residual.reset()
    error = residual.subtract(far.space, far.load)
    limit = _WORST_OVER_MEAN * rule.tolerance
    positions = np.unique(residual.loads[error > limit] // 3)
    positions = positions[: int(_MAX_OUTLIERS * len(error) / 3)]
    error[np.isin(residual.loads // 3, positions)] = 0.0
    return positions, RankError(far.rank, float(error.mean()), float(error.max()))


def is_met(mean: float, worst: float, rule: BuildRule) -> bool:
    """Whether errors over the build's own loads are as small as asked for."""
    return mean <= rule.tolerance and worst <= _WORST_OVER_MEAN * rule.tolerance
