"""The offline stage: from an organ's mesh to its vademecum.

1. Every patch is solved, in single precision where it is accurate enough.
2. PGD finds modes common to all loads, and body functions join them. An orthogonal mixing sorts
   them by displacement norm. The first are the global modes of the displacement; the contact
   compliance uses all of them.
3. The remaining displacement is separated region by region of the load surface, in as many modes as
   the tolerance asks for. All modes together are separated block by block of the mesh.
4. The remaining contact compliance is kept near each load, tapered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import short
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import LoadSurface, patch_loads
from avatar_core.geometry.mesh import Regions
from avatar_core.offline.full_response import (
    FullResponse,
    contact_blocks,
    contact_near,
    full_response,
)
from avatar_core.offline.rule import NO_ERROR, BuildRule, Progress, silent
from avatar_core.reduction.block_field import separate_field
from avatar_core.reduction.pgd import EnrichmentReport, PGDRule, SolvedLoads, solve_pgd
from avatar_core.reduction.regional import RegionModes, separate_regions
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.display import Display, blocks_to_display
from avatar_core.vademecum.modal_mass import (
    LEAST_MODES,
    N_BODY,
    body_functions,
    body_response,
    motion_beside,
)
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Convergence, Provenance, RankError
from avatar_core.vademecum.tip_field import TipField

_ENERGY_TOLERANCE = 3e-3  # at which PGD stops: beyond, single precision has no more to say
_DEPENDENT = 1e-6  # part of a mode's energy below which it depends on the body's functions
_FEW = 3000  # loads whose compliance is multiplied in double precision
_BLOCK = 40  # pairs sought at once: products of a large matrix with few columns are slow
_RANK_STEP = 5  # between the numbers of modes whose errors are reported


@dataclass(frozen=True, eq=False)
class Modes:
    """K-orthonormal modes of all loads, sorted by displacement norm.

    space : ndarray, shape (3 n_nodes, rank), X
    load : ndarray, shape (n_loads, rank), Y = F^T X
    history : history of the enrichments
    """

    space: np.ndarray
    load: np.ndarray
    history: tuple[EnrichmentReport, ...]


def build_vademecum(
    name: str,
    elasticity: Elasticity,
    regions: Regions,
    surface: LoadSurface,
    tip_field: TipField,
    rule: BuildRule,
    provenance: Provenance,
    progress: Progress = silent,
    display: Display | None = None,
) -> Vademecum:
    """Compute the vademecum of one organ; see the module docstring for the stages.

    If the tolerance is not met within ``max_modes``, the vademecum is still complete and its
    ``convergence.converged`` is False.
    """
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    elasticity = elasticity.refining()
    response = full_response(elasticity, loads, progress)
    with_body = rule.max_modes >= LEAST_MODES
    n_body = N_BODY if with_body else 0
    modes = find_modes(elasticity, loads, response, rule.contact_modes - n_body, progress)
    n_global = min(rule.n_global - n_body, modes.load.shape[1])
    space, load = modes.space[:, :n_global], modes.load[:, :n_global]
    trailing, body = modes.load[:, n_global:], None
    if with_body:
        space, load, trailing = _with_body(elasticity, loads, modes, n_global)
        body = body_response(elasticity, space)
    trailing = short(trailing)  # the near field takes up the difference
    far = SeparatedField(elasticity.at_vertices(space), load)
    region, blocks = rule.regions(surface), blocks_to_display(elasticity.mesh, display)
    parts, errors = modes_of_regions(far, response, region, elasticity, rule, _half(progress, 0))
    field = separate_field(
        blocks,
        elasticity.mesh.vertex_volumes,
        region,
        parts,
        (far.space, load.reshape(surface.n_positions, 3, -1)),
        motion_beside(load, body),
        progress=lambda fraction: _half(progress, 1)("regions", fraction, NO_ERROR),
    )
    last = errors[-1]
    support = rule.contact_support * surface.patch_radius
    return Vademecum(
        name=name,
        mesh=elasticity.mesh,
        regions=regions,
        material=elasticity.material,
        element=elasticity.element,
        surface=surface,
        far=SeparatedField(far.space.astype(np.float32), load.astype(np.float32)),
        blocks=blocks,
        field=field,
        trailing=trailing,
        contact_near=contact_near(
            contact_blocks(response, surface, support),
            np.hstack([load, trailing]),
            surface,
            support,
        ),
        tip_field=tip_field,
        body=body,
        convergence=Convergence(
            rule.is_met(last.mean, last.worst), rule.tolerance, modes.history, errors
        ).with_errors(response.errors(blocks, field, elasticity.mesh.lumped_mass)),
        provenance=provenance,
        contrast=elasticity.inclusion.contrast if elasticity.inclusion else None,
        supports=elasticity.supports,
        display=display,
    )


def find_modes(
    elasticity: Elasticity,
    loads: sp.csr_matrix,
    response: FullResponse,
    n_modes: int,
    progress: Progress,
) -> Modes:
    """Return the modes by PGD in the energy norm of loads that are solved.

    Every load is divided by its own L2 norm, so that a load at a stiff place counts as much as one
    at a soft place. PGD of many loads works in single precision. Its modes are then solved and made
    orthonormal in double precision.
    """
    weights = 1.0 / response.norm**2
    compliance = response.compliance
    if len(compliance) <= _FEW:
        compliance = compliance.astype(float)
    found = solve_pgd(
        SolvedLoads(compliance, weights, response.energy),
        PGDRule(n_modes, _ENERGY_TOLERANCE, _BLOCK),
        lambda rank: progress("modes", rank / n_modes, NO_ERROR),
    )
    space = elasticity.solve(loads @ found.space)
    energy = space.T @ (loads @ found.space)
    root = np.linalg.inv(np.linalg.cholesky((energy + energy.T) / 2.0)).T
    space = space @ root
    load = np.asarray(loads.T @ space)
    modes = SeparatedField(elasticity.at_vertices(space), load)
    mixing = modes.mixing_by_norm(elasticity.mesh.lumped_mass, weights)
    return Modes(space @ mixing, load @ mixing, found.history)


def _with_body(
    elasticity: Elasticity, loads: sp.csr_matrix, modes: Modes, n_global: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first modes, then the body's functions, which hold all of its sag.

    Returns
    -------
    space (3 n_nodes, n), load (n_loads, n)
    trailing : ndarray, load functions of the other modes, orthogonal in energy to these
    """
    first, others = modes.space[:, :n_global], modes.space[:, n_global:]
    own = body_functions(elasticity, first)
    own_load = np.asarray(loads.T @ own)
    shared = elasticity.apply(own).T @ others
    value, vector = np.linalg.eigh(np.eye(others.shape[1]) - shared.T @ shared)
    new = value > _DEPENDENT
    trailing = modes.load[:, n_global:] - own_load @ shared
    trailing = (trailing @ (vector[:, new] / np.sqrt(value[new])))[:, ::-1]
    load = np.hstack([modes.load[:, :n_global], own_load])
    return np.hstack([first, own]), load, trailing


