"""Errors of a vademecum on unseen loads, and the cost of its build.

The reference is the full finite element solution on the same mesh. Loads are patches centred at
face centroids, which no part of the build uses, in three directions. The force and the displacement
of a step are compared at contacts anywhere on the faces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.certify.accuracy_curve import StepErrors, curve_of, step_errors
from avatar_core.common.processes import on_all_cores
from avatar_core.fem.norms import relative_l2
from avatar_core.fem.patch_loads import patch_loads, patch_normals
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.force_error import calibrated

if TYPE_CHECKING:
    from avatar_core.fem.elasticity import Elasticity
    from avatar_core.fem.patch_loads import LoadSurface
    from avatar_core.vademecum.model import Vademecum

_BATCH = 40  # load positions solved at once
_TRIED = 2  # loads first tried in single precision


def certify(
    vademecum: Vademecum,
    elasticity: Elasticity,
    n_loads: int = 200,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Certificate:
    """Measure a vademecum against full finite elements on unseen loads.

    Parameters
    ----------
    elasticity : Elasticity
        The problem it was built from.
    n_loads : int
        Unseen positions (all face centroids where the organ has fewer).
    seed : int
        Seed of the random choice.
    progress : Callable[[int], None] or None
        Called with the number of positions done so far.
    """
    errors = measured(vademecum, elasticity, n_loads, seed, progress, single=True)
    return certificate_of(vademecum, [errors], seed)


@dataclass(frozen=True, eq=False)
class UnseenErrors:
    """Relative errors; see :class:`Certificate`.

    l2 : (n, 3), of unseen loads
    contact, force : (n,), of unseen loads
    step : errors of as many unseen contacts
    """

    l2: np.ndarray
    contact: np.ndarray
    force: np.ndarray
    step: StepErrors


def measured(
    vademecum: Vademecum,
    elasticity: Elasticity,
    n_loads: int,
    seed: int,
    progress: Callable[[int], None] | None = None,
    single: bool = False,
) -> UnseenErrors:
    """Return the errors that :func:`certify` sums up.

    Parameters
    ----------
    single : bool
        Whether the reference is solved in single precision where that is accurate enough, which
        saves time for many loads.
    """
    surface = vademecum.surface
    single = single and _single_serves(vademecum, elasticity)
    elasticity = elasticity.refining() if single else elasticity
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(surface.corners))[:n_loads]
    normals = patch_normals(elasticity.mesh, surface.centroids, surface.patch_radius)
    mass = vademecum.mesh.lumped_mass
    l2, contact, force = [], [], []
    batches = np.array_split(chosen, max(1, len(chosen) // _BATCH))

    def solve(batch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _reference(elasticity, surface.centroids[batch], vademecum, single)

    elasticity.factorize(single)
    for batch, (truth, compliance) in zip(batches, on_all_cores(solve, batches), strict=True):
        for k, triangle in enumerate(batch):
            n, exact = normals[triangle], compliance[k]
            here = _at_centroid(surface, triangle)
            l2.append(relative_l2(vademecum.displacement(*here), truth[k], mass))
            estimate = vademecum.compliance(*here)
            contact.append(_frobenius(estimate, exact))
            force.append(abs((n @ exact @ n) / (n @ estimate @ n) - 1.0))
        if progress is not None:
            progress(len(l2))
    return UnseenErrors(
        np.array(l2),
        np.array(contact),
        np.array(force),
        step_errors(vademecum, elasticity, len(chosen), seed, single),
    )


def _single_serves(vademecum: Vademecum, elasticity: Elasticity) -> bool:
    surface = vademecum.surface
    some = patch_loads(elasticity, surface.centroids[:_TRIED], surface.patch_radius)
    return elasticity.single_serves(some.tocsc())


def certificate_of(vademecum: Vademecum, parts: Sequence[UnseenErrors], seed: int) -> Certificate:
    """Return one certificate of all errors: at one choice of the coordinates, or at several."""
    l2, contact, force = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("l2", "contact", "force")
    )
    steps = [part.step for part in parts]
    tip_force = np.concatenate([step.force for step in steps])
    smoothing = np.concatenate([step.smoothing for step in steps])
    shown = np.concatenate([step.shown for step in steps], axis=1)
    return Certificate(
        l2_mean=float(l2.mean()),
        l2_worst=float(l2.max()),
        contact_mean=float(contact.mean()),
        contact_worst=float(contact.max()),
        force_mean=float(force.mean()),
        force_worst=float(force.max()),
        tip_force_mean=float(tip_force.mean()),
        tip_force_worst=float(tip_force.max()),
        n_loads=len(contact),
        seed=seed,
        modes=vademecum.n_modes,
        force_error=calibrated(smoothing, tip_force),
        curve=curve_of(vademecum, shown, tip_force, steps[0].sizes),
    )


def _at_centroid(surface: LoadSurface, triangle: int) -> tuple[np.ndarray, np.ndarray]:
    """Return load positions and weights at the centroid of an accessible face."""
    positions, weights = surface.weights(np.array([triangle]), np.full((1, 3), 1.0 / 3.0))
    return positions[0], weights[0]


def _reference(
    elasticity: Elasticity, centers: np.ndarray, vademecum: Vademecum, single: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertex displacements (n, 3 n_vertices, 3) and patch compliances (n, 3, 3)."""
    loads = patch_loads(elasticity, centers, vademecum.surface.patch_radius)
    solution = elasticity.solve(loads, single)
    vertex = elasticity.at_vertices(solution).reshape(-1, len(centers), 3).transpose(1, 0, 2)
    average = (loads.T @ solution).reshape(len(centers), 3, len(centers), 3)
    own = np.arange(len(centers))
    return vertex, average[own, :, own, :]


def _frobenius(estimate: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(estimate - truth) / np.linalg.norm(truth))


def mesh_error(
    vademecum: Vademecum, elasticity: Elasticity, n_loads: int = 8
) -> tuple[float, float]:
    """Return the mean change of the reference itself when every tetrahedron is split into eight.

    Returns
    -------
    l2, contact : float
        Relative changes of displacement at the vertices and of the patch compliance.
    """
    refined = elasticity.refined()
    surface = vademecum.surface
    chosen = np.random.default_rng(0).permutation(len(surface.corners))[:n_loads]
    where = surface.centroids[chosen]
    coarse, coarse_compliance = _reference(elasticity, where, vademecum)
    fine, fine_compliance = _reference(refined, where, vademecum)
    fine = fine[:, : coarse.shape[1]]  # refinement appends its vertices
    l2 = relative_l2(coarse.swapaxes(0, 1), fine.swapaxes(0, 1), vademecum.mesh.lumped_mass)
    contact = [_frobenius(coarse_compliance[k], fine_compliance[k]) for k in range(len(chosen))]
    return float(np.mean(l2)), float(np.mean(contact))
