"""Large deformation as a power series of the load: the asymptotic-numerical method.

A dead load f L moves the organ along u(f) = sum_k f^k U_k. Inserted into the weak form, int P(F) :
grad v dx = f L . v, every order is a linear problem with the stiffness at rest,

    K U_k = delta_k1 L - N_k(U_1, ..., U_k-1).

The right-hand side follows from power series of the material's own quantities (Damil &
Potier-Ferry, Int. J. Eng. Sci. 28:943, 1990; Cochelin, Computers & Structures 53:1181, 1994). With
F = I + sum_k f^k F_k these are, for the neo-Hookean material, G = F^-1 and l = ln det F from

    F G = I,     l' = tr(G F'),     P = mu (F - G^T) + lambda l G^T,

and for the St Venant-Kirchhoff material S = lambda tr(E) I + 2 mu E, 2 E = F^T F - I, P = F S.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.common.jit import compiled
from avatar_core.fem.hyperelastic_materials import NeoHookean
from avatar_core.fem.hyperelasticity import Hyperelasticity


def path_series(problem: Hyperelasticity, loads: FloatArray, order: int) -> FloatArray:
    """Return U_1, ..., U_order for several loads.

    Parameters
    ----------
    loads : ndarray, shape (3 n_nodes, n)
        Dead loads of unit size, one path each.
    order : int
        Highest power kept.

    Returns
    -------
    ndarray, shape (order, 3 n_nodes, n)
        Coefficients [m/N, m/N^2, ...].
    """
    out = np.zeros((order, *loads.shape))
    out[0] = problem.linear.solve(loads)
    states = [_State(problem, order) for _ in range(loads.shape[1])]
    for k in range(1, order):
        forces = np.column_stack(
            [state.forces(out[k - 1, :, j], k + 1) for j, state in enumerate(states)]
        )
        out[k] = problem.linear.solve(-forces)
    return out


class _State:
    """Series of the strain quantities of one path at all quadrature points."""

    def __init__(self, problem: Hyperelasticity, order: int) -> None:
        self._problem = problem
        shape = (*problem.volumes.shape, order + 1)
        self._F = np.zeros((*shape, 3, 3))
        self._G = np.zeros((*shape, 3, 3))  # or S
        self._l = np.zeros(shape)
        if isinstance(problem.material, NeoHookean):
            self._G[:, :, 0] = np.eye(3)

    def forces(self, displacement: FloatArray, k: int) -> FloatArray:
        """Return N_k, shape (3 n_nodes,), once U_k-1 is known."""
        problem = self._problem
        lam, mu = problem.material.linear.lame
        kernel = _neo_hookean if isinstance(problem.material, NeoHookean) else _st_venant
        out = np.zeros(3 * problem.n_nodes)
        kernel(
            problem.gradients, problem.volumes, problem.nodes, displacement, k, lam, mu,
            self._F, self._G, self._l, out,
        )  # fmt: skip
        return out


@compiled(fastmath=True)
def _gradient(gradients, nodes, displacement, F):  # type: ignore[no-untyped-def]
    """Return grad u at one quadrature point."""
    F[:] = 0.0
    for a in range(10):
        for i in range(3):
            u = displacement[3 * nodes[a] + i]
            for j in range(3):
                F[i, j] += u * gradients[a, j]


@compiled(fastmath=True)
def _add_forces(gradients, volume, nodes, P, out):  # type: ignore[no-untyped-def]
    for a in range(10):
        for i in range(3):
            out[3 * nodes[a] + i] += volume * (
                P[i, 0] * gradients[a, 0] + P[i, 1] * gradients[a, 1] + P[i, 2] * gradients[a, 2]
            )


@compiled(fastmath=True)
def _neo_hookean(  # type: ignore[no-untyped-def]
    gradients, volumes, nodes, displacement, k, lam, mu, series_F, series_G, series_l, out
):
    """Complete the order k - 1 of F, G, l and compute their parts of order k without F_k."""
    P, H = np.empty((3, 3)), np.empty((3, 3))
    for e in range(nodes.shape[0]):
        for q in range(volumes.shape[1]):
            F, G, log = series_F[e, q], series_G[e, q], series_l[e, q]
            _gradient(gradients[e, q], nodes[e], displacement, F[k - 1])
            for i in range(3):
                log[k - 1] += F[k - 1, i, i]
                for j in range(3):
                    G[k - 1, i, j] -= F[k - 1, i, j]
            H[:] = 0.0  # G_k without F_k
            trace = 0.0
            for m in range(1, k):
                for i in range(3):
                    for j in range(3):
                        for n in range(3):
                            H[i, j] -= F[m, i, n] * G[k - m, n, j]
                        trace += m * G[k - m, i, j] * F[m, j, i]
            log[k] = trace / k
            for i in range(3):
                for j in range(3):
                    G[k, i, j] = H[i, j]
                    P[i, j] = -mu * H[j, i]
                P[i, i] += lam * log[k]
            for m in range(1, k):
                for i in range(3):
                    for j in range(3):
                        P[i, j] += lam * log[m] * G[k - m, j, i]
            _add_forces(gradients[e, q], volumes[e, q], nodes[e], P, out)


@compiled(fastmath=True)
def _st_venant(  # type: ignore[no-untyped-def]
    gradients, volumes, nodes, displacement, k, lam, mu, series_F, series_S, unused, out
):
    """Complete the order k - 1 of F and S and compute their parts of order k without F_k."""
    P, E = np.empty((3, 3)), np.empty((3, 3))
    for e in range(nodes.shape[0]):
        for q in range(volumes.shape[1]):
            F, S = series_F[e, q], series_S[e, q]
            _gradient(gradients[e, q], nodes[e], displacement, F[k - 1])
            trace = F[k - 1, 0, 0] + F[k - 1, 1, 1] + F[k - 1, 2, 2]
            for i in range(3):
                S[k - 1, i, i] += lam * trace
                for j in range(3):
                    S[k - 1, i, j] += mu * (F[k - 1, i, j] + F[k - 1, j, i])
            E[:] = 0.0
            for m in range(1, k):
                for i in range(3):
                    for j in range(3):
                        for n in range(3):
                            E[i, j] += 0.5 * F[m, n, i] * F[k - m, n, j]
            trace = E[0, 0] + E[1, 1] + E[2, 2]
            for i in range(3):
                for j in range(3):
                    S[k, i, j] = 2.0 * mu * E[i, j]
                S[k, i, i] += lam * trace
            for i in range(3):
                for j in range(3):
                    P[i, j] = S[k, i, j]
                    for m in range(1, k):
                        for n in range(3):
                            P[i, j] += F[m, i, n] * S[k - m, n, j]
            _add_forces(gradients[e, q], volumes[e, q], nodes[e], P, out)
