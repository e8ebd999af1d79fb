"""Offline stage of large deformation: the series of every load position, in two terms.

Every load position gets its own terms, from a linear solution each with the stiffness at rest.
There are no training sites to choose, and only the linear vademecum's interpolation is needed. The
terms of a pull are those of the push with the sign of odd orders turned. Terms of fourth and fifth
order are *economised*: within the reach A they are replaced by the two that are kept,

    x^4 ~ -0.431 x^2 + 1.392 x^3,   x^5 ~ -0.686 x^2 + 1.610 x^3,   x = a / A in [0, 1],

to 3.8 and 7.5 % of A^4 and A^5, the least possible relative to x (Lanczos, Applied Analysis, 1956).
This error, and an estimate of the terms never computed, determine the reach. (The residual K^-1 r
is no measure. In nearly incompressible tissue the remaining rotation appears in it as a change of
volume, 50 times too large.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.patch_loads import LoadSurface, patch_loads
from avatar_core.offline.rule import NO_ERROR, Progress, silent
from avatar_core.reduction.asymptotic_series import path_series
from avatar_core.reduction.block_field import PART, separate_field
from avatar_core.reduction.regional import RegionalRule, separate_regions
from avatar_core.vademecum.large_deformation import (
    POWERS,
    LargeDeformation,
    LargeMaterial,
    hyperelastic,
)
from avatar_core.vademecum.model import Vademecum

_BATCH = 16  # paths followed at once, 40 MB each at paper size
_ORDER = 5
_WORST_OVER_MEAN = 5.0  # of what the modes of a region may leave
# x^4 and x^5 in x^2 and x^3 on [0, 1], and the largest error relative to x
_ECONOMISED = np.array([[-0.43078, 1.39231], [-0.68586, 1.61050]])
_LEFT = np.array([0.0385, 0.0754])
# of the terms by powers of |a|, for pushes and pulls
_SIGNS = np.stack([np.ones(_ORDER), (-1.0) ** np.arange(1, _ORDER + 1)])


@dataclass(frozen=True)
class LargeRule:
    """Range and accuracy of large deformation.

    Attributes
    ----------
    max_push : float
        Depth aimed at [m].
    tolerance : float
        Relative error of displacement (L2) and depth at the reach.
    least_det : float
        Smallest det F at the reach, so that no element is inside out.
    least_stiffness : float
        Smallest d(force)/d(depth), over its value at rest.
    max_modes : int
        Largest number of modes of a region.
    mode_tolerance : float
        Mean relative L2 error of these modes for the displacement at the reach.

    Examples
    --------
    >>> av.OrganOptions(large="neo-hookean", large_rule=av.LargeRule(max_push=10e-3)).large
    'neo-hookean'
    """

    max_push: float = 20e-3
    tolerance: float = 0.05
    least_det: float = 0.0
    least_stiffness: float = 0.2
    max_modes: int = 40
    mode_tolerance: float = 0.005


@dataclass(frozen=True, eq=False)
class _Paths:
    """Terms of all load positions, first for pushes, then for pulls.

    fields : ndarray float32, shape (2, 2, n_positions, 3 n_vertices), V_k [m^(1-k)]
    depth : ndarray, shape (2, 2, n_positions), beta_k; reach : (2, n_positions), a_max [m]
    size : ndarray, shape (2, n_positions), |u(a_max)| in L2
    """

    fields: FloatArray
    depth: FloatArray
    reach: FloatArray
    size: FloatArray


def with_large_deformation(
    vademecum: Vademecum,
    problem: Hyperelasticity,
    material: LargeMaterial,
    rule: LargeRule | None = None,
    progress: Progress = silent,
) -> Vademecum:
    """Return a linear vademecum with the load's magnitude as a coordinate.

    If ``max_modes`` do not meet ``mode_tolerance``, a notice in the provenance says so.

    problem : Hyperelasticity on the vademecum's mesh, clamp and material
    """
    rule = rule or LargeRule()
    paths = _follow(problem, vademecum.surface, rule, progress)
    region = vademecum.field.region
    size = paths.size[..., None] / paths.reach[..., None] ** np.array(POWERS)
    regions, errors = separate_regions(
        region,
        lambda positions: np.concatenate(paths.fields[:, :, positions]).transpose(2, 1, 0),
        RegionalRule(rule.mode_tolerance, _WORST_OVER_MEAN * rule.mode_tolerance, rule.max_modes),
        np.hstack(list(size)),
        vademecum.mesh.lumped_mass,
    )
    volumes = vademecum.mesh.vertex_volumes
    terms = separate_field(vademecum.blocks, volumes, region, regions, tolerance=PART)
    large = LargeDeformation(material, terms, paths.depth, paths.reach)
    provenance = vademecum.provenance
    left = float(errors[-1].mean())
    if left > rule.mode_tolerance:
        notice = (
            f"the {terms.rank} modes of large deformation leave {left:.1%} of the displacement, "
            f"more than the {rule.mode_tolerance:.1%} asked for"
        )
        provenance = replace(provenance, notices=(*provenance.notices, notice))
    return replace(vademecum, large=large, provenance=provenance)


def _follow(
    problem: Hyperelasticity, surface: LoadSurface, rule: LargeRule, progress: Progress
) -> _Paths:
    n, n_vertices = surface.n_positions, len(problem.mesh.vertices)
    mass = problem.mesh.lumped_mass
    loads = patch_loads(problem.linear, surface.centers, surface.patch_radius).tocsc()
    fields = np.empty((2, len(POWERS), n, 3 * n_vertices), np.float32)
    depth, reach, size = np.empty((2, len(POWERS), n)), np.empty((2, n)), np.empty((2, n))
    for first in range(0, n, _BATCH):
        batch = np.arange(first, min(first + _BATCH, n))
        inward = sp.block_diag([-surface.normals[[j]].T for j in batch], format="csc")
        force = (loads[:, 3 * batch[0] : 3 * (batch[-1] + 1)] @ inward).toarray()
        terms = path_series(problem, force, _ORDER)
        average = np.einsum("xj,xj->j", force, terms[0])
        terms = terms / (average ** np.arange(1, _ORDER + 1)[:, None])[:, None]
        for (i, j), (side, turned) in product(enumerate(batch), enumerate(_SIGNS)):
            one = turned[:, None] * terms[:, :, i]
            beta = force[:, i] @ one.T
            reach[side, j], size[side, j] = _reach(problem, one, beta, mass, rule)
            fields[side, :, j] = economised(one[:, : 3 * n_vertices], reach[side, j])
            depth[side, :, j] = economised(beta, reach[side, j])
        progress("large", (batch[-1] + 1) / n, NO_ERROR)
    return _Paths(fields, depth, reach, size)


def economised(terms: FloatArray, reach: float) -> FloatArray:
    """Return the terms of second and third order that replace all but the first, shape (2, ...).

    terms : ndarray, shape (5, ...), by powers of a
    reach : A [m]
    """
    scale = reach ** np.arange(4, _ORDER + 1)[:, None] / reach ** np.array(POWERS)
    return np.asarray(terms[1:3] + np.tensordot((scale * _ECONOMISED).T, terms[3:], axes=1))


def _reach(
    problem: Hyperelasticity, terms: FloatArray, beta: FloatArray, mass: FloatArray, rule: LargeRule
) -> tuple[float, float]:
    """Return the largest linear depth up to ``max_push`` that two terms cover, and |u| there in L2.

    terms : ndarray, shape (5, 3 n_nodes)
    beta : ndarray, shape (5,), their inward depth of the patch
    """
    beta = np.sign(beta[0]) * beta
    at_vertices = terms[:, : len(mass)]
    inner = (at_vertices * mass) @ at_vertices.T
    a = np.linspace(0.0, _linear_depth(beta, rule), 61)[1:]
    power = a[:, None] ** np.arange(1, _ORDER + 1)
    size = np.sqrt(np.einsum("ak,kl,al->a", power[:, :3], inner[:3, :3], power[:, :3]))
    length = np.sqrt(np.diagonal(inner)) * power / size[:, None]
    part = np.abs(beta) * power / (power[:, :3] @ beta[:3])[:, None]
    holds = np.maximum(_left(length), _left(part)) <= rule.tolerance
    last = len(a) - 1 if holds.all() else max(0, int(np.argmin(holds)) - 1)
    while last > 0 and problem.min_det(terms[:3].T @ power[last, :3]) <= rule.least_det:
        last = int(0.9 * last)
    return float(a[last]), float(size[last])


def _left(size: FloatArray) -> FloatArray:
    """Return the relative error of two terms, shape (n,).

    size : sizes of all five terms at n reaches, shape (n, 5)

    Terms never computed count as the sixth, in proportion to the last two. On a real liver, that is
    within a factor of three of the truth up to 20 mm.
    """
    fourth, fifth = size[:, 3], size[:, 4]
    ratio = np.minimum(fifth / np.maximum(fourth, 1e-30), 1.0)
    return np.asarray(size[:, 3:] @ _LEFT + fifth * ratio)


def _linear_depth(beta: FloatArray, rule: LargeRule) -> float:
    """Return a at which the depth is ``max_push``, or less where the organ hardly resists."""
    a = np.linspace(0.0, 1.5 * rule.max_push, 301)
    order = np.arange(1, _ORDER + 1)
    depth = a[:, None] ** order @ beta
    slope = a[:, None] ** (order - 1) @ (order * beta)  # d(depth)/da
    holds = (slope < 1.0 / rule.least_stiffness) & (slope > rule.least_stiffness)
    holds &= depth <= rule.max_push
    return float(a[max(1, int(np.argmin(holds)) - 1)]) if not holds.all() else float(a[-1])


def hyperelastic_problem(vademecum: Vademecum, material: LargeMaterial) -> Hyperelasticity:
    """Return the large deformation problem on a vademecum's mesh, clamp and material."""
    large = hyperelastic(material, vademecum.material)
    return Hyperelasticity(vademecum.mesh, large, vademecum.regions.clamped)
