"""A disc bonded to the surface, which moves rigidly, by finite elements.

The surface nodes within the disc have the same displacement. Let U = K^-1 L be the responses to
unit forces L at these nodes, and R the translations. The nodal forces are then (L^T U)^-1 R, and
the organ moves by U times these forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ContactError
from avatar_core.fem.elasticity import Elasticity

_LEAST_NODES = 12
_BATCH = 60  # loads solved at once


@dataclass(frozen=True, eq=False)
class BondedDisc:
    """Stiffness of a disc against rigid translations, and the organ's displacement by them.

    Attributes
    ----------
    stiffness : ndarray, shape (3, 3)
        Force on the organ per displacement of the disc [N/m].
    displacement : ndarray, shape (n_vertices, 3, 3)
        Displacement of each vertex per translation of the disc [-].
    n_nodes : int
        Number of nodes in the disc.
    """

    stiffness: FloatArray
    displacement: FloatArray
    n_nodes: int


def bonded_disc(
    elasticity: Elasticity, place: FloatArray, normal: FloatArray, radius: float
) -> BondedDisc:
    """Return the disc around a place of the surface.

    Parameters
    ----------
    elasticity : Elasticity
        Problem of the organ, on a mesh refined at the place.
    place : ndarray, shape (3,)
        Centre of the disc [m].
    normal : ndarray, shape (3,)
        Unit normal of the surface.
    radius : float
        Radius along the surface [m].

    Raises
    ------
    ContactError
        If the mesh has too few nodes in the disc, or the clamp is among them.
    """
    nodes, at = surface_nodes(elasticity)
    arm = at - place
    height = arm @ normal
    across = np.linalg.norm(arm - height[:, None] * normal, axis=1)
    inside = nodes[(across < radius) & (np.abs(height) < radius)]
    if len(inside) < _LEAST_NODES or np.isin(inside, elasticity.clamped_nodes).any():
        raise ContactError(
            f"a disc of {1e3 * radius:g} mm has {len(inside)} free nodes of the surface here; take "
            "a place off the clamp, and a finer mesh"
        )
    rows = (3 * inside[:, None] + np.arange(3)).ravel()
    m = len(rows)
    loads = sp.csc_matrix((np.ones(m), (rows, np.arange(m))), (3 * elasticity.n_nodes, m))
    compliance, moved = np.empty((m, m)), np.empty((3 * len(elasticity.mesh.vertices), m))
    for first in range(0, m, _BATCH):
        some = slice(first, first + _BATCH)
        solved = elasticity.solve(loads[:, some])
        compliance[:, some] = solved[rows]
        moved[:, some] = elasticity.at_vertices(solved)
    translation = np.tile(np.eye(3), (len(inside), 1))
    forces = np.linalg.solve(compliance, translation)
    field = (moved @ forces).reshape(-1, 3, 3)
    return BondedDisc(translation.T @ forces, field, len(inside))


def surface_nodes(elasticity: Elasticity) -> tuple[FloatArray, FloatArray]:
    """Return the nodes of the surface, and their positions (n, 3) [m]."""
    mesh, of_faces = elasticity.mesh, elasticity.face_nodes
    corners = mesh.vertices[mesh.boundary_faces]
    middles = (corners + np.roll(corners, -1, axis=1)) / 2.0
    at = np.concatenate([corners, middles], axis=1)[:, : of_faces.shape[1]]
    nodes, first = np.unique(of_faces, return_index=True)
    return nodes, at.reshape(-1, 3)[first]
