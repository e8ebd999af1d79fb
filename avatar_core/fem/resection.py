"""A cut through an organ whose sides springs tie together, released strip by strip.

Between the two sides the traction is t = -k [u], with the jump [u] of the displacement and a
stiffness per area k [N/m^3]. The weak form gains int_cut k [u].[v] da. The cut is divided along the
direction in which it opens into strips of equal area, each a term that is affine in its own k. The
coordinate r from 0 (whole) to 1 (opened as far as asked) releases one strip after the other:

    k_j(r) = k_h (1 - t) / (t + k_h / k),    t = clip(n r - j, 0, 1),   j = 0 ... n - 1,

from k to nothing. An organ gives way like 1 / (k_j + k_o), with a k_o that its size and Young's
modulus set. With k_h = k_o the displacement would grow evenly with t. A k_h below k_o keeps the
values near k_o within the first tenth of each strip. Interpolation is worst near k_o.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import CoordinateError, MaterialError
from avatar_core.fem.supports import Support, least_resisted, require_held
from avatar_core.fem.triangles import subdivided_rule, triangle_shape
from avatar_core.geometry.cut_surface import CutSurface
from avatar_core.geometry.mesh import TetMesh

TIE = 1e9  # per area of the cut [N/m^3]
N_STRIPS = 5  # one between each two of the six stored values
# k_h over Young's modulus [1/m]. For loads at load positions of LiTS-4 (1,000 vertices), halfway
# through a strip, the mean error is 1.3 % and the worst 5 %. With 18, and with k_j falling
# evenly in log k, it is 2.0 and 10 %. A tenth through a strip it is 2.3 and 11 % with 2.5.
_HALFWAY = 2.5
_SIDES = {"first": "off", "second": "on"}
_PIECES = 4  # of a face's edge, for the quadrature: fronts cut faces


@dataclass(frozen=True)
class Resection:
    """Opening of a cut.

    Attributes
    ----------
    direction : tuple[float, float, float]
        Unit vector in which it opens.
    fronts : tuple[float, ...]
        Limits of the strips, positions along the direction, ascending [m].
    opened : float
        Coordinate r, 0 (whole) to 1 (opened as far as asked).
    stiffness : float
        k of the tie, per area [N/m^3].
    halfway : float
        k_h, near the stiffness of a half released strip [N/m^3].

    Raises
    ------
    CoordinateError
        For a value out of range.
    """

    direction: tuple[float, float, float]
    fronts: tuple[float, ...]
    opened: float = 0.0
    stiffness: float = TIE
    halfway: float = 4e5

    def __post_init__(self) -> None:
        numbers = [*self.direction, *self.fronts, self.stiffness, self.halfway]
        springs = min(self.stiffness, self.halfway) > 0.0
        if not (np.isfinite(numbers).all() and springs and 1 < len(self.fronts) < 100):
            raise CoordinateError("the resection has numbers that are none; build it again")
        if not 0.0 <= self.opened <= 1.0:
            raise CoordinateError(f"resection is {self.opened:g}; give 0 (whole) to 1 (opened)")

    @classmethod
    def of(cls, mesh: TetMesh, surface: CutSurface, young_modulus: float) -> Resection:
        """Return the whole organ, to be opened along a surface that its mesh is cut along.

        young_modulus : Young's modulus of the organ [Pa]
        """
        points, weight = _quadrature(mesh)
        along = points.reshape(-1, 3) @ surface.direction
        order = np.argsort(along)
        area = np.cumsum(weight.ravel()[order])
        wanted = np.linspace(0.0, surface.part * area[-1], N_STRIPS + 1)
        fronts = np.interp(wanted, area, along[order])
        fronts[0] = along.min()
        if surface.part == 1.0:
            fronts[-1] = along.max()
        x, y, z = map(float, surface.direction)
        return cls((x, y, z), tuple(map(float, fronts)), halfway=_HALFWAY * young_modulus)

    @property
    def factors(self) -> FloatArray:
        """Stiffness per area of each strip, then of the tied rest, (n_strips + 1,) [N/m^3]."""
        n = len(self.fronts) - 1
        t = np.clip(n * self.opened - np.arange(n), 0.0, 1.0)
        left = self.halfway * (1.0 - t) / (t + self.halfway / self.stiffness)
        return np.append(left, self.stiffness)

    def jump_mass(
        self, mesh: TetMesh, nodes: np.ndarray, n_nodes: int
    ) -> tuple[sp.csr_matrix, ...]:
        """Return int [u].[v] da over each strip and over the tied rest.

        Shapes (3 n_nodes, 3 n_nodes) [m^2].

        nodes : nodes of both sides' faces, shape (2, n_faces, 3 or 6)
        """
        points, weight = _quadrature(mesh)
        barycentric, _ = subdivided_rule(_PIECES)
        shape = barycentric if nodes.shape[2] == 3 else triangle_shape(barycentric)
        n_faces, n_points = weight.shape
        columns = np.repeat(nodes, n_points, axis=1).reshape(2, -1)
        values = np.tile(shape, (n_faces, 1)).ravel()
        rows = np.repeat(np.arange(weight.size), shape.shape[1])
        jump = sp.csr_matrix(
            (np.concatenate([values, -values]), (np.tile(rows, 2), columns.ravel())),
            shape=(weight.size, n_nodes),
        )
        number = self._strip(points).ravel()
        masses = []
        for k in range(len(self.fronts)):
            inside = number == k
            part = jump[inside]
            mass = part.T @ sp.diags(weight.ravel()[inside]) @ part
            masses.append(sp.kron(mass, sp.identity(3), format="csr"))
        return tuple(masses)

    def _strip(self, points: FloatArray) -> np.ndarray:
        """Return the number of the strip that points lie in; the last is the tied rest."""
        found = np.searchsorted(self.fronts[1:], points @ np.array(self.direction), side="left")
        return np.asarray(found)


def opened_to(resection: Resection | None, value: float | None) -> Resection | None:
    """Return a resection at another value of its coordinate; None for either changes nothing."""
    if resection is None or value is None:
        return resection
    return replace(resection, opened=value)


def require_parts_held(
    mesh: TetMesh,
    resection: Resection,
    clamped: np.ndarray,
    supports: Sequence[Support],
    young_modulus: float,
) -> None:
    """Refuse a cut that leaves a part of the organ free to move as a rigid body.

    A part is held by a clamp or by its supports. It may also be held by these and the tied rest of
    the cut, if the other part is held without it.

    clamped : ndarray of bool, shape (n_faces,)

    Raises
    ------
    MaterialError
        Naming the loose part, its volume and its place.
    """
    piece, whole = mesh.pieces[mesh.boundary_tets], np.ones(len(mesh.boundary_faces), bool)
    if resection.opened == 0.0 and not clamped.any():
        require_held(mesh, supports, young_modulus, whole)
        return
    ties = _tie_springs(mesh, resection)
    cut_piece = np.zeros(len(mesh.vertices), np.int64)
    cut_piece[mesh.tets] = mesh.pieces[:, None]
    sides = [cut_piece[faces[:, 0]] for faces in mesh.cut_faces]
    held = {k: bool(clamped[piece == k].any()) for k in range(int(mesh.pieces.max()) + 1)}
    nothing = np.zeros((0, 3)), np.zeros(0)
    for k in held:
        held[k] = held[k] or _is_held(mesh, supports, piece == k, nothing, young_modulus)
    for _ in held:  # a part may hang on one that hangs on another
        for k in [k for k, is_held in held.items() if not is_held]:
            near = np.zeros(len(sides[0]), bool)
            for own, other in (sides, sides[::-1]):
                near |= (own == k) & np.array([held[j] for j in other], bool)
            springs = ties[0][near].reshape(-1, 3), ties[1][near].ravel()
            held[k] = _is_held(mesh, supports, piece == k, springs, young_modulus)
    for k in [k for k, is_held in held.items() if not is_held]:
        volume = float(mesh.tet_volumes[mesh.pieces == k].sum())
        side = "second" if mesh.is_second_side[mesh.pieces == k].any() else "first"
        raise MaterialError(
            f"at resection {resection.opened:g} nothing holds the {side} part of the organ "
            f"({1e6 * volume:.0f} ml, {volume / mesh.volume:.0%}, {_SIDES[side]} the normal's "
            "side); open a smaller 'part', or hold it by clamp or supports"
        )


def _is_held(
    mesh: TetMesh,
    supports: Sequence[Support],
    part: np.ndarray,
    springs: tuple[FloatArray, FloatArray],
    young_modulus: float,
) -> bool:
    """Return whether supports and further springs (points [m], stiffnesses [N/m]) hold a part."""
    least = least_resisted(mesh, supports, part, springs)
    length = float(np.ptp(mesh.vertices[mesh.boundary_faces[part]], axis=(0, 1)).max())
    return least.holds(length, young_modulus)


def _tie_springs(mesh: TetMesh, resection: Resection) -> tuple[FloatArray, FloatArray]:
    """Return points of the cut (n_faces, n_points, 3) [m] and the tie's stiffness there [N/m]."""
    points, weight = _quadrature(mesh)
    return points, weight * resection.factors[resection._strip(points)]


def _quadrature(mesh: TetMesh) -> tuple[FloatArray, FloatArray]:
    """Return points on the cut's faces (n_faces, n_points, 3) [m] and their weights [m^2]."""
    corners = mesh.vertices[mesh.cut_faces[0]]
    barycentric, weight = subdivided_rule(_PIECES)
    a, b, c = corners.swapaxes(0, 1)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.einsum("qk,fkd->fqd", barycentric, corners), np.outer(area, weight)
