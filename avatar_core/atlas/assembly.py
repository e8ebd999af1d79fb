"""Assembly of a patient's vademecum from a response: sorted modes, regions and near field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar_core.atlas.patient_problem import PatientProblem
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.full_response import remainder
from avatar_core.offline.rule import BuildRule
from avatar_core.reduction.block_field import BlockField, Blocks, separate_field
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.reduction.galerkin import residual_compliance_blocks
from avatar_core.reduction.near_field import LocalBlocks, taper
from avatar_core.reduction.regional import separate_regions
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.display import Display, blocks_to_display
from avatar_core.vademecum.modal_mass import motion_beside
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Convergence, Provenance
from avatar_core.vademecum.tip_field import TipField


def surroundings(problem: PatientProblem) -> tuple[TetMesh, Regions, float, SurfaceMesh | None]:
    """Return the inputs of a tip field: mesh, regions, patch radius and outline."""
    return problem.mesh, problem.regions, problem.loads.patch_radius, problem.outline


def assembled(
    problem: PatientProblem,
    response: CompactResponse,
    support: float,
    convergence: Convergence,
    rule: BuildRule,
    tip_field: TipField,
    display: Display | None,
) -> Vademecum:
    """Return the vademecum of a compact response: leading modes are global, the rest by regions.

    support : reach of the residual compliance [m]
    rule : limits of modes and regions
    """
    loads, modes = problem.loads, _sorted_by_norm(response, problem.mesh)
    n_global, rank = min(rule.n_global, modes.rank), min(rule.contact_modes, modes.rank)
    blocks = blocks_to_display(problem.mesh, display)
    reach = rule.contact_support * loads.patch_radius
    residual = residual_compliance_blocks(response.residual_compliance, support, loads, reach)
    return Vademecum(
        name=problem.surface.name,
        mesh=problem.mesh,
        regions=problem.regions,
        material=problem.elasticity.material,
        element=problem.elasticity.element,
        surface=loads,
        far=modes.truncate(n_global),
        blocks=blocks,
        field=_field(modes, n_global, problem, rule, blocks),
        trailing=modes.load[:, n_global:rank],
        contact_near=_with_gram_of(modes.load[:, rank:], residual, loads, reach),
        tip_field=tip_field,
        convergence=convergence,
        provenance=provenance(problem),
        supports=problem.elasticity.supports,
        display=display,
    )


def _field(
    modes: SeparatedField, n_global: int, problem: PatientProblem, rule: BuildRule, blocks: Blocks
) -> BlockField:
    """Return the global modes, and the others separated by regions, in blocks."""
    mass, region = problem.mesh.lumped_mass, rule.regions(problem.loads)
    root = np.asarray(np.linalg.qr(np.sqrt(mass)[:, None] * modes.space, mode="r"))
    size = np.linalg.norm(modes.load @ root.T, axis=1).reshape(-1, 3)
    far = modes.truncate(n_global)
    space, load = modes.space[:, n_global:], modes.load[:, n_global:].reshape(len(size), 3, -1)
    regions, _ = separate_regions(
        region,
        lambda positions: np.tensordot(space, load[positions], ([1], [2])),
        rule.regional,
        np.maximum(size, 1e-300),
        mass,
    )
    return separate_field(
        blocks,
        problem.mesh.vertex_volumes,
        region,
        regions,
        (far.space, far.load.reshape(len(size), 3, -1)),
        motion_beside(far.load, None),
    )


def _with_gram_of(
    load: np.ndarray, near: LocalBlocks, surface: LoadSurface, reach: float
) -> LocalBlocks:
    """Return the blocks plus the tapered compliance Y Y^T of modes that are left out."""
    distance = near.distances(surface.centers)
    zero = replace(near, block=np.zeros_like(near.block))
    left = remainder(zero, load, taper(distance / reach))
    return replace(near, block=near.block - left.block)


def _sorted_by_norm(response: CompactResponse, mesh: TetMesh) -> SeparatedField:
    """Return modes rotated so that the first hold most displacement; Y Y^T does not change."""
    field_ = SeparatedField(np.asarray(response.space, float), np.asarray(response.load, float))
    size = np.maximum((field_.load**2).sum(axis=1), 1e-300)
    sorted_ = field_.sorted_by_norm(mesh.lumped_mass, 1.0 / size)
    return SeparatedField(sorted_.space.astype(np.float32), sorted_.load.astype(np.float32))


def provenance(problem: PatientProblem) -> Provenance:
    """Return the provenance: the patient's surface, and the template of clamp and regions."""
    surface = problem.surface
    held = " ".join(f"{s.name}={s.stiffness:g}" for s in problem.elasticity.supports)
    parameters = {"template": problem.registration.template.name} | (
        {"supports": held} if held else {}
    )
    return Provenance(
        source=surface.name,
        source_sha256=surface.source_sha256,
        unit=surface.unit,
        axes=surface.axes_name,
        parameters=tuple(f"{name}={value}" for name, value in parameters.items()),
        notices=surface.notices + problem.notices,
    )
