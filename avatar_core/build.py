"""The offline stage: from an organ's mesh to its vademecum.

1. every patch is solved once; what lies near it, its energy and its norm are kept;
2. PGD finds the modes, a rotation sorts them by what they are worth in displacement;
3. the rank is the smallest that meets the tolerance on the build's own loads; where none does,
   the near field grows, and the last few loads that no mode serves are stored whole;
4. the near field becomes the exact remainder, tapered.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from avatar_core.elasticity import Elasticity
from avatar_core.loads import LoadSurface, patch_loads
from avatar_core.mesh import Regions
from avatar_core.near_field import LocalBlocks, Pairs, near_pairs, plateau, wendland
from avatar_core.pgd import ParametricProblem, PGDRule, PGDSolution, solve_pgd
from avatar_core.separated import SeparatedField, optimal_rotation
from avatar_core.tip_field import make_tip_field
from avatar_core.vademecum import Convergence, Provenance, RankError, Vademecum

Progress = Callable[[str, float], None]


def _silent(stage: str, fraction: float) -> None:
    """Report nothing."""


_BATCH = 40  # load positions solved at once
_MOST_STUBBORN = 0.01  # part of the load positions whose fields may be stored whole
_WORST_OVER_MEAN = 8 / 3  # the worst load may be this much worse than the mean asked for
_ENOUGH = 1.25  # the modes found must leave so much less than asked, as not all are kept


@dataclass(frozen=True)
class BuildRule:
    """What the offline stage aims at.

    tolerance : mean relative L2 error over the build's own loads; the worst load may have
        8/3 times it
    max_modes : far-field modes at most
    oversampling : PGD finds this many times ``max_modes``, of which the best are kept; where
        these leave too much, up to ``most_oversampling`` times
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


def build_vademecum(
    name: str,
    elasticity: Elasticity,
    regions: Regions,
    surface: LoadSurface,
    rule: BuildRule,
    provenance: Provenance,
    progress: Progress = _silent,
) -> Vademecum:
    """Compute the vademecum of one organ; see the module docstring for the stages.

    A tolerance that is not met within ``max_modes`` still gives a complete vademecum, whose
    ``convergence.converged`` is False.
    """
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    response = _exact_response(elasticity, surface, loads, rule, progress)
    missing = _Missing(elasticity, surface, response, rule)
    modes = _modes(elasticity, loads, response, missing, rule, progress)
    errors = _rank_errors(modes.field, missing, rule)
    rank, converged = _choose_rank(errors, rule)
    if not converged and rule.near_growth > 1.0:
        rule = rule.with_wider_near_field()
        missing = _Missing(elasticity, surface, response, rule)
        errors = _rank_errors(modes.field, missing, rule)
        rank, converged = _choose_rank(errors, rule)
    far = modes.field.truncate(rank)
    stubborn = np.empty(0, np.int64)
    if not converged:
        stubborn, final = _stubborn(far, missing, rule)
        errors = (*errors, final)
        converged = _is_met(final.mean, final.worst, rule)
    return Vademecum(
        name=name,
        mesh=elasticity.mesh,
        regions=regions,
        material=elasticity.material,
        element=elasticity.element,
        surface=surface,
        far=SeparatedField(far.space.astype(np.float32), far.load.astype(np.float32)),
        near=_displacement_near(far, response, surface, rule, stubborn),
        contact_near=_contact_near(far, response, surface, rule),
        tip_field=make_tip_field(elasticity.mesh, regions, surface.patch_radius),
        convergence=Convergence(converged, rule.tolerance, modes.solution.history, errors),
        provenance=provenance,
    )


