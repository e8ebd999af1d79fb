"""Offline stage of a vademecum with coordinates of material and supports.

1. At every node of the coordinates all patches are solved, like for an ordinary vademecum, and PGD
   finds the modes there.
2. The modes of all nodes are compressed into one space basis (proper orthogonal decomposition over
   nodes and loads). The functions of the body are among its first.
3. The stiffness is projected term by term. The displacement beyond the first functions is separated
   by regions, for all nodes together. The contact compliance beyond the basis is kept near the
   patch at every node.

The space basis serves every value in the range by a small Galerkin system.
:mod:`avatar_core.reduction.coordinates` says why it is no canonical separated form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from avatar_core.common.supports import SUPPORT
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import LoadSurface, patch_loads
from avatar_core.geometry.mesh import Regions
from avatar_core.offline.full_response import (
    FullResponse,
    contact_blocks,
    contact_near,
    full_response,
)
from avatar_core.offline.linear import Modes, find_modes, rank_errors
from avatar_core.offline.rule import BuildRule, Progress, silent
from avatar_core.reduction.block_field import BlockField, Blocks, separate_field
from avatar_core.reduction.coordinates import RESECTION, Coordinate, node_values, problem_at
from avatar_core.reduction.near_field import LocalBlocks
from avatar_core.reduction.regional import RegionalRule, RegionModes, separate_regions
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.display import Display, blocks_to_display
from avatar_core.vademecum.modal_mass import (
    LEAST_MODES,
    N_BODY,
    BodyResponse,
    body_response,
    completed,
    motion_beside,
    principal_sags,
    sag_of,
)
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.parametric import (
    GalerkinBasis,
    ParametricResponse,
    field_at,
    galerkin_field,
    regional_load_of_basis,
    stiffness_root,
)
from avatar_core.vademecum.record import Convergence, Provenance, RankError
from avatar_core.vademecum.tip_field import TipField

_LEAST_SAG = 1e-3  # least relative remainder of a sag that gets its own function


@dataclass(frozen=True, eq=False)
class _Snapshot:
    """The full solutions at one node, and the modes that PGD found there.

    response : without its compliance; ``contact`` holds the near part of it [m/N]
    modes : Modes, their space (3 n_nodes, n) in single precision
    sag : under unit weights along x, y and z, shape (3 n_nodes, 3)
    """

    elasticity: Elasticity
    response: FullResponse
    contact: LocalBlocks
    modes: Modes
    sag: np.ndarray


class _Organ(NamedTuple):
    """Parts of an organ that do not depend on the coordinates."""

    name: str
    elasticity: Elasticity
    regions: Regions
    surface: LoadSurface
    blocks: Blocks
    tip_field: TipField


def build_parametric_vademecum(
    name: str,
    elasticity: Elasticity,
    regions: Regions,
    surface: LoadSurface,
    coordinates: Sequence[Coordinate],
    tip_field: TipField,
    rule: BuildRule,
    provenance: Provenance,
    progress: Progress = silent,
    display: Display | None = None,
) -> Vademecum:
    """Compute the vademecum of one organ over a range of materials and supports.

    The vademecum's own fields are those at the values of ``elasticity``, moved into the ranges. For
    the other parameters see :func:`avatar_core.offline.linear.build_vademecum`.

    Parameters
    ----------
    elasticity : Elasticity
        Problem with an element for the whole range, and the inclusion if the contrast is a
        coordinate.
    """
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    nodes = node_values(coordinates)
    snapshots = [
        _solved(problem_at(elasticity, values), loads, surface, rule, _part(progress, k, nodes))
        for k, values in enumerate(nodes)
    ]
    basis = _project(snapshots, _principal(snapshots, rule), loads, rule)
    blocks = blocks_to_display(elasticity.mesh, display)
    organ = _Organ(name, elasticity, regions, surface, blocks, tip_field)
    vademecum = _assemble(organ, tuple(coordinates), rule, snapshots, basis)
    vademecum = replace(vademecum, provenance=provenance, display=display)
    return vademecum.at(_inside(coordinates, elasticity))


def _part(progress: Progress, k: int, nodes: Sequence[object]) -> Progress:
    """Return the progress of one node's solutions as a part of all."""
    return lambda stage, fraction, error: progress(stage, (k + fraction) / len(nodes), error)


