"""Loads that may have deformed an organ, in few coefficients, and the displacement they cause.

There are three kinds. ``smooth``: the traction is a Gaussian field of the length l and the standard
deviation s. In eigenfunctions of the surface's Laplacian, -div grad phi_i = lambda_i phi_i, its
coefficients are independent. Their variances (Solin & Sarkka, Statistics and Computing 30, 2020)

    s^2 2 pi l^2 exp(-l^2 lambda_i / 2)

depend on l and s by a diagonal alone. ``pressure``: the same along the normals alone. ``few``:
forces at a few places, e.g. of tools and retractors. Each is a vector whose standard deviation
would displace the organ there by the scale s [m]. Beside smooth loads the organ's weight may have
turned: a uniform body force, whose sag the vademecum holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla

from avatar_core.common.arrays import FloatArray, IntArray, farthest_points
from avatar_core.errors import RegistrationError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.vademecum.model import Vademecum

Kind = Literal["smooth", "few", "pressure"]

N_FUNCTIONS = 50  # functions of each direction; the shortest waves of a liver's front are some 5 cm
WEIGHT_SPREAD = 5e3  # deviation of a turned weight along each axis, half of a liver's own [N/m^3]
MOST_SITES = 600  # at which a force is sought: some 8 mm apart on a liver
_LEAST_AREA = 1e-3  # area of a position, over the mean area
_BATCH = 300  # columns computed at once


@dataclass(frozen=True, eq=False)
class LoadBasis:
    """Coefficients of loads, the forces that they stand for, and their displacement.

    Attributes
    ----------
    forces : ndarray, shape (n_positions, 3, n)
        Forces at each load position by each coefficient [N].
    columns : ndarray, shape (n_vertices, 3, n)
        Displacement by each coefficient [m].
    spread : Callable[[float, float], ndarray]
        Function that returns prior standard deviations of the coefficients (n,) at a scale and a
        length [m].
    """

    forces: FloatArray
    columns: FloatArray
    spread: Callable[[float, float], FloatArray]

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.columns.shape[2]

    def beside(self, other: LoadBasis) -> LoadBasis:
        """Return these loads and others together."""

        def spread(scale: float, length: float) -> FloatArray:
            return np.concatenate([self.spread(scale, length), other.spread(scale, length)])

        forces, columns = (
            np.concatenate(pair, axis=2)
            for pair in ((self.forces, other.forces), (self.columns, other.columns))
        )
        return LoadBasis(forces, columns, spread)

    def at_positions(self, coefficients: FloatArray) -> FloatArray:
        """Return the forces at load positions, shape (n_positions, 3) [N]."""
        return np.asarray(self.forces @ coefficients)

    def displacement(self, coefficients: FloatArray) -> FloatArray:
        """Return the displacement of the vertices, shape (n_vertices, 3) [m]."""
        return np.asarray(self.columns @ coefficients)


def smooth_loads(
    vademecum: Vademecum, allowed: FloatArray, along_normals: bool = False, n: int = N_FUNCTIONS
) -> LoadBasis:
    """Return the smoothest tractions, and the turned weight; a pressure if along normals.

    allowed : ndarray of bool, shape (n_positions,), mask of positions where loads may act
    along_normals : whether tractions act along the normals alone
    n : number of functions
    """
    surface = vademecum.surface
    eigenvalues, functions, area = _eigenfunctions(surface, n)
    weighed = functions * (area * allowed)[:, None]
    directions = surface.normals[:, None] if along_normals else np.eye(3)[None]
    forces = np.einsum(
        "pi,pkd->pdki", weighed, np.broadcast_to(directions, (len(area), *directions.shape[1:]))
    )
    forces = forces.reshape(len(area), 3, -1)
    columns = displaced_by(vademecum, np.arange(len(area)), forces)
    n_tractions = forces.shape[2]
    n_weight = 0 if vademecum.body is None else 3
    if n_weight and vademecum.body is not None:
        sag = vademecum.far.space.astype(float) @ vademecum.body.weight
        columns = np.concatenate([columns, sag.reshape(len(columns), 3, 3)], axis=2)
        forces = np.concatenate([forces, np.zeros((len(area), 3, n_weight))], axis=2)

    def spread(traction: float, length: float) -> FloatArray:
        decay = np.exp(-(length**2) * eigenvalues / 4.0)
        each = traction * np.sqrt(2.0 * np.pi) * length * decay
        times = n_tractions // len(each)
        return np.concatenate([np.tile(each, times), np.full(n_weight, WEIGHT_SPREAD)])

    return LoadBasis(forces, columns, spread)


@dataclass(frozen=True, eq=False)
class PointForces:
    """Places at which a force may act, each alone.

    positions : ndarray of int, shape (n,), load positions
    columns : ndarray, shape (n_vertices, 3, n, 3), displacement by a force at each place [m/N]
    per_metre : ndarray, shape (n,), force that displaces the organ there by a unit [N/m]
    n_positions : number of load positions of the vademecum
    """

    positions: IntArray
    columns: FloatArray
    per_metre: FloatArray
    n_positions: int

    @classmethod
    def of(cls, vademecum: Vademecum, allowed: FloatArray) -> PointForces:
        """Return at most ``MOST_SITES`` places, far from one another.

        allowed : ndarray of bool, shape (n_positions,), where loads may act
        """
        positions = np.flatnonzero(allowed)
        far = farthest_points(vademecum.surface.centers[positions], MOST_SITES)
        positions = positions[np.sort(far)]
        n = len(positions)
        unit = np.eye(3 * n, dtype=np.float32).reshape(n, 3, 3 * n)
        columns = displaced_by(vademecum, positions, unit).reshape(-1, 3, n, 3)
        size = np.linalg.norm(columns, axis=1).max(axis=0)  # where it acts, mostly
        per_metre = 1.0 / np.sqrt((size.astype(float) ** 2).mean(axis=1))
        return cls(positions, columns, per_metre, vademecum.surface.n_positions)

    def basis(self, chosen: list[int]) -> LoadBasis:
        """Return the forces at some of the places together."""
        n = len(chosen)
        forces = np.zeros((self.n_positions, 3, 3 * n))
        for k, place in enumerate(chosen):
            forces[self.positions[place], :, 3 * k : 3 * k + 3] = np.eye(3)
        columns = self.columns[:, :, chosen].reshape(len(self.columns), 3, 3 * n).astype(float)
        each = np.repeat(self.per_metre[chosen], 3)
        return LoadBasis(forces, columns, lambda scale, _: scale * each)


def displaced_by(vademecum: Vademecum, positions: IntArray, forces: FloatArray) -> FloatArray:
    """Return the displacement by forces (n, 3, m) at some positions, (n_vertices, 3, m)."""
    n_vertices, m = len(vademecum.mesh.vertices), forces.shape[2]
    out = np.empty((n_vertices, 3, m), np.float32)
    for first in range(0, m, _BATCH):
        some = slice(first, min(first + _BATCH, m))
        part = np.ascontiguousarray(forces[:, :, some], np.float32)
        active = np.flatnonzero(np.abs(part).max(axis=(1, 2)) > 0.0)
        moved = vademecum.field.under(positions[active], part[active])
        out[:, :, some] = vademecum.blocks.at_vertices(moved).reshape(n_vertices, 3, -1)
    return out


# --- what holds the organ ------------------------------------------------------------------------


def moved_supports(vademecum: Vademecum, shift: float) -> LoadBasis:
    """Return springs whose other ends move rigidly, six unknowns each: packing, a rising diaphragm.

    On a support the traction is k (d - u). A motion d of its other end therefore loads the organ by
    k int d . v da; finite elements solve for the response. The clamp alone moves with the frame.

    shift : prior root mean square of a shift [m]; a turn moves the rim of a support as far
    """
    mesh, supports = vademecum.mesh, vademecum.supports
    elasticity = Elasticity(
        mesh,
        vademecum.material,
        vademecum.regions.clamped,
        supports=supports,
        resection=vademecum.resection,
    )
    loads, spreads = [], []
    for k, support in enumerate(supports):
        corners = mesh.vertices[mesh.boundary_faces[support.faces]]
        at = np.concatenate([corners, (corners + np.roll(corners, -1, axis=1)) / 2.0], axis=1)
        nodes = elasticity.face_nodes[support.faces]
        arms = at[:, : nodes.shape[1]] - corners.mean(axis=(0, 1))
        reach = float(np.linalg.norm(arms, axis=2).max())
        for axis in np.eye(3):
            for field in (np.broadcast_to(axis, arms.shape), np.cross(axis, arms)):
                moved = np.zeros((elasticity.n_nodes, 3))
                moved[nodes] = field
                force = elasticity.apply_term(elasticity.n_material + k, moved.reshape(-1, 1))
                loads.append(support.stiffness * force[:, 0])
            spreads += [shift / np.sqrt(3.0), shift / reach / np.sqrt(3.0)]
    solved = elasticity.at_vertices(elasticity.solve(np.stack(loads, axis=1)))
    columns = solved.reshape(len(mesh.vertices), 3, -1)
    forces = np.zeros((vademecum.surface.n_positions, 3, columns.shape[2]))
    each = np.array(spreads)
    return LoadBasis(forces, columns, lambda scale, length: each)


# --- where loads may act ----------------------------------------------------------------------


def allowed_at(surface: LoadSurface, forces: str, points: FloatArray | None = None) -> FloatArray:
    """Return the load positions where forces may act, ndarray of bool, shape (n_positions,).

    forces : "accessible", all positions; "seen", positions within reach of ``points``; or "near X Y
        Z RADIUS", positions in a ball [m]
    points : ndarray, shape (n, 3), A cloud in the organ's frame at rest [m]

    Raises
    ------
    RegistrationError
        For another word, or if no position is left.
    """
    words = forces.replace(",", " ").split()
    if forces == "accessible":
        return np.ones(surface.n_positions, bool)
    if forces == "seen" and points is not None:
        reach = 2.0 * surface.patch_radius
        away = np.linalg.norm(
            surface.centers[:, None] - points[None, :: max(1, len(points) // 500)], axis=2
        )
        found = away.min(axis=1) < reach
    elif words[:1] == ["near"] and len(words) == 5:
        try:
            x, y, z, radius = map(float, words[1:])
        except ValueError as error:
            raise _unknown(forces) from error
        found = np.linalg.norm(surface.centers - [x, y, z], axis=1) < radius
    else:
        raise _unknown(forces)
    if not found.any():
        raise RegistrationError(
            f"no accessible place lies where forces may act ({forces}); give a place on the organ "
            "at rest, in metres, and a larger radius"
        )
    return np.asarray(found)


def _unknown(forces: str) -> RegistrationError:
    return RegistrationError(
        f"forces '{forces}' are unknown; give accessible, seen, or near X,Y,Z,RADIUS in metres"
    )


# --- smooth functions -------------------------------------------------------------------------


def _eigenfunctions(surface: LoadSurface, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lambda (n,) [1/m^2], phi (n_positions, n), and each position's area.

    int phi^2 da = 1.
    """
    vertices = np.ascontiguousarray(surface.centers, float)
    faces = np.ascontiguousarray(_triangles(surface), np.int64)
    area = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal()
    area = np.maximum(area, _LEAST_AREA * area.mean())
    scale = sp.diags(1.0 / np.sqrt(area))
    laplacian = (scale @ -igl.cotmatrix(vertices, faces) @ scale).tocsc()
    n = min(n, len(vertices) - 2)
    shift = -1e-6 * abs(laplacian).max()  # below the zero of each piece of the surface
    start = np.random.default_rng(0).standard_normal(len(area))
    value, vector = sla.eigsh(laplacian, n, sigma=shift, v0=start, tol=1e-6)
    return np.maximum(value, 0.0), vector / np.sqrt(area)[:, None], area


def _triangles(surface: LoadSurface) -> IntArray:
    """Return the triangles between all load positions: each face, or its four quarters."""
    six = surface.face_positions
    if six.shape[1] == 3:
        return six
    return np.concatenate([six[:, [0, 3, 5]], six[:, [3, 1, 4]], six[:, [5, 4, 2]], six[:, 3:]])
