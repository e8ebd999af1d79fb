"""How wrong a vademecum is, on loads that it has never seen, and what it cost.

The truth is the full finite element solution on the same mesh. Loads are patches centred at face
centroids, which no part of the build uses, in three directions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from avatar_core.loads import patch_loads, patch_normals
from avatar_core.splines import evaluate
from avatar_core.tip_response import make_tip_response

if TYPE_CHECKING:
    from avatar_core.elasticity import Elasticity
    from avatar_core.loads import LoadSurface
    from avatar_core.vademecum import Vademecum

_BATCH = 40  # load positions solved at once
_TIP_RADIUS = 2e-3  # [m]
_MEANS = ("l2_mean", "contact_mean", "force_mean", "felt_mean")
_WORST = ("l2_worst", "contact_worst", "force_worst", "felt_worst", "vertex_contact_worst")


@dataclass(frozen=True)
class Certificate:
    """Relative errors (fractions) on unseen loads, mean and worst, and the cost.

    l2 : |u - u_FE| / |u_FE| over all vertices, mass-weighted, each load and direction
    contact : |C - C_FE|_F / |C_FE|_F of the 3 x 3 compliance of the loaded patch
    force : |F / F_FE - 1| of the normal force for an imposed normal indentation
    felt : the same as a 2 mm tip feels it when it touches, through the compliance that the
        contact step smooths so that no edge of the mesh is felt
    vertex_contact_worst : contact error at load positions of the build, on fresh solves
    n_loads : unseen load positions; ``seed`` draws them
    build_cpu_seconds : user + system time of everything, meshing and this certificate included
    mesh_l2, mesh_contact : change of the reference when the mesh is refined once (NaN: not asked)
    """

    l2_mean: float
    l2_worst: float
    contact_mean: float
    contact_worst: float
    force_mean: float
    force_worst: float
    felt_mean: float
    felt_worst: float
    vertex_contact_worst: float
    n_loads: int
    seed: int
    modes: int
    build_cpu_seconds: float = float("nan")
    mesh_l2: float = float("nan")
    mesh_contact: float = float("nan")

    @classmethod
    def unknown(cls) -> Certificate:
        """A certificate that promises nothing."""
        nan = float("nan")
        return cls(nan, nan, nan, nan, nan, nan, nan, nan, nan, 0, 0, 0)


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
    vademecum : Vademecum
    elasticity : Elasticity, the problem it was built from
    n_loads : unseen positions (all face centroids where the organ has fewer)
    seed : of the random choice
    progress : called with the number of positions done so far
    """
    surface = vademecum.surface
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(surface.corners))[:n_loads]
    normals = patch_normals(elasticity.mesh, surface.centroids, surface.patch_radius)
    felt_compliance = _FeltCompliance(vademecum)
    l2, contact, force, felt = [], [], [], []
    for batch in np.array_split(chosen, max(1, len(chosen) // _BATCH)):
        truth, compliance = _reference(elasticity, surface.centroids[batch], vademecum)
        for k, triangle in enumerate(batch):
            normal = normals[triangle]
            here = _at_centroid(surface, triangle)
            l2.append(_l2(vademecum, vademecum.displacement(*here), truth[k]))
            estimate = vademecum.compliance(*here)
            contact.append(_frobenius(estimate, compliance[k]))
            force.append(abs(normal @ compliance[k] @ normal / (normal @ estimate @ normal) - 1))
            felt.append(abs(normal @ compliance[k] @ normal / felt_compliance(triangle) - 1))
        if progress is not None:
            progress(len(contact))
    return Certificate(
        l2_mean=float(np.mean(l2)),
        l2_worst=float(np.max(l2)),
        contact_mean=float(np.mean(contact)),
        contact_worst=float(np.max(contact)),
        force_mean=float(np.mean(force)),
        force_worst=float(np.max(force)),
        felt_mean=float(np.mean(felt)),
        felt_worst=float(np.max(felt)),
        vertex_contact_worst=_vertex_contact(vademecum, elasticity, rng),
        n_loads=len(chosen),
        seed=seed,
        modes=vademecum.far.rank,
    )


def merged(parts: Sequence[Certificate]) -> Certificate:
    """One certificate of several equally large ones: means of the means, worst of the worst."""

    def mean(name: str) -> float:
        return float(np.mean([getattr(part, name) for part in parts]))

    def worst(name: str) -> float:
        return float(np.max([getattr(part, name) for part in parts]))

    values: dict[str, Any] = {name: mean(name) for name in _MEANS}
    values |= {name: worst(name) for name in _WORST}
    return replace(parts[0], **values, n_loads=sum(part.n_loads for part in parts))


def _at_centroid(surface: LoadSurface, triangle: int) -> tuple[np.ndarray, np.ndarray]:
    """Load positions and weights at the centroid of an accessible face."""
    positions, weights = surface.weights(np.array([triangle]), np.full((1, 3), 1.0 / 3.0))
    return positions[0], weights[0]


class _FeltCompliance:
    """The compliance that a small tip feels as it touches an accessible face at its centroid."""

    def __init__(self, vademecum: Vademecum) -> None:
        surface, self._field = vademecum.surface, vademecum.tip_field
        load = vademecum.far.load.reshape(surface.n_positions, 3, -1)
        response = make_tip_response(
            surface, self._field, load, vademecum.contact_near, _TIP_RADIUS, _TIP_RADIUS
        )
        self._values = response.self_compliance
        self._tips = surface.centroids + _TIP_RADIUS * surface.face_normals

    def __call__(self, triangle: int) -> float:
        field, tip = self._field, self._tips[triangle]
        return float(
            evaluate(self._values, field.origin, field.spacing[0], tip, np.zeros(3), np.nan)
        )


def _reference(
    elasticity: Elasticity, centers: np.ndarray, vademecum: Vademecum
) -> tuple[np.ndarray, np.ndarray]:
    """Vertex displacements (n, 3 n_vertices, 3) and patch compliances (n, 3, 3)."""
    loads = patch_loads(elasticity, centers, vademecum.surface.patch_radius)
    solution = elasticity.solve(loads)
    vertex = elasticity.at_vertices(solution).reshape(-1, len(centers), 3).transpose(1, 0, 2)
    average = (loads.T @ solution).reshape(len(centers), 3, len(centers), 3)
    own = np.arange(len(centers))
    return vertex, average[own, :, own, :]


def _l2(vademecum: Vademecum, estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Relative mass-weighted error of each direction, shape (3,)."""
    mass = np.repeat(vademecum.mesh.vertex_volumes, 3)[:, None]
    return np.sqrt((mass * (estimate - truth) ** 2).sum(axis=0) / (mass * truth**2).sum(axis=0))


def _frobenius(estimate: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(estimate - truth) / np.linalg.norm(truth))


def _vertex_contact(
    vademecum: Vademecum, elasticity: Elasticity, rng: np.random.Generator
) -> float:
    surface = vademecum.surface
    some = rng.permutation(len(surface.vertices))[:_BATCH]
    _, compliance = _reference(elasticity, surface.centers[some], vademecum)
    return max(
        _frobenius(vademecum.compliance(np.array([i]), np.ones(1)), compliance[k])
        for k, i in enumerate(some)
    )


def mesh_error(
    vademecum: Vademecum, elasticity: Elasticity, n_loads: int = 8
) -> tuple[float, float]:
    """Mean change of the reference itself when every tetrahedron is split into eight.

    Returns
    -------
    l2, contact : relative changes of displacement at the vertices and of the patch compliance
    """
    refined = elasticity.refined()
    surface = vademecum.surface
    chosen = np.random.default_rng(0).permutation(len(surface.corners))[:n_loads]
    where = surface.centroids[chosen]
    coarse, coarse_compliance = _reference(elasticity, where, vademecum)
    fine, fine_compliance = _reference(refined, where, vademecum)
    fine = fine[:, : coarse.shape[1]]  # refinement appends its vertices
    l2 = [_l2(vademecum, coarse[k], fine[k]) for k in range(len(chosen))]
    contact = [_frobenius(coarse_compliance[k], fine_compliance[k]) for k in range(len(chosen))]
    return float(np.mean(l2)), float(np.mean(contact))