def with_rank(vademecum: Vademecum, rank: int, rule: BuildRule) -> Vademecum:
    """The vademecum that a build with fewer modes would have given.

    What the dropped modes held of the near fields moves into these, so that the response at the
    load positions stays exact.
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
        tail = _remainder(zero, -factor, dropped.load, fade)
        return replace(near, block=near.block + tail.block)

    return replace(
        vademecum,
        far=far.truncate(rank),
        near=grown(vademecum.near, dropped.space, vademecum.mesh.vertices, False),
        contact_near=grown(vademecum.contact_near, dropped.load, surface.centers, True),
    )


@dataclass(frozen=True)
class ExactResponse:
    """What is kept of the full solutions, each computed once and dropped.

    vertex, contact : LocalBlocks, exact displacement at near vertices and near positions
    vertex_pairs, contact_pairs : Pairs, their distances
    norm : ndarray, shape (n_loads,), mass-weighted L2 norm of each column [m^(5/2)/N]
    energy : ndarray, shape (n_loads,), patch compliance of each load [m/N]
    samples : ndarray of int, positions whose columns are kept; ``columns`` (3 n_vertices, 3 n)
        float32
    """

    vertex: LocalBlocks
    contact: LocalBlocks
    vertex_pairs: Pairs
    contact_pairs: Pairs
    norm: np.ndarray
    energy: np.ndarray
    samples: np.ndarray
    columns: np.ndarray


def _exact_response(
    elasticity: Elasticity,
    surface: LoadSurface,
    loads: sp.csr_matrix,
    rule: BuildRule,
    progress: Progress,
) -> ExactResponse:
    """Solve for every load position and keep what the vademecum needs."""
    radius, n = surface.patch_radius, surface.n_positions
    vertices = elasticity.mesh.vertices
    widest = rule.near_growth * rule.near_outer * radius
    vertex_pairs = near_pairs(surface.centers, vertices, widest)
    contact_pairs = near_pairs(surface.centers, surface.centers, rule.contact_support * radius)
    vertex = np.empty((len(vertex_pairs.target), 3, 3), np.float32)
    contact = np.empty((len(contact_pairs.target), 3, 3))
    norm, energy = np.empty((n, 3)), np.empty((n, 3))
    sampled = np.random.default_rng(1).permutation(n)
    sampled = np.sort(sampled[: max(1, rule.max_sample_bytes // (36 * len(vertices)))])
    columns = np.empty((3 * len(vertices), len(sampled), 3), np.float32)
    place = {int(j): k for k, j in enumerate(sampled)}
    mass = elasticity.mesh.vertex_volumes[:, None, None, None]
    by_column, average = loads.tocsc(), loads.T.tocsr()
    for first in range(0, n, _BATCH):
        batch = range(first, min(first + _BATCH, n))
        solution = elasticity.solve(by_column[:, 3 * batch.start : 3 * batch.stop])
        at_vertex = elasticity.at_vertices(solution).reshape(len(vertices), 3, -1, 3)
        at_position = (average @ solution).reshape(n, 3, -1, 3)
        norm[batch] = np.sqrt((mass * at_vertex**2).sum(axis=(0, 1)))
        for k, j in enumerate(batch):
            row = slice(vertex_pairs.start[j], vertex_pairs.start[j + 1])
            vertex[row] = at_vertex[vertex_pairs.target[row], :, k]
            row = slice(contact_pairs.start[j], contact_pairs.start[j + 1])
            contact[row] = at_position[contact_pairs.target[row], :, k]
            energy[j] = np.diagonal(at_position[j, :, k])
            if j in place:
                columns[:, place[j]] = at_vertex[:, :, k].reshape(-1, 3)
        progress("solve", batch.stop / n)
    return ExactResponse(
        LocalBlocks(vertex_pairs.start, vertex_pairs.target, vertex),
        LocalBlocks(contact_pairs.start, contact_pairs.target, contact),
        vertex_pairs,
        contact_pairs,
        norm.ravel(),
        energy.ravel(),
        sampled,
        columns.reshape(3 * len(vertices), -1),
    )


class _Missing:
    """What the modes found so far leave of the kept columns, outside the near field."""

    def __init__(
        self,
        elasticity: Elasticity,
        surface: LoadSurface,
        response: ExactResponse,
        rule: BuildRule,
    ) -> None:
        distance = np.linalg.norm(
            elasticity.mesh.vertices[:, None] - surface.centers[response.samples][None], axis=2
        )
        inner, outer = (r * surface.patch_radius for r in (rule.near_inner, rule.near_outer))
        keep = 1.0 - plateau(distance, inner, outer)
        weight = elasticity.mesh.vertex_volumes[:, None] * keep**2
        self.loads = (3 * response.samples[:, None] + np.arange(3)).ravel()
        self._weight = np.repeat(weight, 3, axis=0).astype(np.float32)
        self._norm = response.norm[self.loads]
        self._columns = response.columns
        self._left = self._columns.copy()

    def restart(self) -> None:
        """Forget all modes."""
        self._left = self._columns.copy()

    def remove(self, space: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Take modes off; the relative L2 error of each kept load, shape (n,)."""
        self._left -= space.astype(np.float32) @ load[self.loads].astype(np.float32).T
        left = self._left.reshape(len(self._weight), -1, 3)
        squared = np.einsum("vs,vsc,vsc->sc", self._weight, left, left, optimize=False)
        return np.sqrt(squared).ravel() / self._norm


@dataclass(frozen=True)
class _Modes:
    field: SeparatedField  # K-orthonormal in space, at the vertices, best first
    solution: PGDSolution


def _modes(
    elasticity: Elasticity,
    loads: sp.csr_matrix,
    response: ExactResponse,
    missing: _Missing,
    rule: BuildRule,
    progress: Progress,
) -> _Modes:
    """PGD in the energy norm, then sorted by displacement.

    Every column is divided by its own L2 norm, so that the relative error of a load at a stiff
    place counts as much as that at a soft one, and weighs more the worse it still is. The final
    rotation is orthogonal: modes stay K-orthonormal, and any leading number of them is a
    Galerkin subspace.
    """
    base = 1.0 / response.norm**2
    weights = base.copy()

    least = int(np.ceil(rule.oversampling * rule.max_modes))
    limit = int(np.ceil(max(rule.oversampling, rule.most_oversampling) * rule.max_modes))
    found = 0

    def follow_error(space: np.ndarray, load: np.ndarray) -> np.ndarray | None:
        nonlocal found
        found += load.shape[1]
        error = missing.remove(elasticity.at_vertices(space), load)
        if found >= least and _is_met(_ENOUGH * error.mean(), _ENOUGH * error.max(), rule):
            return None
        weights[missing.loads] = base[missing.loads] * (error / error.mean()) ** 2
        return weights.copy()

    solution = solve_pgd(
        ParametricProblem(elasticity, loads.tocsr(), base, response.energy),
        PGDRule(limit, tolerance=1e-6),
        lambda rank: progress("modes", rank / limit),
        follow_error,
    )
    raw = SeparatedField(elasticity.at_vertices(solution.space), solution.load)
    _, mixing, _ = optimal_rotation(raw, np.repeat(elasticity.mesh.vertex_volumes, 3), weights)
    rotation = np.linalg.qr(mixing)[0]
    return _Modes(SeparatedField(raw.space @ rotation, raw.load @ rotation), solution)