def _solved(
    elasticity: Elasticity,
    loads: sp.csr_matrix,
    surface: LoadSurface,
    rule: BuildRule,
    progress: Progress,
) -> _Snapshot:
    """Solve all patches at one node, and find the modes there."""
    half = 0.5

    def first(stage: str, fraction: float, error: float) -> None:
        progress("solve", half * fraction, error)

    def second(stage: str, fraction: float, error: float) -> None:
        progress("solve", half + half * fraction, error)

    response = full_response(elasticity, loads, first)
    modes = find_modes(elasticity, loads, response, rule.contact_modes, second)
    contact = contact_blocks(response, surface, rule.contact_support * surface.patch_radius)
    _, sag = sag_of(elasticity)
    elasticity = elasticity.at(elasticity.material)  # drops the factorization, 0.5 GB
    return _Snapshot(
        elasticity,
        replace(response, compliance=np.empty((0, 0), np.float32)),
        contact,
        replace(modes, space=modes.space.astype(np.float32)),
        sag,
    )


def _principal(snapshots: Sequence[_Snapshot], rule: BuildRule) -> np.ndarray:
    """Return the principal space functions over all nodes and loads, shape (3 n_nodes, n).

    X holds the modes of all nodes side by side, with X^T M X = A^T A, and Y is block-diagonal with
    Y^T W Y = B^T B. The functions are X B^T R for the leading R in A B^T = P S R^T.
    """
    mesh = snapshots[0].elasticity.mesh
    space = np.hstack([snapshot.modes.space for snapshot in snapshots])
    mass = mesh.lumped_mass
    a = np.linalg.qr(np.sqrt(mass)[:, None] * space[: len(mass)].astype(float), mode="r")
    roots = [
        np.linalg.qr(snapshot.modes.load / snapshot.response.norm[:, None], mode="r")
        for snapshot in snapshots
    ]
    b = np.asarray(scipy.linalg.block_diag(*roots))
    _, _, right = np.linalg.svd(a @ b.T, full_matrices=False)
    n = min(rule.contact_modes, len(right))
    space = space @ np.linalg.qr(b.T @ right[:n].T)[0].astype(np.float32)
    sags = np.hstack([snapshot.sag for snapshot in snapshots])
    return np.hstack([space, _beside(space, sags, mass)])


