"""A vademecum over more than place and load: u(x, s, p), p the material's coordinates.

Offline, one space basis V serves the whole range. Online, values p give the Galerkin response

    A(p) = V^T K(p) V = sum_q theta_q(p) A_q = L L^T,     X = V L^-T,   Y(s) = L^-1 V^T f(s)

It is K(p)-orthonormal like any far field of this project. The remainder of the contact compliance,
C(p) - Y Y^T, is therefore positive semi-definite. It is stored at the nodes of the range
(:mod:`avatar_core.reduction.coordinates`) and combined with non-negative weights: positive
semi-definite again.

The global modes are those of the first functions of the basis. The remaining displacement is
written in regional modes that serve the whole range. The other functions' part of it follows from
the Galerkin response; the small rest is combined from the nodes. Blocks are separated for the first
functions and the regional modes, so that only the amounts depend on p. The result is an ordinary
Vademecum, so that a step costs the same as without coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from avatar_core.reduction.block_field import BlockField
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.modal_mass import BodyResponse


@dataclass(frozen=True, eq=False, kw_only=True)
class GalerkinBasis:
    """A space basis for the whole range, and the terms of the stiffness in it.

    Attributes
    ----------
    basis : SeparatedField
        V at the vertices (3 n_vertices, n) and V^T f (3 n_positions, n). The functions of the body
        follow those of the global modes.
    operators : ndarray, shape (n_terms, n, n)
        A_q of :attr:`Elasticity.factors`.
    n_global : int
        Number of global modes of a vademecum at given values.
    rank : int
        Rank of its contact compliance, global modes included.
    body : BodyResponse or None
        Mass and weight in the basis.
    """

    basis: SeparatedField
    operators: np.ndarray
    n_global: int
    rank: int
    body: BodyResponse | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ParametricResponse(GalerkinBasis):
    """The data of a vademecum's coordinates, beside its own fields.

    Attributes
    ----------
    coordinates : tuple[Coordinate, ...]
        One coordinate or more.
    projection : ndarray, shape (n_regions, most, n)
        Functions of the basis in the modes of each region.
    regional_load : ndarray, shape (n_nodes, n_positions, 3, most)
        Remainder of the basis at the nodes, in the modes of each position's region.
    core : ndarray, shape (n_block_modes, n_global)
        Core of the vademecum's field for the first functions of the basis.
    contact_near : ndarray, shape (n_nodes, n_blocks, 3, 3)
        Blocks at the nodes in the pattern of the vademecum's own near field.
    young_modulus : float
        Young's modulus for which the blocks are computed [Pa].
    """

    coordinates: tuple[Coordinate, ...]
    projection: np.ndarray
    regional_load: np.ndarray
    core: np.ndarray
    contact_near: np.ndarray
    young_modulus: float


def stiffness_root(basis: GalerkinBasis, factors: np.ndarray) -> np.ndarray:
    """Return L of A(p) = L L^T for the factors theta_q(p), lower triangular, shape (n, n)."""
    stiffness = np.tensordot(factors, basis.operators, axes=1)
    return np.asarray(np.linalg.cholesky((stiffness + stiffness.T) / 2.0))


def galerkin_field(
    found: GalerkinBasis, root: np.ndarray
) -> tuple[SeparatedField, np.ndarray, BodyResponse | None]:
    """Return the K(p)-orthonormal response in the space of the basis.

    L is triangular. The global modes at p therefore span the first functions of the basis for every
    p, so that the remainder is a smooth function of p.

    Parameters
    ----------
    root : ndarray
        L, of :func:`stiffness_root`.

    Returns
    -------
    far : SeparatedField
        The global modes, those of the body last.
    trailing : ndarray, shape (3 n_positions, rank - n_global)
        Load functions of further modes.
    body : BodyResponse or None
        Mass and weight in the global modes; None for modes of surface loads alone.
    """
    basis, body, n = found.basis, found.body, found.n_global
    load = galerkin_load(found, root)
    first = root[:n, :n]
    space = scipy.linalg.solve_triangular(first, basis.space[:, :n].T, lower=True).T
    if body is not None:
        inverse = scipy.linalg.solve_triangular(first, np.eye(n), lower=True).T
        body = BodyResponse(body.mass[:n, :n], body.weight[:n]).mixed(inverse)
    return SeparatedField(space, load[:, :n]), load[:, n:], body


def galerkin_load(found: GalerkinBasis, root: np.ndarray) -> np.ndarray:
    """Return Y(s) of the contact compliance, shape (3 n_positions, rank).

    For the parameters see :func:`galerkin_field`.
    """
    load = scipy.linalg.solve_triangular(root, found.basis.load.T, lower=True)
    return np.asarray(load[: found.rank].T)


def regional_load_of_basis(
    found: GalerkinBasis,
    projection: np.ndarray,
    root: np.ndarray,
    trailing: np.ndarray,
    region: np.ndarray,
) -> np.ndarray:
    """Return the response beyond the global modes in the regional modes [m/N].

    Parameters
    ----------
    projection : ndarray, shape (n_regions, most, n)
        Functions of the basis in the modes of each region.
    root, trailing : ndarray
        Results of :func:`stiffness_root` and :func:`galerkin_field`.
    region : ndarray of int, shape (n_positions,)
        Region of each load position.

    Returns
    -------
    ndarray of float32, shape (n_positions, 3, most)
    """
    n, rank = found.n_global, found.rank
    load = trailing.reshape(len(region), 3, rank - n).astype(np.float32)
    out = np.empty((len(region), 3, projection.shape[1]), np.float32)
    for r, functions in enumerate(projection):
        modes = scipy.linalg.solve_triangular(
            root[:rank, :rank], functions[:, :rank].T, lower=True
        ).T
        out[region == r] = load[region == r] @ modes[:, n:].T.astype(np.float32)
    return out


def field_at(field: BlockField, core: np.ndarray, root: np.ndarray, load: np.ndarray) -> BlockField:
    """Return a field with the global modes X = V L^-T at some values, from the field with V.

    Parameters
    ----------
    core : ndarray
        Core of V.
    root : ndarray
        L of all functions.
    load : ndarray, shape (n_positions, 3, most)
        Amounts of X and of the regional modes.
    """
    n = core.shape[1]
    inverse = scipy.linalg.solve_triangular(root[:n, :n], np.eye(n), lower=True)
    mixed = np.hstack([core @ inverse.T.astype(np.float32), field.core[:, n:]])
    return replace(field, core=mixed, load=load)


def combined(at_nodes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return values between the nodes from values at them (n_nodes, ...)."""
    used = np.flatnonzero(weights)
    return np.asarray(np.tensordot(weights[used].astype(np.float32), at_nodes[used], 1))
