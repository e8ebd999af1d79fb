"""From a vademecum and a cloud to loads and rigid motion: iterated closest points.

With x' = c + R (x + u(x) - c) + t for the organ's surface, each point of the cloud is at a signed
distance from the surface as it lies now; its derivatives by the coefficients of the loads and by R
and t are those of its foot along the normal there (point to plane; Chen & Medioni, Image and Vision
Computing 10, 1992). A Gauss-Newton step is the mean of the linearised posterior
(:mod:`avatar_core.registration.posterior`); points weigh as Student's distribution has it, so that
some strays do no harm. The first steps move the organ rigidly alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import RegistrationError
from avatar_core.geometry.point_location import closest_points
from avatar_core.registration.cloud import Cloud, require_on_organ
from avatar_core.registration.posterior import (
    Equations,
    Posterior,
    Scales,
    at_scales,
    averaged,
    cells_of,
    equations,
    likeliest,
    posterior,
)
from avatar_core.registration.rigid import RigidMotion
from avatar_core.registration.traction import LoadBasis, load_basis
from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class RegistrationRule:
    """Prior knowledge and stopping.

    noise : standard deviation of a point of the cloud along the normal, about [m]
    turn, shift : prior root mean squares of the rigid motion, all axes together [rad, m]
    freedom : degrees of freedom of Student's distribution, from which points are weighed
    tolerance : step of a point of the surface that ends the iteration [m]
    rigid_steps, most_steps : iterations that move rigidly alone, and all, at most
    rescaled : steps after the rigid ones at which the scales are sought
    """

    noise: float = 1e-3
    turn: float = float(np.radians(10.0))
    shift: float = 10e-3
    freedom: float = 10.0
    tolerance: float = 1e-4
    rigid_steps: int = 8
    most_steps: int = 40
    rescaled: tuple[int, ...] = (1, 3, 6)

    def __post_init__(self) -> None:
        if not 1e-5 <= self.noise <= 0.02:
            raise RegistrationError(
                f"a noise of {self.noise:g} m; give the standard deviation of the points in metres "
                "(1e-3: 1 mm)"
            )

    def scales(self, young_modulus: float) -> Scales:
        """Of traction, length, noise and mismatch, before the cloud is seen."""
        middle = np.log([0.02 * young_modulus, 0.03, self.noise, 0.2 * self.noise])
        return Scales(middle, np.array([2.0, 0.7, 0.3, 0.7]))


@dataclass(frozen=True, eq=False)
class Fit:
    """The end of the iteration.

    loads : LoadBasis; motion : RigidMotion
    columns : ndarray, shape (n_vertices, 3, n) [m], displacement by each coefficient of the loads
    coefficients : ndarray, shape (n,), of the loads
    covariance : ndarray, shape (n + 6, n + 6), of coefficients, turn and shift
    residuals : ndarray, signed distances of the points that were used [m]
    outlying : part of the points that the robust weights hold for strays
    scales : ndarray, (traction [Pa], length [m], noise [m], mismatch [m])
    n_steps, converged : of the iteration
    """

    loads: LoadBasis
    motion: RigidMotion
    columns: FloatArray
    coefficients: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    outlying: float
    scales: FloatArray
    n_steps: int
    converged: bool


def fit(vademecum: Vademecum, cloud: Cloud, rule: RegistrationRule | None = None) -> Fit:
    """Loads and rigid motion that bring the organ's surface to a cloud.

    Raises
    ------
    RegistrationError
        If the cloud cannot be one of this organ, or the iteration leads away from it.
    """
    rule = rule or RegistrationRule()
    problem = _problem(vademecum, cloud, rule)
    state, n_rigid = _rigidly(problem)
    logarithms = problem.prior.middle
    for step in range(rule.most_steps):
        found = problem.equations_at(state, np.exp(logarithms), first=step == 0)
        if step in rule.rescaled:
            logarithms = problem.rescaled(found, logarithms, step == rule.rescaled[0])
        mean = problem.solved(found, np.exp(logarithms)).mean
        moved = problem.largest_move(state, mean)
        state = state + (1.0 if step < _UNDAMPED else 0.5) * (mean - state)
        if converged := moved < rule.tolerance and step > rule.rescaled[-1]:
            break
    found, residuals, weights = problem.linearised(state, np.exp(logarithms))
    mean, covariance = averaged(found, problem.spread, problem.prior, logarithms)
    n = problem.loads.size
    return Fit(
        problem.loads,
        problem.motion(mean),
        problem.all_columns,
        mean[:n],
        covariance,
        residuals,
        float((weights < _STRAY).mean()),
        np.exp(logarithms),
        n_rigid + step + 1,
        bool(converged),
    )


_STRAY = 0.5  # weight of a point some four standard deviations off, below which it is a stray
_UNDAMPED = 14  # steps; the closest points of some clouds swing to and fro after so many
_TRIES = 60  # of scales, the first time; a half of it later


def rigid_motion(
    vademecum: Vademecum, cloud: Cloud, rule: RegistrationRule | None = None
) -> RigidMotion:
    """What rigid steps alone make of a cloud; arguments and errors as of :func:`fit`."""
    problem = _problem(vademecum, cloud, rule or RegistrationRule())
    return problem.motion(_rigidly(problem)[0])


def _problem(vademecum: Vademecum, cloud: Cloud, rule: RegistrationRule) -> _Problem:
    """The problem, with the displacement of all vertices by each coefficient."""
    loads = load_basis(vademecum)
    every = np.arange(len(vademecum.mesh.vertices))
    columns = loads.displacement(vademecum, every, np.eye(loads.size))
    return _Problem.of(vademecum, cloud, rule, loads, columns)


def _rigidly(problem: _Problem) -> tuple[FloatArray, int]:
    """Unknowns after the rigid steps, and their number."""
    rule, step, moved = problem.rule, 0, np.inf
    state: FloatArray = np.zeros(problem.loads.size + 6)
    while moved > 5.0 * rule.tolerance and step < rule.rigid_steps:
        found = problem.equations_at(state, np.exp(problem.prior.middle), first=True)
        mean = problem.solved_rigidly(found)
        moved, state, step = problem.largest_move(state, mean), mean, step + 1
    return state, step


@dataclass(frozen=True, eq=False)
class _Problem:
    """What the steps work on: the organ's surface at rest and its displacement by each unknown."""

    rule: RegistrationRule
    prior: Scales
    loads: LoadBasis
    vertices: FloatArray
    faces: IntArray
    columns: FloatArray
    all_columns: FloatArray
    points: FloatArray
    cell: float

    @classmethod
    def of(
        cls,
        vademecum: Vademecum,
        cloud: Cloud,
        rule: RegistrationRule,
        loads: LoadBasis,
        columns: FloatArray,
    ) -> _Problem:
        mesh = vademecum.mesh
        on_surface = mesh.surface_vertices
        vertices = np.ascontiguousarray(mesh.vertices[on_surface])
        faces = np.searchsorted(on_surface, mesh.boundary_faces).astype(np.int64)
        points = np.ascontiguousarray(cloud.thinned())
        require_on_organ(cloud, vertices, faces)
        own = columns[on_surface].reshape(-1, loads.size)
        prior = rule.scales(vademecum.material.young_modulus)
        edge = mesh.mean_surface_edge
        return cls(rule, prior, loads, vertices, faces, own, columns, points, edge)

    def motion(self, unknowns: FloatArray) -> RigidMotion:
        """The rigid part of the unknowns."""
        centre = self.vertices.mean(axis=0)
        return RigidMotion(centre).with_unknowns(unknowns[self.loads.size :])

    def surface(self, unknowns: FloatArray) -> FloatArray:
        """The organ's surface, shape (n_vertices, 3) [m]."""
        moved = self.columns @ unknowns[: self.loads.size]
        return self.motion(unknowns)(self.vertices + moved.reshape(-1, 3))

    def largest_move(self, before: FloatArray, after: FloatArray) -> float:
        """Of a point of the surface between two states [m]."""
        change = self.surface(after) - self.surface(before)
        return float(np.sqrt((change**2).sum(axis=1).max()))

    def spread(self, scales: FloatArray) -> FloatArray:
        """Prior standard deviations of all unknowns at scales."""
        rule = self.rule
        rigid = np.repeat([rule.turn, rule.shift], 3) / np.sqrt(3.0)
        return np.concatenate([self.loads.spread(scales[0], scales[1]), rigid])

    def equations_at(self, state: FloatArray, scales: FloatArray, first: bool) -> Equations:
        """Linearised at a state; the first time with the noise that the distances show."""
        return self.linearised(state, scales, first)[0]

    def linearised(
        self, state: FloatArray, scales: FloatArray, first: bool = False
    ) -> tuple[Equations, FloatArray, FloatArray]:
        """Equations, distances and robust weights of the points at a state."""
        J, distance = self._distances(state)
        square = float(scales[2] ** 2 + scales[3] ** 2)
        if first:
            square = max(square, (1.4826 * float(np.median(np.abs(distance)))) ** 2)
        freedom = self.rule.freedom
        weights = (freedom + 1.0) / (freedom + distance**2 / square)
        cells = cells_of(self.motion(state).back(self.points), self.cell)
        return equations(J, distance + J @ state, weights, cells), distance, weights

    def _distances(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (n_points, n_unknowns) and values of the points' signed distances [m]."""
        surface, motion = self.surface(state), self.motion(state)
        feet, face, at = closest_points(surface, self.faces, self.points)
        corners = self.faces[face]
        normals = igl.per_vertex_normals(surface, self.faces)[corners]
        normal = np.einsum("nk,nkd->nd", at, normals)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        own = normal @ motion.matrix  # in the axes of the organ
        along = np.einsum("nk,nd->nkd", at, own).reshape(len(feet), 9)
        column = (3 * corners[:, :, None] + np.arange(3)).reshape(len(feet), 9)
        first = np.arange(0, 9 * len(feet) + 1, 9)
        shape = (len(feet), 3 * len(self.vertices))
        J = sp.csr_matrix((along.ravel(), column.ravel(), first), shape=shape) @ self.columns
        distance = ((self.points - feet) * normal).sum(axis=1)
        return np.hstack([J, motion.rows(feet, normal)]), distance

    def rescaled(self, found: Equations, logarithms: FloatArray, first: bool) -> FloatArray:
        """The likeliest scales of linearised equations."""
        tries = _TRIES if first else _TRIES // 2
        return likeliest(found, self.spread, self.prior, logarithms, tries)

    def solved(self, found: Equations, scales: FloatArray) -> Posterior:
        """The posterior of all unknowns."""
        return at_scales(found, self.spread, scales)

    def solved_rigidly(self, found: Equations) -> FloatArray:
        """The most likely unknowns without loads."""
        scales = np.exp(self.prior.middle)
        spread = self.spread(scales)
        spread[: self.loads.size] = 1e-12 * spread[: self.loads.size]
        return posterior(found, spread, scales[2], scales[3]).mean