def _beside(space: np.ndarray, sags: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Return functions of the sags beyond a space, (3 n_nodes, n); surface loads hold 95 %."""
    n = len(mass)  # vertices alone are weighted
    root = np.sqrt(mass)[:, None]
    sags = sags / np.linalg.norm(root * sags[:n], axis=0)
    left = sags - space @ np.linalg.lstsq(root * space[:n], root * sags[:n], rcond=None)[0]
    _, value, right = np.linalg.svd(root * left[:n], full_matrices=False)
    return np.asarray(left @ right[value > _LEAST_SAG].T)


def _project(
    snapshots: Sequence[_Snapshot], space: np.ndarray, loads: sp.csr_matrix, rule: BuildRule
) -> GalerkinBasis:
    """Return the Galerkin projection of every term of the stiffness."""
    middle = snapshots[len(snapshots) // 2].elasticity
    space = space.astype(float)
    operators = _projected_terms(middle, space)
    stiffness = np.tensordot(middle.factors, operators, axes=1)
    inverse = np.linalg.inv(np.linalg.cholesky(stiffness)).T  # single precision can hold these
    space, operators = space @ inverse, inverse.T @ operators @ inverse
    n_global, body = min(rule.n_global, space.shape[1]), None
    if rule.max_modes >= LEAST_MODES:
        body = body_response(middle, space)
        every = [
            np.linalg.solve(np.tensordot(s.elasticity.factors, operators, axes=1), body.weight)
            for s in snapshots
        ]
        sags = principal_sags(np.hstack(every))
        order, n_global = _body_among_first(body, sags, n_global)
        space, operators, body = space @ order, order.T @ operators @ order, body.mixed(order)
    vertices, load = middle.at_vertices(space), loads.T @ space
    return GalerkinBasis(
        basis=SeparatedField(vertices.astype(np.float32), load.astype(np.float32)),
        operators=operators,
        n_global=n_global,
        rank=load.shape[1],
        body=body,
    )


def _body_among_first(
    body: BodyResponse, sags: np.ndarray, n_global: int
) -> tuple[np.ndarray, int]:
    """Return a rotation of a basis by which the body's functions complete its first, (n, n).

    It also returns the number of the first functions, as some of the body's may depend on others.
    """
    identity = np.eye(len(body.mass))
    first = completed(body, sags, identity[:, : n_global - N_BODY])
    rotation, triangle = np.linalg.qr(np.hstack([first, identity[:, n_global - N_BODY :]]))
    signs = np.where(np.diagonal(triangle) < 0.0, -1.0, 1.0)
    return rotation * signs[: rotation.shape[1]], first.shape[1]


def _projected_terms(elasticity: Elasticity, space: np.ndarray) -> np.ndarray:
    n_terms = len(elasticity.factors)
    terms = np.stack([space.T @ elasticity.apply_term(q, space) for q in range(n_terms)])
    return (terms + terms.transpose(0, 2, 1)) / 2.0


def _assemble(
    organ: _Organ,
    coordinates: tuple[Coordinate, ...],
    rule: BuildRule,
    snapshots: Sequence[_Snapshot],
    basis: GalerkinBasis,
) -> Vademecum:
    """Assemble the vademecum: regional modes of all nodes, and near fields at each.

    The vademecum's own fields are those of the first node.
    """
    surface, elasticity = organ.surface, organ.elasticity
    roots = [stiffness_root(basis, s.elasticity.factors) for s in snapshots]
    fields = [galerkin_field(basis, root) for root in roots]
    region = rule.regions(surface)
    own = replace(rule.regional, most=max(1, rule.max_modes - basis.n_global))
    regions, errors = _regions(snapshots, [far for far, _, _ in fields], region, own)
    field, left = _separated(organ, basis, roots, fields, region, regions)
    mass = elasticity.mesh.lumped_mass
    projection = _coefficients(basis.basis.space, regions, mass)
    for k, (root, (_, trailing, _)) in enumerate(zip(roots, fields, strict=True)):
        left[k] -= regional_load_of_basis(basis, projection, root, trailing, region)
    support = rule.contact_support * surface.patch_radius
    contact = [
        contact_near(s.contact, np.hstack([far.load, trailing]), surface, support)
        for s, (far, trailing, _) in zip(snapshots, fields, strict=True)
    ]
    first, (far, trailing, body) = snapshots[0].elasticity, fields[0]
    last = errors[-1]
    history = tuple(report for snapshot in snapshots for report in snapshot.modes.history)
    core = field.core[:, : basis.n_global]
    shared = far.load.reshape(surface.n_positions, 3, -1)
    load = np.concatenate([shared.astype(np.float32), field.load[:, :3, basis.n_global :]], axis=2)
    return Vademecum(
        name=organ.name,
        mesh=elasticity.mesh,
        regions=organ.regions,
        material=first.material,
        element=elasticity.element,
        surface=surface,
        far=far,
        blocks=organ.blocks,
        field=field_at(field, core, roots[0], load),
        trailing=trailing,
        contact_near=contact[0],
        tip_field=organ.tip_field,
        convergence=Convergence(
            rule.is_met(last.mean, last.worst), rule.tolerance, history, errors
        ).with_errors(_errors(organ, snapshots, field)),
        provenance=Provenance(organ.name, ""),
        parametric=ParametricResponse(
            **vars(basis),
            coordinates=coordinates,
            projection=projection,
            regional_load=left,
            core=np.ascontiguousarray(core),
            contact_near=np.stack([blocks.block for blocks in contact]),
            young_modulus=elasticity.material.young_modulus,
        ),
        contrast=first.inclusion.contrast if first.inclusion else None,
        supports=first.supports,
        resection=first.resection,
        body=body,
    )


def _regions(
    snapshots: Sequence[_Snapshot],
    fields: Sequence[SeparatedField],
    region: np.ndarray,
    rule: RegionalRule,
) -> tuple[list[RegionModes], tuple[RankError, ...]]:
    """Return regional modes of the global modes' remainder at all nodes, and errors by modes."""

    def columns(positions: np.ndarray) -> np.ndarray:
        pairs = zip(snapshots, fields, strict=True)
        return np.concatenate([s.response.remainder(f, positions) for s, f in pairs], axis=2)

    regions, errors = separate_regions(
        region,
        columns,
        rule,
        np.hstack([s.response.norm.reshape(len(region), 3) for s in snapshots]),
        snapshots[0].elasticity.mesh.lumped_mass,
    )
    most = max(modes.space.shape[1] for modes in regions)
    return regions, rank_errors(fields[0].rank, errors[: most + 1])


def _separated(
    organ: _Organ,
    basis: GalerkinBasis,
    roots: Sequence[np.ndarray],
    fields: Sequence[tuple[SeparatedField, np.ndarray, BodyResponse | None]],
    region: np.ndarray,
    regions: Sequence[RegionModes],
) -> tuple[BlockField, np.ndarray]:
    """Return the field of the basis's first functions and of the regional modes, for all nodes.

    Returns
    -------
    field : the field, with the loads of all nodes side by side
    load : loads in the regional modes alone, shape (n_nodes, n_positions, 3, most)
    """
    n, n_positions = basis.n_global, len(region)
    amounts, motion = [], []
    for root, (far, _, body) in zip(roots, fields, strict=True):
        inverse = np.linalg.inv(root[:n, :n])  # X = V L^-T moves as V does with amounts a L^-1
        amounts.append((far.load @ inverse).reshape(n_positions, 3, n))
        motion.append(motion_beside(far.load, body) @ inverse)
    field = separate_field(
        organ.blocks,
        organ.elasticity.mesh.vertex_volumes,
        region,
        regions,
        (basis.basis.space[:, :n], np.concatenate(amounts, axis=1)),
        np.concatenate(motion),
    )
    load = field.load[:, :, n:].reshape(n_positions, len(roots), 3, -1).transpose(1, 0, 2, 3)
    return field, np.array(load, order="C")


def _errors(organ: _Organ, snapshots: Sequence[_Snapshot], field: BlockField) -> np.ndarray:
    """Return relative L2 errors of a field under each load, the loads of all nodes side by side."""
    mass, out = organ.elasticity.mesh.lumped_mass, []
    for k, snapshot in enumerate(snapshots):
        own = replace(field, load=field.load[:, 3 * k : 3 * k + 3])
        out.append(snapshot.response.errors(organ.blocks, own, mass))
    return np.stack(out)


def _coefficients(
    space: np.ndarray, regions: Sequence[RegionModes], mass: np.ndarray
) -> np.ndarray:
    """Return functions (3 n_vertices, n) in the modes of each region, which are mass-orthogonal.

    Returns
    -------
    ndarray of float32, shape (n_regions, most, n), zero beyond a region's modes
    """
    most = max(modes.space.shape[1] for modes in regions)
    out = np.zeros((len(regions), most, space.shape[1]), np.float32)
    for r, (modes, _) in enumerate(regions):
        weighted = mass[:, None] * modes
        size = np.einsum("xk,xk->k", weighted, modes)
        out[r, : len(size)] = weighted.T @ space / size[:, None]
    return out


def _inside(coordinates: Sequence[Coordinate], elasticity: Elasticity) -> dict[str, float]:
    """Return the values of a problem, moved into the ranges of the coordinates."""
    inclusion = elasticity.inclusion
    here = {
        "poisson": elasticity.material.poisson_ratio,
        "contrast": inclusion.contrast if inclusion else 1.0,
        **{SUPPORT + support.name: support.stiffness for support in elasticity.supports},
        RESECTION: elasticity.resection.opened if elasticity.resection else 0.0,
    }
    return {c.name: float(np.clip(here[c.name], c.low, c.high)) for c in coordinates}
