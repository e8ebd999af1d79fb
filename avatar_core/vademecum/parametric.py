"""A vademecum over more than place and load: u(x, s, p), p the material's coordinates.

Offline, one space basis V serves the whole range. Online, values p give the Galerkin response

    A(p) = V^T K(p) V = sum_q theta_q(p) A_q = L L^T,     X = V L^-T,   Y(s) = L^-1 V^T f(s)

which is K(p)-orthonormal as any far field of this project is, so that what remains of the contact
compliance, C(p) - Y Y^T, is positive semi-definite. It is kept at the nodes of the range
(:mod:`avatar_core.reduction.coordinates`) and combined with weights that are not negative: positive
semi-definite again. The modes are sorted by their displacement norm at p, and the first of them are
used. The result is an ordinary Vademecum, so that a step costs what it costs
without coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from avatar_core.reduction.coordinates import Coordinate
from avatar_core.reduction.near_field import LocalBlocks
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.modal_mass import N_BODY, BodyResponse, completed


@dataclass(frozen=True, eq=False)
class ParametricResponse:
    """The data of a vademecum's coordinates, beside its own fields.

    coordinates : at least one
    basis : SeparatedField, V at the vertices (3 n_vertices, n) and V^T f (3 n_positions, n)
    operators : ndarray, shape (n_terms, n, n), A_q of :attr:`Elasticity.factors`
    near, contact_near : ndarray, shape (n_nodes, n_blocks, 3, 3), blocks at the nodes in the
        pattern of the vademecum's own near fields
    rank : modes of a vademecum at given values
    young_modulus : that the blocks are computed for [Pa]
    body : BodyResponse of the basis, or None
    """

    coordinates: tuple[Coordinate, ...]
    basis: SeparatedField
    operators: np.ndarray
    near: np.ndarray
    contact_near: np.ndarray
    rank: int
    young_modulus: float
    body: BodyResponse | None = None


def galerkin_field(
    basis: SeparatedField,
    operators: np.ndarray,
    factors: np.ndarray,
    mass: np.ndarray,
    rank: int,
    body: BodyResponse | None,
) -> tuple[SeparatedField, BodyResponse | None]:
    """The K(p)-orthonormal response in a space: modes by displacement norm, then body functions.

    Parameters
    ----------
    basis : V and V^T f
    operators, factors : A_q and theta_q(p)
    mass : ndarray, shape (3 n_vertices,), lumped
    rank : modes in all
    body : of the basis; None for modes of surface loads alone
    """
    stiffness = np.tensordot(factors, operators, axes=1)
    root = np.linalg.cholesky((stiffness + stiffness.T) / 2.0)
    load = scipy.linalg.solve_triangular(root, basis.load.T, lower=True).T
    space = scipy.linalg.solve_triangular(root, basis.space.T, lower=True).T
    modes = SeparatedField(space, load)
    kept = modes.mixing_by_norm(mass)
    if body is None:
        kept = kept[:, :rank]
    else:
        inverse = scipy.linalg.solve_triangular(root, np.eye(len(root)), lower=True).T
        body = body.mixed(inverse)
        kept = completed(body, kept[:, : rank - N_BODY])
        body = body.mixed(kept)
    return SeparatedField(space @ kept, load @ kept), body


def combined(near: LocalBlocks, at_nodes: np.ndarray, weights: np.ndarray) -> LocalBlocks:
    """Blocks between the nodes."""
    used = np.flatnonzero(weights)
    return replace(near, block=np.tensordot(weights[used].astype(np.float32), at_nodes[used], 1))
