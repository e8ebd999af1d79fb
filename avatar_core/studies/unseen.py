"""Full solutions at unseen loads and unseen values of the material, to compare fields with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import relative_l2
from avatar_core.fem.patch_loads import LoadSurface, patch_loads
from avatar_core.reduction.affine import CanonicalField
from avatar_core.reduction.affine_elasticity import N_NODES
from avatar_core.reduction.coordinates import Coordinate, problem_at

# Nodal displacement (3 n_nodes, 3 n) under unit forces at points of the surface, at some values
NodalField = Callable[[Mapping[str, float], np.ndarray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Unseen:
    """Loads at face centroids and their exact answers at one choice of values.

    positions, weights : ndarray, shape (n, 3 or 6), the centroids among the load positions
    loads : sparse, shape (3 n_nodes, 3 n); solution : ndarray of that shape [m/N]
    mass : ndarray, shape (3 n_vertices,), lumped
    """

    values: Mapping[str, float]
    positions: np.ndarray
    weights: FloatArray
    loads: sp.csr_matrix
    solution: FloatArray
    mass: FloatArray

    def errors(self, found: FloatArray) -> tuple[FloatArray, FloatArray]:
        """L2 of each load, and of the 3 x 3 contact displacement of each patch (Frobenius)."""
        n_vertex = len(self.mass)
        l2 = relative_l2(found[:n_vertex], self.solution[:n_vertex], self.mass)
        exact, mine = self._own(self.solution), self._own(found)
        contact = np.linalg.norm(mine - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
        return l2, contact

    def _own(self, field: FloatArray) -> FloatArray:
        n = len(self.positions)
        average = (self.loads.T @ field).reshape(n, 3, n, 3)
        return np.asarray(average[np.arange(n), :, np.arange(n)])


def unseen(
    elasticity: Elasticity,
    surface: LoadSurface,
    coordinates: Sequence[Coordinate],
    n_values: int,
    n_loads: int,
    seed: int = 1,
) -> list[Unseen]:
    """Random values, even in each coordinate's own scale, and random centroids for each."""
    rng = np.random.default_rng(seed)
    mass = elasticity.mesh.lumped_mass
    out = []
    for _ in range(n_values):
        values = {c.name: c.value_at(rng.random()) for c in coordinates}
        faces = rng.permutation(len(surface.corners))[:n_loads]
        positions, weights = surface.weights(faces, np.full((len(faces), 3), 1.0 / 3.0))
        loads = patch_loads(elasticity, surface.centroids[faces], surface.patch_radius)
        solution = problem_at(elasticity, values).solve(loads)
        out.append(Unseen(values, positions, weights, loads, solution, mass))
    return out


def errors(cases: Sequence[Unseen], field: NodalField) -> dict[str, float]:
    """Mean and worst of L2, mean of contact, over all cases."""
    found = [case.errors(field(case.values, case.positions, case.weights)) for case in cases]
    l2, contact = (np.concatenate(part) for part in zip(*found, strict=True))
    return {
        "l2_mean": float(l2.mean()),
        "l2_worst": float(l2.max()),
        "contact_mean": float(contact.mean()),
        "contact_worst": float(contact.max()),
    }


def canonical_at(field: CanonicalField, coordinates: Sequence[Coordinate]) -> NodalField:
    """A canonical field between the nodes of its parameters, by Lagrange's polynomials."""

    def at(values: Mapping[str, float], positions: np.ndarray, weights: FloatArray) -> FloatArray:
        factor = np.ones(field.rank)
        for functions, coordinate in zip(field.parameters, coordinates, strict=True):
            factor = factor * (lagrange(coordinate, values[coordinate.name]) @ functions)
        load = np.einsum("ni,nidk->ndk", weights, field.load.reshape(-1, 3, field.rank)[positions])
        return field.space @ (load.reshape(-1, field.rank) * factor).T

    return at


def lagrange(coordinate: Coordinate, value: float) -> FloatArray:
    """Weights of the Gauss nodes of a coordinate at a value, shape (N_NODES,)."""
    nodes = 0.5 + 0.5 * np.polynomial.legendre.leggauss(N_NODES)[0]
    place = coordinate.fraction(value)
    out = np.ones(N_NODES)
    for i in range(N_NODES):
        for j in range(N_NODES):
            if j != i:
                out[i] *= (place - nodes[j]) / (nodes[i] - nodes[j])
    return out
