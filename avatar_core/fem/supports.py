"""Supports: parts of the surface that springs hold, from free to clamped.

On a support the traction is t = -k u, with a stiffness per area k [N/m^3] (a Robin condition). The
weak form gains k int_support u.v da, one term that is affine in k; k -> infinity is the clamp.
Springs do not pull before the organ moves, and resist in all directions alike.

Only supports and clamp keep an organ from moving as a rigid body. The Rayleigh quotient of a rigid
motion r,

    q(r) = sum_i k_i int_i |r|^2 da / int_boundary |r|^2 da    [N/m^3]

is the mean stiffness per area of the whole boundary that resists the motion. Take its least value
over the six rigid motions, times the length of the organ over Young's modulus. This number says how
far the organ moves as a whole before it deforms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from skfem import BilinearForm, Element, FacetBasis, MeshTet

from avatar_core.common.arrays import FloatArray
from avatar_core.common.supports import LEAST_STIFFNESS, MOST_STIFFNESS
from avatar_core.errors import MaterialError
from avatar_core.geometry.mesh import IN_FACE, TetMesh

LEAST_HELD = 1e-6  # least q(r) L / E: below, 1 N moves a liver by metres


@dataclass(frozen=True, eq=False)
class Support:
    """A part of the surface that springs hold.

    Attributes
    ----------
    name : str
        Letters, digits and _, e.g. "bare_area".
    faces : ndarray of bool, shape (n_faces,)
        Mask over ``mesh.boundary_faces``.
    stiffness : float
        k, per area [N/m^3].

    Raises
    ------
    MaterialError
        If no face is given, or the stiffness is not from ``LEAST_STIFFNESS`` to ``MOST_STIFFNESS``.
    """

    name: str
    faces: np.ndarray
    stiffness: float

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise MaterialError(f"a support is called '{self.name}'; give letters, digits and _")
        if not self.faces.any():
            raise MaterialError(
                f"support {self.name} holds no face of the mesh; leave it out, or ask for a finer "
                "mesh"
            )
        require_stiffness(self.name, self.stiffness)


def require_stiffness(name: str, stiffness: float) -> None:
    """Raise MaterialError unless a stiffness per area is one that a support can have."""
    if not LEAST_STIFFNESS <= stiffness <= MOST_STIFFNESS:
        raise MaterialError(
            f"support {name} has a stiffness of {stiffness:g} N/m^3; give {LEAST_STIFFNESS:g} to "
            f"{MOST_STIFFNESS:g}, leave it out for a free surface, or clamp it"
        )


def with_stiffness(
    supports: Sequence[Support], stiffness: Mapping[str, float]
) -> tuple[Support, ...]:
    """Return supports with other stiffnesses per area, by name [N/m^3]; others keep theirs."""
    return tuple(replace(s, stiffness=stiffness.get(s.name, s.stiffness)) for s in supports)


@BilinearForm
def _mass(u, v, w):  # type: ignore[no-untyped-def]
    return u * v


def boundary_mass(mesh: MeshTet, shape: Element, faces: FloatArray) -> sp.csr_matrix:
    """Return int_faces N_a N_b da of one component, scikit-fem's numbering [m^2].

    mesh : scikit-fem's mesh
    shape : element of one component, of degree 1 or 2: quadrature of degree 4 is exact
    faces : ndarray of int, shape (n, 3), vertices of boundary faces
    """
    number = {tuple(facet): k for k, facet in enumerate(np.sort(mesh.facets, axis=0).T.tolist())}
    facets = np.array([number[tuple(face)] for face in np.sort(faces, axis=1).tolist()])
    return _mass.assemble(FacetBasis(mesh, shape, facets=facets, intorder=4)).tocsr()


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """The rigid motion that supports resist least.

    resistance : its Rayleigh quotient q [N/m^3]
    text : description of the motion
    """

    resistance: float
    text: str

    def holds(self, length: float, young_modulus: float) -> bool:
        """Return whether an organ of a length [m] and Young's modulus [Pa] counts as held."""
        return self.resistance * length >= LEAST_HELD * young_modulus


def require_held(
    mesh: TetMesh, supports: Sequence[Support], young_modulus: float, part: np.ndarray
) -> None:
    """Refuse supports that leave an organ, or a piece of it, free to move as a rigid body.

    part : ndarray of bool, shape (n_faces,), the boundary of the organ or of one piece

    Raises
    ------
    MaterialError
        Naming the motion that is free, and the remedy.
    """
    least = least_resisted(mesh, supports, part)
    length = float(np.ptp(mesh.vertices[mesh.boundary_faces[part]], axis=(0, 1)).max())
    if not least.holds(length, young_modulus):
        raise MaterialError(
            f"nothing holds the organ against {least.text} (supports resist it by "
            f"{least.resistance:.2g} N/m^3); clamp some faces, or give a support a stiffness of "
            f"{10.0 ** np.ceil(np.log10(young_modulus / length)):.0e} N/m^3"
        )


def least_resisted(
    mesh: TetMesh,
    supports: Sequence[Support],
    part: np.ndarray,
    springs: tuple[FloatArray, FloatArray] | None = None,
) -> RigidMotion:
    """Return the least Rayleigh quotient of the six rigid motions, and its motion.

    Rotations are about the centroid of the boundary and scaled by its radius of gyration.

    springs : points (n, 3) [m] and stiffnesses (n,) [N/m] of further springs
    """
    corners = mesh.vertices[mesh.boundary_faces[part]]
    points = np.einsum("qk,fkd->fqd", IN_FACE, corners).reshape(-1, 3)
    weight = np.repeat(mesh.face_areas[part] / 3.0, 3)
    centre = np.average(points, axis=0, weights=weight)
    size = float(np.sqrt(weight @ ((points - centre) ** 2).sum(axis=1) / weight.sum()))
    motions = _rigid_motions((points - centre) / size)
    stiffness = np.zeros(len(mesh.boundary_faces))
    for support in supports:
        stiffness += np.where(support.faces, support.stiffness, 0.0)
    whole = np.einsum("q,qcm,qcn->mn", weight, motions, motions)
    weight = weight * np.repeat(stiffness[part], 3)
    held = np.einsum("q,qcm,qcn->mn", weight, motions, motions)
    if springs is not None:
        motions = _rigid_motions((springs[0] - centre) / size)
        held += np.einsum("q,qcm,qcn->mn", springs[1], motions, motions)
    value, vector = scipy.linalg.eigh(held, whole)
    return RigidMotion(max(float(value[0]), 0.0), _described(vector[:, 0]))


def _rigid_motions(points: FloatArray) -> FloatArray:
    """Return three translations and three rotations at points, shape (..., 3, 6)."""
    translations = np.broadcast_to(np.eye(3), (*points.shape, 3))
    rotations = np.stack([np.cross(axis, points) for axis in np.eye(3)], axis=-1)
    return np.concatenate([translations, rotations], axis=-1)


def _described(motion: FloatArray) -> str:
    """Return a rigid motion in words, by whichever of its parts is larger."""
    shift, turn = motion[:3], motion[3:]
    turns = np.linalg.norm(turn) > np.linalg.norm(shift)
    axis = turn if turns else shift
    axis = axis / np.linalg.norm(axis)
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    text = ", ".join(f"{part + 0.0:.1f}" for part in axis.round(1))
    return f"a rotation about ({text})" if turns else f"a translation along ({text})"
