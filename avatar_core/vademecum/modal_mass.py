"""Mass and weight of the organ, projected onto the modes of a vademecum.

PGD modes of loads at the surface represent body forces with an error of some 3 % and free vibration
with 7 % in the fifth frequency. N_BODY functions are therefore added to them: the sag under gravity
along x, y and z, and the slowest modes of free vibration,

    K phi = omega^2 rho M phi,

with M the consistent mass of the same finite elements for a unit density.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla

from avatar_core.errors import ConvergenceError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import require_orthonormal

N_VIBRATIONS = 6
N_BODY = 3 + N_VIBRATIONS
_WEIGHT = 1e4  # weight of a liver per volume [N/m^3]
LEAST_MODES = 4 * N_BODY  # with fewer, surface loads need them all
_DEPENDENT = 1e-6  # part of a body function's energy below which the modes already represent it
# With 0.03 the sag of a cut phantom was 7 % off at one end of the range.
_SAME_SAG = 0.005  # singular value of unit sags below which they are one
_EIGEN_TOLERANCE = 1e-6  # tolerance of the slowest vibrations


@dataclass(frozen=True, eq=False)
class BodyResponse:
    """Mass and weight of the organ, projected onto K-orthonormal modes X.

    Attributes
    ----------
    mass : ndarray, shape (rank, rank)
        X^T M X for a unit density [s^2 m^3 / kg].
    weight : ndarray, shape (rank, 3)
        X^T M e_d, a uniform body force on each mode [m^3.5 ...].
    """

    mass: np.ndarray
    weight: np.ndarray

    def mixed(self, mixing: np.ndarray) -> BodyResponse:
        """Return mass and weight in the modes X A, with A of shape (rank, n)."""
        return BodyResponse(mixing.T @ self.mass @ mixing, mixing.T @ self.weight)


def body_response(elasticity: Elasticity, space: np.ndarray) -> BodyResponse:
    """Return mass and weight in modes at all nodes, shape (3 n_nodes, rank)."""
    n = elasticity.n_nodes
    by_node = space.reshape(n, 3, -1)
    pushed = (elasticity.mass @ by_node.reshape(n, -1)).reshape(space.shape)
    total = np.asarray(elasticity.mass.sum(axis=0)).ravel()
    return BodyResponse(space.T @ pushed, np.einsum("ndk,n->kd", by_node, total))


def body_functions(elasticity: Elasticity, space: np.ndarray) -> np.ndarray:
    """Return functions that complete K-orthonormal modes, K-orthonormal to them and one another.

    Parameters
    ----------
    space : ndarray, shape (3 n_nodes, rank)
        K-orthonormal modes.

    Returns
    -------
    ndarray, shape (3 n_nodes, n), n <= N_BODY

    Raises
    ------
    ConvergenceError
        If the eigenvalue solver does not converge or the functions are not orthonormal.
    """
    mass = sp.kron(elasticity.mass, sp.identity(3), format="csr")
    weight, sag = sag_of(elasticity)
    vibration, rate = _vibrations(elasticity, mass)
    functions, forces = np.hstack([sag, vibration]), np.hstack([weight, (mass @ vibration) * rate])
    size = np.sqrt(np.einsum("xk,xk->k", functions, forces))
    functions, forces = functions / size, forces / size
    held = space.T @ forces
    energy = functions.T @ forces - held.T @ held
    value, vector = np.linalg.eigh((energy + energy.T) / 2.0)
    new = value > _DEPENDENT
    own = np.asarray((functions - space @ held) @ (vector[:, new] / np.sqrt(value[new])))
    modes = np.hstack([space, own])
    tolerance = 10.0 * _EIGEN_TOLERANCE
    require_orthonormal(modes, elasticity.apply(own), "modes and body functions", tolerance)
    return own


def sag_of(elasticity: Elasticity) -> tuple[np.ndarray, np.ndarray]:
    """Return nodal forces of unit weights along x, y, z, and the sag under them, (3 n_nodes, 3)."""
    by_axis = np.asarray(elasticity.mass.sum(axis=1)).reshape(-1, 1, 1) * np.eye(3)
    weight = by_axis.reshape(-1, 3)
    return weight, elasticity.solve(weight)


def principal_sags(sags: np.ndarray) -> np.ndarray:
    """Return few orthonormal functions whose span holds some sags, coefficients (n, n_sags)."""
    vector, value, _ = np.linalg.svd(sags / np.linalg.norm(sags, axis=0), full_matrices=False)
    return np.asarray(vector[:, value > _SAME_SAG])


def motion_beside(load: np.ndarray, body: BodyResponse | None) -> np.ndarray:
    """Return amplitudes by which global modes may move beside the present loads, (n, rank).

    A history may leave the amplitudes of any load (3 n_positions, rank). Each axis of the organ's
    weight counts as much as all loads together.
    """
    if body is None:
        return load
    sag = _WEIGHT * body.weight.T
    return np.concatenate([load, np.repeat(sag, len(load), axis=0)])


def _vibrations(elasticity: Elasticity, mass: sp.csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """Return the slowest vibration modes (3 n_nodes, n), and their omega^2 at unit density."""
    free = np.ones(mass.shape[0], bool)
    free.reshape(-1, 3)[elasticity.clamped_nodes] = False
    full = np.zeros((mass.shape[0], 1))

    def solved(force: np.ndarray) -> np.ndarray:
        full[free, 0] = force.ravel()
        return elasticity.solve(full)[free, 0]

    inner = mass[free][:, free]
    size = int(free.sum())
    # K^-1 is all that Lanczos asks of K in shift and invert around zero
    inverse = sla.LinearOperator((size, size), matvec=solved, dtype=float)
    start = np.random.default_rng(0).standard_normal(size)
    try:
        rate, vector = sla.eigsh(
            inverse, N_VIBRATIONS, inner, sigma=0.0, OPinv=inverse, v0=start, tol=_EIGEN_TOLERANCE
        )
    except sla.ArpackNoConvergence as error:
        raise ConvergenceError(
            f"the slowest vibrations were not found ({error}); check the mesh for slivers"
        ) from error
    vibration = np.zeros((mass.shape[0], N_VIBRATIONS))
    vibration[free] = vector
    return vibration, rate


def completed(body: BodyResponse, sags: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return the columns that add the body's functions to some modes of a K-orthonormal basis.

    Parameters
    ----------
    body : BodyResponse
        Mass and weight in the basis, n functions.
    sags : ndarray, shape (n, n_sags)
        Sags of the organ under its weight.
    kept : ndarray, shape (n, rank)
        Orthonormal modes to be completed.

    Returns
    -------
    ndarray, shape (n, rank + n_sags + N_VIBRATIONS or less)
        Orthonormal columns, the first equal to ``kept``.
    """
    _, vibration = np.linalg.eigh((body.mass + body.mass.T) / 2.0)
    functions = np.hstack([sags, vibration[:, ::-1][:, :N_VIBRATIONS]])
    functions = functions / np.linalg.norm(functions, axis=0)
    left = functions - kept @ (kept.T @ functions)
    vector, value, _ = np.linalg.svd(left, full_matrices=False)
    return np.hstack([kept, vector[:, value > np.sqrt(_DEPENDENT)]])
