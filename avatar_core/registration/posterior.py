"""Posterior of unknowns with a Gaussian prior, from a linearised cloud, and the prior's scales.

    d = J z + e,   z ~ N(0, S^2),   e ~ N(0, sigma^2 / W + tau^2 C)

J are the derivatives of the distances from the surface, W the robust weights of the points. C is
one for points of a common cell, as large as a triangle of the mesh, and zero for others. tau is the
distance of the organ's true surface from the mesh. The scales of prior and noise are those that
make the cloud most likely (MacKay, Neural Computation 4, 1992). Their own uncertainty is included
by the points of an unscented transform (Julier & Uhlmann, Proc. IEEE 92, 2004).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import RegistrationError

Spread = Callable[[FloatArray], FloatArray]  # scales -> prior standard deviations (n,)

_STEP = 0.25  # step of the differences for the curvature over the logarithms of the scales
_WIDEST = 1.0  # standard deviation of a logarithm at most
_SIMPLEX = 0.4


@dataclass(frozen=True)
class Scales:
    """Logarithms of the scales before the cloud is seen: medians and standard deviations.

    traction [Pa], length [m], noise [m], mismatch [m] are the entries, in this order; the last is
    tau.
    """

    middle: FloatArray
    spread: FloatArray


@dataclass(frozen=True, eq=False)
class Equations:
    """The cloud's equations, as sums that do not depend on the scales.

    gram : ndarray, shape (n, n), J^T W J
    right : ndarray, shape (n,), J^T W d
    square : d^T W d
    cell_rows, cell_right, cell_weight : ndarray, shape (n_cells, n), (n_cells,), (n_cells,), sums
        of W J, W d and W over cells
    n_points, log_weights : number of points, sum of log W
    """

    gram: FloatArray
    right: FloatArray
    square: float
    cell_rows: FloatArray
    cell_right: FloatArray
    cell_weight: FloatArray
    n_points: int
    log_weights: float


def equations(J: FloatArray, d: FloatArray, W: FloatArray, cells: sp.csr_matrix) -> Equations:
    """Sum up rows J (n_points, n), values d, weights W of points in cells (n_cells, n_points)."""
    root = np.sqrt(W)
    half, value = root[:, None] * J, root * d
    sums = cells @ sp.diags(root)
    return Equations(
        half.T @ half,
        half.T @ value,
        float(value @ value),
        sums @ half,
        sums @ value,
        cells @ W,
        len(d),
        float(np.log(W).sum()),
    )


def cells_of(points: FloatArray, size: float) -> sp.csr_matrix:
    """Return the cubes of a size that hold points, sparse, shape (n_cells, n_points)."""
    _, cell = np.unique(np.floor(points / size).astype(int), axis=0, return_inverse=True)
    n = len(points)
    return sp.csr_matrix((np.ones(n), (cell.ravel(), np.arange(n))))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior at given scales: mean (n,) of the unknowns, and the factor of I + S H S.

    The covariance is S (I + S H S)^-1 S; ``cost`` is minus the log of the marginal likelihood, up
    to a constant.
    """

    mean: FloatArray
    spread: FloatArray
    factor: FloatArray
    cost: float

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the unknowns, shape (n, n)."""
        half = solve_triangular(self.factor, np.diag(self.spread), lower=True, check_finite=False)
        return np.asarray(half.T @ half)


def posterior(found: Equations, spread: FloatArray, noise: float, mismatch: float) -> Posterior:
    """Solve the equations with a prior of standard deviations ``spread``.

    spread : ndarray, shape (n,)
    noise : sigma [m]
    mismatch : tau [m]
    """
    inverse = noise**-2
    taken = inverse**2 / (mismatch**-2 + inverse * found.cell_weight)  # Woodbury, cell by cell
    rows = np.sqrt(taken)[:, None] * found.cell_rows
    hessian = inverse * found.gram - rows.T @ rows
    right = spread * (inverse * found.right - found.cell_rows.T @ (taken * found.cell_right))
    system = spread[:, None] * hessian * spread
    system.flat[:: len(spread) + 1] += 1.0
    try:
        factor = cholesky(system, lower=True, check_finite=False, overwrite_a=True)
    except LinAlgError as error:
        raise RegistrationError(
            "the points leave no solution, as where many stand side by side; thin them out"
        ) from error
    solved = cho_solve((factor, True), right, check_finite=False)
    square = inverse * found.square - taken @ found.cell_right**2 - right @ solved
    log_noise = 2.0 * found.n_points * np.log(noise) - found.log_weights
    log_noise += np.log1p(mismatch**2 * inverse * found.cell_weight).sum()
    cost = 0.5 * (square + log_noise) + np.log(np.diagonal(factor)).sum()
    return Posterior(spread * solved, spread, factor, float(cost))


def at_scales(found: Equations, spread: Spread, scales: FloatArray) -> Posterior:
    """Return the posterior at scales (traction, length, noise, mismatch)."""
    return posterior(found, spread(scales), scales[2], scales[3])


def likeliest(
    found: Equations, spread: Spread, prior: Scales, start: FloatArray, n_tries: int
) -> FloatArray:
    """Return the logarithms of the scales that make the cloud likeliest, by the simplex method."""
    simplex = np.vstack([start, start + _SIMPLEX * np.eye(len(start))])
    options = {"maxfev": n_tries, "initial_simplex": simplex, "xatol": 0.02, "fatol": 0.05}
    return np.asarray(
        minimize(_cost(found, spread, prior), start, method="Nelder-Mead", options=options).x
    )


def averaged(
    found: Equations, spread: Spread, prior: Scales, best: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (n,) and covariance (n, n) of the unknowns, averaged over likely scales.

    best : logarithms of the likeliest scales
    """
    cost = _cost(found, spread, prior)
    root = _root(cost, best)
    offsets = np.sqrt(len(best)) * np.hstack([root, -root]).T
    each = [at_scales(found, spread, np.exp(best + offset)) for offset in offsets]
    means = np.stack([one.mean for one in each])
    mean = means.mean(axis=0)
    off = (means - mean) / np.sqrt(len(each))
    within = sum(one.covariance for one in each) / len(each)
    return mean, np.asarray(within + off.T @ off)


def _cost(found: Equations, spread: Spread, prior: Scales) -> Callable[[FloatArray], float]:
    def cost(logarithms: FloatArray) -> float:
        beside = (((logarithms - prior.middle) / prior.spread) ** 2).sum()
        return at_scales(found, spread, np.exp(logarithms)).cost + 0.5 * float(beside)

    return cost


def _root(cost: Callable[[FloatArray], float], best: FloatArray) -> FloatArray:
    """Return a root of the covariance of the scales' logarithms: inverse curvature of the cost."""
    n = len(best)
    step = _STEP * np.eye(n)
    here = cost(best)
    ahead = np.array([cost(best + s) for s in step])
    back = np.array([cost(best - s) for s in step])
    curvature = np.diag(ahead + back - 2.0 * here)
    for i in range(n):
        for j in range(i):
            both = cost(best + step[i] + step[j])
            curvature[i, j] = curvature[j, i] = both - ahead[i] - ahead[j] + here
    value, vector = np.linalg.eigh(curvature / _STEP**2)
    return np.asarray(vector / np.sqrt(np.maximum(value, _WIDEST**-2)))
