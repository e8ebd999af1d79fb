"""Transfer from a base of anatomies to a patient: weights, and the combined response (Eq. 18).

The same template mesh is registered to all anatomies. Their elastic responses are stored on it as
u_i(x, s) = X_i(x) Y_i(s)^T, with C_i = Y_i Y_i^T the compliance between load positions. With
weights w, the compliance of a patient is

    C = sum_i w_i C_i ~ Y Y^T,    its leading positive part,
    u = sum_i w_i u_i ~ X Y^T,    X = sum_i w_i X_i Y_i^T Y (Y^T Y)^-1.

The combined response is therefore separated, and its contact compliance symmetric and positive,
even if weights are negative.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp

from avatar_core.atlas.base import PatientBase, PatientError
from avatar_core.atlas.model import MOST_NEIGHBORS, centred
from avatar_core.common.arrays import FloatArray
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.reduction.compact_response import CompactResponse, positive_part
from avatar_core.shapes.correspondence import interpolation_matrix, load_map
from avatar_core.shapes.registration import Registration
from avatar_core.shapes.weights import DEFAULT_REGULARIZATION, Barycenter, barycenter, kriging

Weighting = Literal["kriging", "lle-template", "lle-grid", "lle-paper"]
# Neighbors and ridge of LLE: the paper's (Sec. 3.3), and those with the least leave-one-out error
# of 64 livers (`avatar study transport`).
LLE_SETTINGS: dict[str, tuple[int, float]] = {
    "lle-template": (40, 3e-4),
    "lle-grid": (MOST_NEIGHBORS, 3e-4),
    "lle-paper": (10, DEFAULT_REGULARIZATION),
}
_OVERSAMPLING = 20  # random columns beyond the rank of a combination


# --- weights ----------------------------------------------------------------------------------


def patient_weights(
    base: PatientBase,
    registration: Registration,
    surface: SurfaceMesh,
    weighting: Weighting = "kriging",
    n_neighbors: int | None = None,
    leave_out: Collection[int] = (),
) -> Barycenter:
    """Return the weights of the anatomies of a base for a patient.

    Parameters
    ----------
    weighting : Weighting
        "kriging" (:func:`kriging`) and "lle-template" (Eq. 15) use the centred registered vertices.
        "lle-grid" is Eq. 15 on the distances at the common grid. "lle-paper" is the paper's form of
        it, with ten neighbors and almost no ridge.
    n_neighbors : int or None
        k; None for the 64 nearest, 40 with "lle-template" and 10 with "lle-paper".
    leave_out : Collection[int]
        Anatomies that get no weight; their copies get none either.

    Raises
    ------
    PatientError
        For an unknown weighting, one on the grid with a base that has no grid distances, or a
        number to leave out that the base does not have.
    LLEError
        For k <= 0 or a base with no anatomy left.
    """
    if weighting not in get_args(Weighting):
        raise PatientError(
            f"unknown weighting {weighting!r}; choose one of {', '.join(get_args(Weighting))}"
        )
    left = base.without(leave_out)
    available = len(base.names) - len(left)
    if weighting in ("lle-grid", "lle-paper"):
        if base.distances is None or base.distance_of is None:
            raise PatientError("the base has no distances on a grid; choose weighting 'kriging'")
        vectors: Sequence[FloatArray] = base.distances
        point = base.distance_of(surface, registration)
    else:
        vectors, point = centred(base.vertices), centred([registration.mesh.vertices])[0]
    most, ridge = LLE_SETTINGS.get(weighting, (MOST_NEIGHBORS, DEFAULT_REGULARIZATION))
    k = min(most, available) if n_neighbors is None else n_neighbors
    if weighting == "kriging":
        return kriging(vectors, point, k, left)
    return barycenter(vectors, point, k, regularization=ridge, leave_out=left)


# --- responses ----------------------------------------------------------------------------------


def combine(
    responses: Sequence[CompactResponse], weights: Barycenter, rank: int = 100
) -> CompactResponse:
    """Combine responses by Eq. 18 nodewise; a member of the base keeps its response exactly.

    The leading part of C is found by two subspace iterations on random columns (Halko, Martinsson &
    Tropp, SIAM Review 53, 2011). They use every response three times and never form C.

    Parameters
    ----------
    rank : int
        Largest number of modes.
    """
    if weights.member is not None:
        return responses[weights.member]
    terms = [
        (np.float32(w), responses[j])
        for w, j in zip(weights.weights, weights.neighbors, strict=True)
    ]
    basis, value = leading_loads(terms, rank)
    load = basis * np.sqrt(value)
    dual = basis / np.sqrt(value)
    space = np.zeros((len(terms[0][1].space), len(value)), np.float32)
    for w, response in terms:
        space += w * (response.space @ (response.load.T @ dual))
    return CompactResponse(space, load, _combined_residual_compliance(terms))


def leading_loads(
    terms: Sequence[tuple[np.floating, CompactResponse]], rank: int
) -> tuple[FloatArray, FloatArray]:
    """Return the leading positive eigenpairs of C = sum_i w_i Y_i Y_i^T.

    Returns
    -------
    vectors : ndarray, shape (3 n_positions, r)
        Orthonormal eigenvectors, r <= rank.
    values : ndarray, shape (r,)
        Eigenvalues [m/N].
    """
    n_loads = len(terms[0][1].load)

    def compliance(forces: FloatArray) -> FloatArray:
        out = np.zeros((n_loads, forces.shape[1]), np.float32)
        for w, response in terms:
            out += w * (response.load @ (response.load.T @ forces))
        return out

    columns = min(rank + _OVERSAMPLING, n_loads)
    basis = np.random.default_rng(0).standard_normal((n_loads, columns)).astype(np.float32)
    for _ in range(2):
        basis = np.linalg.qr(compliance(basis))[0]
    small = basis.T @ compliance(basis)
    value, vector = np.linalg.eigh((small + small.T) / 2.0)
    best = np.argsort(-value)[:rank]
    best = best[value[best] > 1e-6 * value.max()]
    return basis @ vector[:, best], value[best]


def _combined_residual_compliance(
    terms: Sequence[tuple[np.floating, CompactResponse]],
) -> FloatArray:
    total = np.sum([w * response.residual_compliance for w, response in terms], axis=0, dtype=float)
    return positive_part(total)


# --- onto the patient ---------------------------------------------------------------------------


def carried(
    response: CompactResponse,
    registration: Registration,
    loads: LoadSurface,
    elasticity: Elasticity,
    surface: LoadSurface,
) -> CompactResponse:
    """Interpolate a template response to a patient's vertices and load positions.

    Displacements of the clamped vertices are set to zero.

    Parameters
    ----------
    loads : LoadSurface
        Load positions of the template.
    elasticity : Elasticity
        Problem of the patient.
    surface : LoadSurface
        Load positions of the patient.
    """
    mesh = elasticity.mesh
    fields = interpolation_matrix(registration.mesh, mesh.vertices)
    positions = load_map(registration, loads, surface.centers)
    return _clamped(_mapped(response, fields, positions), elasticity)


def carried_by_place(
    base: PatientBase,
    weights: Barycenter,
    registration: Registration,
    elasticity: Elasticity,
    surface: LoadSurface,
    rank: int = 100,
) -> CompactResponse:
    """Combine responses by Eq. 18 at common coordinates: x and s are positions, like in the paper.

    The centroids of all organs coincide. A point outside an anatomy takes the displacement of its
    closest point. Evaluation at the patient's own points avoids the interpolation error of the
    paper's grid.
    """
    mesh, here = elasticity.mesh, registration.mesh.centroid
    moved = []
    for j in weights.neighbors:
        placed = base.mesh_at(int(j), here)
        laid = replace(registration, mesh=placed)
        fields = interpolation_matrix(placed, mesh.vertices)
        positions = load_map(laid, base.loads, surface.centers)
        moved.append(_mapped(base.responses[j], fields, positions))
    member = None if weights.member is None else 0
    own = replace(weights, neighbors=np.arange(len(moved)), member=member)
    return _clamped(combine(moved, own, rank), elasticity)


def _mapped(
    response: CompactResponse, fields: sp.csr_matrix, positions: sp.csr_matrix
) -> CompactResponse:
    residual = positions @ response.residual_compliance.reshape(-1, 9)
    return CompactResponse(
        by_component(fields, response.space),
        by_component(positions, response.load),
        positive_part(residual.reshape(-1, 3, 3)),
    )


def by_component(matrix: sp.csr_matrix, values: FloatArray) -> FloatArray:
    """Return a scalar interpolation applied to each component of nodal vectors, (3 n, rank)."""
    rank = values.shape[1]
    mapped = matrix.astype(values.dtype) @ values.reshape(-1, 3 * rank)
    return np.asarray(mapped).reshape(-1, rank)


def _clamped(response: CompactResponse, elasticity: Elasticity) -> CompactResponse:
    space = response.space.copy()
    held = elasticity.clamped_nodes
    space.reshape(-1, 3, space.shape[1])[held[held < len(elasticity.mesh.vertices)]] = 0.0
    return replace(response, space=space)
