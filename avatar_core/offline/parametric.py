"""Offline stage of a vademecum with coordinates of the material.

1. at every node of the coordinates all patches are solved, as for an ordinary vademecum, and PGD
   finds the modes there;
2. the modes of all nodes are compressed into one space basis (proper orthogonal decomposition
   over nodes and loads), with weights of the loads that grow with their error;
3. the stiffness is projected term by term, and its error near the patch is kept at every node.

The space basis serves every value in the range by a small Galerkin system. A canonical separated
form in all coordinates (:mod:`avatar_core.reduction.pgd_parametric`) needs several times as many
modes and stagnates towards incompressibility, where the energy norm sees nothing but the change of
volume.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from avatar_core.contact.ball_shift import make_felt_field
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import LoadSurface, patch_loads
from avatar_core.geometry.mesh import Regions
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.certify.linear import certificate_of, measured
from avatar_core.offline.exact_response import (
    ExactResponse,
    FarFieldResidual,
    contact_near,
    displacement_near,
    exact_response,
)
from avatar_core.offline.linear import find_modes, is_met
from avatar_core.offline.rule import BuildRule, Progress, silent
from avatar_core.reduction.coordinates import Coordinate, node_values, problem_at
from avatar_core.reduction.pgd import EnrichmentReport
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.at_values import at_values
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.modal_mass import LEAST_MODES, BodyResponse, body_response
from avatar_core.vademecum.model import Convergence, Provenance, RankError, Vademecum
from avatar_core.vademecum.parametric import ParametricResponse, galerkin_field
from avatar_core.vademecum.tip_field import TipField

_BASIS_OVER_RANK = 4.0  # functions of the basis over the modes used at given values
_DRAWN = 6  # random values that a certificate is made at
_ROUNDS = 3  # of weighting loads by the error that the basis leaves


@dataclass(frozen=True, eq=False)
class _Snapshot:
    """The full solutions at one node, and the modes that PGD found there.

    space : (3 n_nodes, n) float32; load : (n_loads, n)
    """

    elasticity: Elasticity
    response: ExactResponse
    residual: FarFieldResidual
    space: np.ndarray
    load: np.ndarray
    history: tuple[EnrichmentReport, ...]


@dataclass(frozen=True, eq=False)
class _Reduced:
    """A space basis, the projected terms of the stiffness, and the far field at every node."""

    basis: SeparatedField
    operators: np.ndarray
    fields: tuple[SeparatedField, ...]
    body: BodyResponse | None


def build_parametric_vademecum(
    name: str,
    elasticity: Elasticity,
    regions: Regions,
    surface: LoadSurface,
    coordinates: Sequence[Coordinate],
    rule: BuildRule,
    provenance: Provenance,
    progress: Progress = silent,
    outline: SurfaceMesh | None = None,
) -> Vademecum:
    """Compute the vademecum of one organ over a range of materials.

    Its own fields are those at the values of ``elasticity``, moved into the ranges.

    Parameters
    ----------
    elasticity : with an element that serves the whole range, and the inclusion if the contrast
        is a coordinate
    outline : of which the mesh was made, which tools touch; None for the mesh's own boundary
    """
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    nodes = node_values(coordinates)
    rule_per_node = replace(rule, max_sample_bytes=rule.max_sample_bytes // len(nodes))
    snapshots = [
        _solved(
            problem_at(elasticity, values), loads, surface, rule_per_node, _part(progress, k, nodes)
        )
        for k, values in enumerate(nodes)
    ]
    reduced, error = _reduce(snapshots, loads, rule)
    if not is_met(error.mean, error.worst, rule) and rule.near_growth > 1.0:
        rule = rule.with_wider_near_field()
        snapshots = [_with_near_field(snapshot, surface, rule) for snapshot in snapshots]
        error = _rank_error(_errors(snapshots, reduced), rule)
    field = make_felt_field(elasticity.mesh, regions, surface.patch_radius, outline)
    whole = _assemble(
        name, elasticity, regions, surface, tuple(coordinates), rule, snapshots, reduced, field
    )
    history = tuple(report for snapshot in snapshots for report in snapshot.history)
    converged = is_met(error.mean, error.worst, rule)
    whole = replace(
        whole,
        provenance=provenance,
        convergence=Convergence(converged, rule.tolerance, history, (error,)),
    )
    return at_values(whole, _inside(coordinates, elasticity))


def _part(progress: Progress, k: int, nodes: Sequence[object]) -> Progress:
    """Progress of one node's solutions as a part of all."""
    return lambda stage, fraction, error: progress(stage, (k + fraction) / len(nodes), error)