def _rank_errors(
    modes: SeparatedField, missing: _Missing, rule: BuildRule
) -> tuple[RankError, ...]:
    """Error on the kept loads against the number of modes, near field included."""
    missing.restart()
    errors = []
    last = min(rule.max_modes, modes.rank)
    ranks = sorted({*range(5, last, 5), last})
    for before, rank in zip([0, *ranks[:-1]], ranks, strict=True):
        error = missing.remove(modes.space[:, before:rank], modes.load[:, before:rank])
        errors.append(RankError(rank, float(error.mean()), float(error.max())))
    return tuple(errors)


def _choose_rank(errors: tuple[RankError, ...], rule: BuildRule) -> tuple[int, bool]:
    for error in errors:
        if _is_met(error.mean, error.worst, rule):
            return error.rank, True
    return errors[-1].rank, False


def _stubborn(
    far: SeparatedField, missing: _Missing, rule: BuildRule
) -> tuple[np.ndarray, RankError]:
    """The few kept positions that no rank serves, and the error with their fields stored whole.

    They lie beside the clamp, where a push moves the organ little and not as any other does.
    """
    missing.restart()
    error = missing.remove(far.space, far.load)
    limit = _WORST_OVER_MEAN * rule.tolerance
    positions = np.unique(missing.loads[error > limit] // 3)
    positions = positions[: int(_MOST_STUBBORN * len(error) / 3)]
    error[np.isin(missing.loads // 3, positions)] = 0.0
    return positions, RankError(far.rank, float(error.mean()), float(error.max()))


def _is_met(mean: float, worst: float, rule: BuildRule) -> bool:
    return mean <= rule.tolerance and worst <= _WORST_OVER_MEAN * rule.tolerance


def _displacement_near(
    far: SeparatedField,
    response: ExactResponse,
    surface: LoadSurface,
    rule: BuildRule,
    stubborn: np.ndarray,
) -> LocalBlocks:
    """(u - far) at the vertices around each position, faded out; whole at stubborn ones."""
    radius = surface.patch_radius
    fade = plateau(
        response.vertex_pairs.distance, rule.near_inner * radius, rule.near_outer * radius
    )
    blocks = _remainder(response.vertex, far.space, far.load, fade)
    blocks = blocks.kept(response.vertex_pairs.distance < rule.near_outer * radius)
    rows = {}
    for j in stubborn:
        k = 3 * int(np.searchsorted(response.samples, j))
        left = response.columns[:, k : k + 3] - far.space @ far.load[3 * j : 3 * j + 3].T
        rows[int(j)] = left.reshape(-1, 3, 3).astype(np.float32)
    return blocks.with_whole_rows(rows)


def _contact_near(
    far: SeparatedField, response: ExactResponse, surface: LoadSurface, rule: BuildRule
) -> LocalBlocks:
    """(C - Y Y^T), tapered by Wendland's function and exactly symmetric."""
    support = rule.contact_support * surface.patch_radius
    taper = wendland(response.contact_pairs.distance, support)
    blocks = _remainder(response.contact, far.load, far.load, taper)
    return replace(blocks, block=_symmetrized(blocks))


def _remainder(
    exact: LocalBlocks, target: np.ndarray, load: np.ndarray, fade: np.ndarray
) -> LocalBlocks:
    rank = target.shape[1]
    target, load = target.reshape(-1, 3, rank), load.reshape(-1, 3, rank)
    block = np.empty(exact.block.shape, np.float32)
    for j in range(len(exact.start) - 1):
        row = slice(exact.start[j], exact.start[j + 1])
        smooth = (target[exact.target[row]].reshape(-1, rank) @ load[j].T).reshape(-1, 3, 3)
        block[row] = fade[row, None, None] * (exact.block[row] - smooth)
    return LocalBlocks(exact.start, exact.target, block)


def _symmetrized(blocks: LocalBlocks) -> np.ndarray:
    """(B + B^T) / 2 block by block: rounding is all it removes (Maxwell-Betti)."""
    order = np.lexsort((blocks.position, blocks.target))  # the transpose, in the same pattern
    return 0.5 * (blocks.block + blocks.block[order].transpose(0, 2, 1))
