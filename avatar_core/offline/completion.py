"""The response to every load, from the solutions for some of them.

Patches overlap, so that what one load does nearly follows from the loads around it. With the loads
F_S of some positions solved, K X_S = F_S, another one is projected on their solutions (Galerkin),

    u_t ~ X_S w_t,    C_SS w_t = C_St,    C = F^T X,

and no further equation is solved: the compliance C_St of every patch is read from X_S. (Of C this
is the approximation of Nystroem, Williams & Seeger, NIPS 13, 2001.) S are the solved positions
around t; farther ones change nothing that matters. What is left of the load,

    r_t = f_t - F_S w_t,    eta_t^2 = r_t . D^-1 r_t,    D = diag K,

costs no product by K either. Next those positions are solved whose eta is largest against their
own compliance. What the projection had missed there is then known, and calibrates eta as an
estimate of the error of every position that is left.

The compliance of projected loads is the energy of their fields, W^T C_SS W: symmetric and positive
semi-definite by construction, and too small by the square of what the projection misses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from avatar_core.common.arrays import FloatArray, IntArray, farthest_points
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_by_position
from avatar_core.fem.patch_loads import LoadSurface, scaled_gram, triples
from avatar_core.offline.full_response import FullResponse, Solving, full_response
from avatar_core.offline.rule import CompletionRule, Progress
from avatar_core.reduction.regional import regions_of

_TOGETHER = 30  # positions, in the mean, that share the solutions on which they are projected
_RIDGE = 1e-6  # of C_SS, scaled to a unit diagonal: beyond, single precision has no more to say
_SAMPLED = 5  # one in so many components of the displacement says what a projection misses
_APART = 1.0  # of positions that are solved next, at least [patch radii]


@dataclass(frozen=True, eq=False)
class _Projection:
    """Positions that are projected on the same solutions.

    targets, sources : ndarray of int, loads that are projected, and solved ones
    weights : ndarray, shape (n_sources, n_targets), w
    residual : ndarray, shape (n_targets / 3,), eta over the root of the own compliance [-]
    """

    targets: IntArray
    sources: IntArray
    weights: FloatArray
    residual: FloatArray

    @property
    def positions(self) -> IntArray:
        """The positions that are projected."""
        return self.targets[::3] // 3


def completed_response(
    elasticity: Elasticity,
    surface: LoadSurface,
    loads: sp.csr_matrix,
    rule: CompletionRule,
    progress: Progress,
) -> FullResponse:
    """Solve for some positions and project the others, within a tolerance.

    Few positions are all solved.

    Parameters
    ----------
    loads : sparse, shape (3 n_nodes, 3 n_positions), three for each position
    """
    n = surface.n_positions
    if n <= rule.least:
        return full_response(elasticity, loads, progress, single=True)
    solving = Solving(elasticity, loads, single=True)
    projector = _Projector(elasticity, surface, loads, rule)
    mass = elasticity.mesh.lumped_mass[::_SAMPLED]
    solved, chosen = (
        np.zeros(n, bool),
        np.sort(farthest_points(surface.centers, round(rule.first * n))),
    )
    projections: list[_Projection] = []
    scale, left = np.nan, np.full(n, np.nan)  # of the estimate, which is scale times what is left
    while chosen.size:
        guess = _columns(projections, np.asfortranarray(solving.columns[::_SAMPLED]), chosen)
        for done in solving.solve(chosen):
            progress("solve", (solved.sum() + done) / n, scale * float(left.mean()))
        if projections:
            exact = solving.columns[::_SAMPLED, triples(chosen)]
            error = l2_by_position(guess - exact, mass) / l2_by_position(exact, mass)
            scale = float(error.mean() / left[chosen].mean())
        solved[chosen] = True
        projections = projector.project(solving.compliance, solved)
        left = _residual(projections, n)
        step, apart = max(1, round(rule.step * n)), _APART * surface.patch_radius
        chosen = np.sort(surface.largest_apart(left, step, apart))
        if rule.is_met(scale * float(left.mean()), scale * float(left.max())):
            break
    _fill(solving, projections, solved)
    progress("solve", 1.0, scale * float(left.mean()))
    return solving.response()


class _Projector:
    """Projects the loads that are not solved on the solutions around them."""

    def __init__(
        self,
        elasticity: Elasticity,
        surface: LoadSurface,
        loads: sp.csr_matrix,
        rule: CompletionRule,
    ) -> None:
        self._centers, self._reach = surface.centers, rule.reach * surface.patch_radius
        group = regions_of(surface.centers, surface.n_positions // _TOGETHER)
        self._groups = [np.flatnonzero(group == k) for k in range(group.max() + 1)]
        self._gram = scaled_gram(elasticity, loads)
        self._size = self._gram.diagonal()

    def project(self, compliance: FloatArray, solved: IntArray) -> list[_Projection]:
        """Weights and residuals of all loads of positions that are not solved."""
        sources = np.flatnonzero(solved)
        tree = cKDTree(self._centers[sources])
        found = []
        for group in self._groups:
            targets = group[~solved[group]]
            if len(targets):
                near = tree.query_ball_point(self._centers[targets], self._reach)
                among = sources[np.unique(np.concatenate(near).astype(int))]
                found.append(self._projection(compliance, triples(targets), triples(among)))
        return found

    def _projection(
        self, compliance: FloatArray, targets: IntArray, sources: IntArray
    ) -> _Projection:
        own, mixed = (
            compliance[np.ix_(part, sources)].astype(float) for part in (sources, targets)
        )
        scale = 1.0 / np.sqrt(np.diag(own))
        own = (own + own.T) / 2.0 * scale * scale[:, None]
        own[np.diag_indices_from(own)] += _RIDGE
        weights = cho_solve(cho_factor(own), (mixed * scale).T) * scale[:, None]
        given = np.einsum("ts,st->t", mixed, weights).reshape(-1, 3).sum(axis=1)
        rows = self._gram[sources]
        change = rows[:, sources].toarray() @ weights - 2.0 * rows[:, targets].toarray()
        square = self._size[targets] + np.einsum("st,st->t", weights, change)
        eta = np.maximum(square, 0.0).reshape(-1, 3).sum(axis=1)
        return _Projection(targets, sources, weights, np.sqrt(eta / np.maximum(given, 1e-300)))


def _residual(projections: Sequence[_Projection], n: int) -> FloatArray:
    """Of all positions, shape (n,); zero for those that are solved."""
    found = np.zeros(n)
    for projection in projections:
        found[projection.positions] = projection.residual
    return found


def _columns(
    projections: Sequence[_Projection], columns: FloatArray, positions: IntArray
) -> FloatArray:
    """Projected columns of some positions, ascending, in their order."""
    if not projections:
        return np.empty((len(columns), 0))
    found = np.empty((len(columns), 3 * len(positions)), np.float32)
    for projection in projections:
        here = np.flatnonzero(np.isin(projection.targets, triples(positions)))
        place = np.searchsorted(triples(positions), projection.targets[here])
        weights = projection.weights[:, here].astype(np.float32)
        found[:, place] = columns[:, projection.sources] @ weights
    return found


def _fill(solving: Solving, projections: Sequence[_Projection], solved: IntArray) -> None:
    """Set columns and compliance of the projected loads."""
    columns, compliance = solving.columns, solving.compliance
    known, others = (np.flatnonzero(np.repeat(part, 3)) for part in (solved, ~solved))
    own = compliance[np.ix_(known, known)]
    mixed = np.empty((len(known), len(others)), np.float32)
    rest = np.empty((len(others), len(others)), np.float32)
    for projection in projections:
        weights, here = projection.weights.astype(np.float32), projection.sources
        columns[:, projection.targets] = columns[:, here] @ weights
        place = np.searchsorted(others, projection.targets)
        mixed[:, place] = own[:, np.searchsorted(known, here)] @ weights
    for projection in projections:
        place = np.searchsorted(known, projection.sources)
        row = np.searchsorted(others, projection.targets)
        rest[row] = projection.weights.astype(np.float32).T @ mixed[place]
    compliance[np.ix_(known, others)], compliance[np.ix_(others, known)] = mixed, mixed.T
    compliance[np.ix_(others, others)] = rest