def _solved(
    elasticity: Elasticity,
    loads: sp.csr_matrix,
    surface: LoadSurface,
    rule: BuildRule,
    progress: Progress,
) -> _Snapshot:
    """All patches at one node, and the modes there."""
    half = 0.5

    def first(stage: str, fraction: float, error: float) -> None:
        progress("solve", half * fraction, error)

    def second(stage: str, fraction: float, error: float) -> None:
        progress("solve", half + half * fraction, error)

    response = exact_response(elasticity, surface, loads, rule, first)
    residual = FarFieldResidual(elasticity, surface, response, rule)
    solution, _ = find_modes(elasticity, loads, response, residual, rule, second)
    residual.reset()
    space = solution.space.astype(np.float32)
    elasticity = elasticity.at(elasticity.material)  # drops the factorization, 0.5 GB
    return _Snapshot(elasticity, response, residual, space, solution.load, solution.history)


def _reduce(
    snapshots: Sequence[_Snapshot], loads: sp.csr_matrix, rule: BuildRule
) -> tuple[_Reduced, RankError]:
    """The best basis for all nodes, after a few rounds of weighting loads by their error."""
    weights = [1.0 / snapshot.response.norm**2 for snapshot in snapshots]
    best: tuple[_Reduced, RankError] | None = None
    for _ in range(_ROUNDS):
        reduced = _project(snapshots, _principal(snapshots, weights, rule), loads, rule)
        errors = _errors(snapshots, reduced)
        error = _rank_error(errors, rule)
        if best is None or error.worst < best[1].worst:
            best = reduced, error
        for snapshot, weight, left in zip(snapshots, weights, errors, strict=True):
            weight[snapshot.residual.loads] *= (left / error.mean) ** 2
    assert best is not None
    return best


def _errors(snapshots: Sequence[_Snapshot], reduced: _Reduced) -> list[np.ndarray]:
    """Relative L2 error of the kept loads at every node, near field included."""
    out = []
    for snapshot, field in zip(snapshots, reduced.fields, strict=True):
        out.append(snapshot.residual.subtract(field.space, field.load))
        snapshot.residual.reset()
    return out


def _rank_error(errors: Sequence[np.ndarray], rule: BuildRule) -> RankError:
    everything = np.concatenate(errors)
    return RankError(rule.max_modes, float(everything.mean()), float(everything.max()))


def _with_near_field(snapshot: _Snapshot, surface: LoadSurface, rule: BuildRule) -> _Snapshot:
    """A snapshot whose errors are measured outside the near field of ``rule``."""
    residual = FarFieldResidual(snapshot.elasticity, surface, snapshot.response, rule)
    return replace(snapshot, residual=residual)


def _principal(
    snapshots: Sequence[_Snapshot], weights: Sequence[np.ndarray], rule: BuildRule
) -> np.ndarray:
    """Principal space functions over all nodes and loads, shape (3 n_nodes, n).

    With X the modes of all nodes side by side, X^T M X = A^T A, and Y block-diagonal with
    Y^T W Y = B^T B, these are X B^T R for the leading R in A B^T = P S R^T.
    """
    mesh = snapshots[0].elasticity.mesh
    space = np.hstack([snapshot.space for snapshot in snapshots])
    mass = mesh.lumped_mass
    a = np.linalg.qr(np.sqrt(mass)[:, None] * space[: len(mass)].astype(float), mode="r")
    roots = [
        np.linalg.qr(np.sqrt(weight)[:, None] * snapshot.load, mode="r")
        for snapshot, weight in zip(snapshots, weights, strict=True)
    ]
    b = np.asarray(scipy.linalg.block_diag(*roots))
    _, _, right = np.linalg.svd(a @ b.T, full_matrices=False)
    n = min(int(_BASIS_OVER_RANK * rule.max_modes), len(right))
    return space @ np.linalg.qr(b.T @ right[:n].T)[0].astype(np.float32)