def modes_of_regions(
    far: SeparatedField,
    response: FullResponse,
    region: np.ndarray,
    elasticity: Elasticity,
    rule: BuildRule,
    progress: Progress = silent,
) -> tuple[list[RegionModes], tuple[RankError, ...]]:
    """Return regional modes of the global modes' remainder, and errors by number of modes."""
    regions, errors = separate_regions(
        region,
        lambda positions: response.remainder(far, positions),
        rule.regional,
        response.norm.reshape(-1, 3),
        elasticity.mesh.lumped_mass,
        lambda fraction: progress("regions", fraction, NO_ERROR),
    )
    most = max(modes.space.shape[1] for modes in regions)
    return regions, rank_errors(far.rank, errors[: most + 1])


def _half(progress: Progress, k: int) -> Progress:
    """Return the progress of the first or the second half of a stage."""
    return lambda stage, fraction, error: progress(stage, 0.5 * (k + fraction), error)


def rank_errors(n_global: int, errors: np.ndarray) -> tuple[RankError, ...]:
    """Return the mean and worst of errors (n_modes + 1, ...) by number of modes at a place."""
    last = len(errors) - 1
    return tuple(
        RankError(n_global + k, float(errors[k].mean()), float(errors[k].max()))
        for k in sorted({*range(0, last, _RANK_STEP), last})
    )
