"""Interpolation over the load positions: smooth weights w_j(x) for any point x on the surface.

The modified quadratic Shepard method (Renka, "Multivariate interpolation of large sets of
scattered data", ACM TOMS 14, 1988): every position j carries a quadratic q_j in its tangent plane
that passes through its own value and fits its neighbours; the q_j are blended by weights
[(rho_j - d_j)+ / (rho_j d_j)]^2. The result interpolates at the positions, reproduces quadratics
on a flat surface and is continuously differentiable, so that contact forces do not jump where
mesh faces meet. Positions facing away (the other side of a thin lobe) have no weight.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

N_FIT = 10  # neighbours of each quadratic
N_BLEND = 8  # positions that reach a point, about
MAX_STENCIL = 160
_AT_NODE = 1e-7  # [m] closer than this, a point is the position itself

# position (n, 3), normal (n, 3), tangent (n, 2, 3), reach (n,), neighbor (n, N_FIT),
# fit (n, 5, N_FIT): coefficients of x, y, x^2, x y, y^2 in lengths of ``reach``
Interpolation = namedtuple(
    "Interpolation", ["position", "normal", "tangent", "reach", "neighbor", "fit"]
)


def make_interpolation(position: np.ndarray, normal: np.ndarray) -> Interpolation:
    """Fit the nodal quadratics.

    Parameters
    ----------
    position, normal : ndarray, shape (n, 3) [m], load positions and unit outward normals
    """
    n = len(position)
    distance, near = cKDTree(position).query(position, k=min(3 * N_FIT, n))
    reach = 1.05 * distance[:, min(N_BLEND, n - 1)]
    tangent = _tangents(normal)
    neighbor = np.repeat(np.arange(n)[:, None], N_FIT, axis=1)
    fit = np.zeros((n, 5, N_FIT))
    for j in range(n):
        facing = normal[near[j]] @ normal[j] > 0.5
        chosen = near[j][facing & (distance[j] > 0)][:N_FIT]
        neighbor[j, : len(chosen)] = chosen
        fit[j, :, : len(chosen)] = _quadratic_fit(
            (position[chosen] - position[j]) @ tangent[j].T / reach[j]
        )
    return Interpolation(
        np.ascontiguousarray(position), np.ascontiguousarray(normal), tangent, reach, neighbor, fit
    )


def _tangents(normal: np.ndarray) -> np.ndarray:
    """Two unit vectors across each normal, shape (n, 2, 3)."""
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first)], axis=1)


def _quadratic_fit(xy: np.ndarray) -> np.ndarray:
    """Least-squares coefficients of the five monomials per neighbour value, shape (5, n)."""
    if len(xy) < 2:
        return np.zeros((5, len(xy)))
    x, y = xy.T
    distance = np.maximum(np.hypot(x, y), 1e-9)
    limit = 1.05 * distance.max()
    weight = np.maximum(limit - distance, 0.0) / (limit * distance)
    terms = 5 if len(xy) >= 8 else 2
    monomials = np.stack([x, y, x * x, x * y, y * y], axis=1)[:, :terms]
    solution = np.zeros((5, len(xy)))
    solution[:terms] = np.linalg.pinv(weight[:, None] * monomials, rcond=1e-6) * weight
    return solution


@njit(cache=True)
def find_candidates(data, x, margin, found):  # type: ignore[no-untyped-def]
    """Positions whose reach covers x, within a margin [m]; their number."""
    n = 0
    for j in range(data.position.shape[0]):
        limit = data.reach[j] + margin
        dx = data.position[j, 0] - x[0]
        if dx * dx > limit * limit:
            continue
        dy = data.position[j, 1] - x[1]
        dz = data.position[j, 2] - x[2]
        if dx * dx + dy * dy + dz * dz < limit * limit and n < found.shape[0]:
            found[n] = j
            n += 1
    return n


@njit(cache=True)
def add_weights(data, candidates, n_candidates, x, normal, local, weight):  # type: ignore[no-untyped-def]
    """Weights at x into ``weight``, indexed by ``local`` number; False where nothing reaches x.

    ``local[j]`` numbers every position that a candidate's quadratic uses.
    """
    for q in range(weight.shape[0]):
        weight[q] = 0.0
    total = 0.0
    for k in range(n_candidates):
        j = candidates[k]
        dx = x[0] - data.position[j, 0]
        dy = x[1] - data.position[j, 1]
        dz = x[2] - data.position[j, 2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz) + _AT_NODE
        reach = data.reach[j]
        facing = (
            normal[0] * data.normal[j, 0]
            + normal[1] * data.normal[j, 1]
            + normal[2] * data.normal[j, 2]
        )
        if distance >= reach or facing <= 0.0:
            continue
        blend = (facing * (reach - distance) / (reach * distance)) ** 2
        t = data.tangent
        a = (t[j, 0, 0] * dx + t[j, 0, 1] * dy + t[j, 0, 2] * dz) / reach
        b = (t[j, 1, 0] * dx + t[j, 1, 1] * dy + t[j, 1, 2] * dz) / reach
        own = 1.0
        for i in range(N_FIT):
            share = (
                data.fit[j, 0, i] * a
                + data.fit[j, 1, i] * b
                + data.fit[j, 2, i] * a * a
                + data.fit[j, 3, i] * a * b
                + data.fit[j, 4, i] * b * b
            )
            weight[local[data.neighbor[j, i]]] += blend * share
            own -= share
        weight[local[j]] += blend * own
        total += blend
    if total <= 0.0:
        return False
    for q in range(weight.shape[0]):
        weight[q] /= total
    return True


@njit(cache=True)
def number_stencil(data, candidates, n_candidates, local, nodes, n_local):  # type: ignore[no-untyped-def]
    """Give local numbers to the positions that the candidates use; the new count."""
    for k in range(n_candidates):
        j = candidates[k]
        if local[j] < 0 and n_local < nodes.shape[0]:
            local[j], nodes[n_local] = n_local, j
            n_local += 1
        for i in range(N_FIT):
            m = data.neighbor[j, i]
            if local[m] < 0 and n_local < nodes.shape[0]:
                local[m], nodes[n_local] = n_local, m
                n_local += 1
    return n_local


def weights_at(
    data: Interpolation, point: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and their weights at one surface point: u(point) = sum_j w_j u_j."""
    candidates = np.zeros(MAX_STENCIL, np.int64)
    nodes = np.zeros(MAX_STENCIL, np.int64)
    local = np.full(len(data.position), -1, np.int64)
    n = find_candidates(data, point, 0.0, candidates)
    count = number_stencil(data, candidates, n, local, nodes, 0)
    weight = np.zeros(count)
    if not add_weights(data, candidates, n, point, normal, local, weight):
        raise ValueError("the point is out of reach of every load position")
    used = weight != 0.0
    return nodes[:count][used], weight[used]