def _project(
    snapshots: Sequence[_Snapshot], space: np.ndarray, loads: sp.csr_matrix, rule: BuildRule
) -> _Reduced:
    """Galerkin projection of every term of the stiffness, and the far field at the nodes."""
    middle = snapshots[len(snapshots) // 2].elasticity
    space = space.astype(float)
    operators = _projected_terms(middle, space)
    stiffness = np.tensordot(middle.factors, operators, axes=1)
    inverse = np.linalg.inv(np.linalg.cholesky(stiffness)).T  # single precision can hold these
    space, operators = space @ inverse, inverse.T @ operators @ inverse
    basis = SeparatedField(middle.at_vertices(space), loads.T @ space)
    mass = middle.mesh.lumped_mass
    body = body_response(middle, space) if rule.max_modes >= LEAST_MODES else None
    fields = tuple(
        galerkin_field(basis, operators, s.elasticity.factors, mass, rule.max_modes, body)[0]
        for s in snapshots
    )
    return _Reduced(basis, operators, fields, body)


def _projected_terms(elasticity: Elasticity, space: np.ndarray) -> np.ndarray:
    n_terms = len(elasticity.factors)
    terms = np.stack([space.T @ elasticity.apply_term(q, space) for q in range(n_terms)])
    return (terms + terms.transpose(0, 2, 1)) / 2.0


def _assemble(
    name: str,
    elasticity: Elasticity,
    regions: Regions,
    surface: LoadSurface,
    coordinates: tuple[Coordinate, ...],
    rule: BuildRule,
    snapshots: Sequence[_Snapshot],
    reduced: _Reduced,
    tip_field: TipField,
) -> Vademecum:
    """Near fields at all nodes; the vademecum's own fields are those of the first."""
    none = np.empty(0, np.int64)
    pairs = list(zip(snapshots, reduced.fields, strict=True))
    near = [displacement_near(far, s.response, surface, rule, none) for s, far in pairs]
    contact = [contact_near(far, s.response, surface, rule) for s, far in pairs]
    basis = SeparatedField(
        reduced.basis.space.astype(np.float32), reduced.basis.load.astype(np.float32)
    )
    first = snapshots[0].elasticity
    return Vademecum(
        name=name,
        mesh=elasticity.mesh,
        regions=regions,
        material=first.material,
        element=elasticity.element,
        surface=surface,
        far=reduced.fields[0],
        near=near[0],
        contact_near=contact[0],
        tip_field=tip_field,
        convergence=Convergence(False, rule.tolerance),
        provenance=Provenance(name, ""),
        parametric=ParametricResponse(
            coordinates=coordinates,
            basis=basis,
            operators=reduced.operators,
            near=np.stack([blocks.block for blocks in near]),
            contact_near=np.stack([blocks.block for blocks in contact]),
            rank=rule.max_modes,
            young_modulus=elasticity.material.young_modulus,
            body=reduced.body,
        ),
        contrast=first.inclusion.contrast if first.inclusion else None,
    )


def _inside(coordinates: Sequence[Coordinate], elasticity: Elasticity) -> dict[str, float]:
    """The values of a problem, moved into the ranges of the coordinates."""
    inclusion = elasticity.inclusion
    here = {
        "poisson": elasticity.material.poisson_ratio,
        "contrast": inclusion.contrast if inclusion else 1.0,
    }
    return {c.name: float(np.clip(here[c.name], c.low, c.high)) for c in coordinates}


def certify_range(
    vademecum: Vademecum,
    elasticity: Elasticity,
    n_loads: int = 200,
    seed: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> Certificate:
    """Measure a vademecum on unseen loads at unseen values of its coordinates.

    The loads are divided among some random values and the ends of the range.
    """
    assert vademecum.parametric is not None
    values = _certified_values(vademecum.parametric.coordinates, seed)
    n_each = max(1, n_loads // len(values))
    found = []
    for k, point in enumerate(values):
        here = at_values(vademecum, point)
        found.append(measured(here, problem_at(elasticity, point), n_each, seed + k))
        progress((k + 1) * n_each)
    return certificate_of(vademecum, found, seed)


def _certified_values(coordinates: Sequence[Coordinate], seed: int) -> list[dict[str, float]]:
    """Values drawn evenly in each coordinate's own scale, and both corners of the range."""
    rng = np.random.default_rng(seed)
    drawn = [{c.name: c.value_at(rng.random()) for c in coordinates} for _ in range(_DRAWN)]
    corners = [
        {c.name: end for c, end in zip(coordinates, ends, strict=True)}
        for ends in ([c.low for c in coordinates], [c.high for c in coordinates])
    ]
    return drawn + corners
