"""From a vademecum and a cloud to loads and rigid motion: iterated closest points.

The organ's surface moves to x' = c + R (x + u(x) - c) + t. Each point of the cloud has a signed
distance from the present surface. Its derivatives by the displacement and by R and t are those of
its foot along the normal there (point to plane; Chen & Medioni, Image and Vision Computing 10,
1992). A Gauss-Newton step is the mean of the linearised posterior
(:mod:`avatar_core.registration.posterior`). Points are weighted by Student's distribution, so that
some strays do no harm. Smooth loads begin with steps that move the organ rigidly alone. The places
of a few forces (:mod:`avatar_core.registration.sites`) are sought anew in each step.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp

from avatar_core.common.arrays import FloatArray
from avatar_core.geometry.point_location import closest_points
from avatar_core.registration.cloud import Cloud
from avatar_core.registration.loads import (
    Kind,
    LoadBasis,
    PointForces,
    allowed_at,
    moved_supports,
    smooth_loads,
)
from avatar_core.registration.posterior import (
    Equations,
    Posterior,
    Spread,
    at_scales,
    averaged,
    cells_of,
    equations,
    likeliest,
)
from avatar_core.registration.rigid import RigidMotion
from avatar_core.registration.rule import RegistrationRule
from avatar_core.registration.sites import Found, Noise, find_sites
from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another solution that explains the cloud about as well.

    weight : weight by its likelihood, at most 1 for all solutions together
    displacement, place : ndarray, shape (n_vertices, 3) [m]
    """

    weight: float
    displacement: FloatArray
    place: FloatArray


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of the iteration.

    kind : kind of the loads
    loads : LoadBasis
    motion : RigidMotion
    coefficients : ndarray, shape (n,), of the loads
    covariance : ndarray, shape (n + 6, n + 6), of coefficients, turn and shift
    residuals : ndarray, signed distances of the points that were used [m]
    outlying : fraction of the points with robust weights of strays
    scales : ndarray, (traction [Pa] or displacement [m], length [m], noise [m], mismatch [m])
    alternatives : other places of the strongest force; empty for smooth loads
    prior_deviation : ndarray, shape (n_vertices,) [m], of a place before the cloud is seen
    n_steps, converged : number of steps, and whether the iteration converged
    """

    kind: Kind
    loads: LoadBasis
    motion: RigidMotion
    coefficients: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    outlying: float
    scales: FloatArray
    alternatives: tuple[Alternative, ...]
    prior_deviation: FloatArray
    n_steps: int
    converged: bool


_STRAY = 0.5  # weight of a point some four standard deviations off, below which it is a stray
_UNDAMPED = 6  # steps; the closest points of some clouds swing to and fro after so many
_DAMPED = 0.3  # part of a step that is taken then
_SHORTEST_SEARCH, _LONGEST_SEARCH = 4, 16  # steps in which places of forces are sought
_SETTLED = 0.5e-3  # step of the surface that ends the search [m]
_TRIES = 60  # tries of scales, the first time; half as many later
_MOST_ALTERNATIVES = 12
_LEAST_WEIGHT = 0.01  # of an alternative, over the likeliest
_LEAST_SPREAD = 1e-7  # prior deviation of a turn [rad] and a shift [m] that are known


def fit(problem: Problem, kind: Kind) -> Fit:
    """Return loads of a kind and a rigid motion that bring the organ's surface to a cloud.

    Raises
    ------
    RegistrationError
        If the iteration leads away from the cloud.
    """
    rule, prior = problem.rule, problem.rule.scales(kind, problem.young_modulus)
    logarithms, at = prior.middle, problem.start(rule.rigid_steps if kind != "few" else 0)
    sites, settled = Found([], np.zeros(0)), 0 if kind != "few" else _LONGEST_SEARCH
    for step in range(rule.most_steps):
        scales = np.exp(logarithms)
        seen = problem.linearised(at, scales, first=step < (2 if kind == "few" else 1))
        if kind != "few":
            loads = problem.field(kind)
        elif step < settled:
            wide = problem.widened(scales, seen) if step < 2 else scales
            sites = problem.sites(seen, wide)
            loads = problem.forces_at(sites.chosen)
        found = problem.equations(seen, loads)
        spread = problem.spread_of(loads)
        if step - settled in rule.rescaled:
            tries = _TRIES if step - settled == rule.rescaled[0] else _TRIES // 2
            logarithms = likeliest(found, spread, prior, logarithms, tries)
            logarithms = np.maximum(logarithms, rule.least_scales)
        solved_at = wide if step < settled else np.exp(logarithms)
        mean = at_scales(found, spread, solved_at).mean
        aim = problem.state(loads, mean)
        moved = at.far_from(aim, problem)
        at = at.towards(aim, 1.0 if step < settled + _UNDAMPED else _DAMPED)
        if step < settled and step >= _SHORTEST_SEARCH and moved < _SETTLED:
            settled = step + 1
        if converged := moved < rule.tolerance and step - settled > rule.rescaled[-1]:
            break
    scales = np.exp(logarithms)
    seen = problem.linearised(at, scales)
    found = problem.equations(seen, loads)
    mean, covariance = averaged(found, problem.spread_of(loads), prior, logarithms)
    at_last = problem.state(loads, mean)
    n = loads.size
    return Fit(
        kind,
        loads,
        problem.motion(at_last),
        mean[:n],
        covariance,
        seen.distance,
        float((seen.weights < _STRAY).mean()),
        scales,
        problem.alternatives(seen, sites, scales) if kind == "few" else (),
        problem.prior_deviation(kind, loads, scales),
        step + 1,
        bool(converged),
    )


def rigid_motion(
    vademecum: Vademecum, cloud: Cloud, rule: RegistrationRule | None = None
) -> RigidMotion:
    """Return the rigid motion from the organ to a cloud, by the rigid steps alone.

    For arguments and errors see :func:`avatar_core.registration.register.register`.
    """
    rule = rule or RegistrationRule()
    problem = Problem(vademecum, cloud.thinned(), rule)
    return problem.motion(problem.start(rule.rigid_steps))


@dataclass(frozen=True, eq=False)
class State:
    """Position of the organ: displacement of the vertices (n, 3) [m], turn and shift (6,)."""

    displacement: FloatArray
    rigid: FloatArray

    def towards(self, other: State, part: float) -> State:
        """Return a state part of the way to another one."""
        return State(
            self.displacement + part * (other.displacement - self.displacement),
            self.rigid + part * (other.rigid - self.rigid),
        )

    def far_from(self, other: State, problem: Problem) -> float:
        """Return the largest move of a surface point between two states [m]."""
        change = problem.surface(other) - problem.surface(self)
        return float(np.sqrt((change**2).sum(axis=1).max()))


@dataclass(frozen=True, eq=False)
class Seen:
    """The cloud at a state: derivatives of distances, and their weights.

    by_surface : sparse, shape (n_points, 3 n_surface), by the displacement of the surface
    by_motion : ndarray, shape (n_points, 6)
    distance : ndarray, shape (n_points,) [m]
    data : distances that the organ at rest would have, in the linearisation [m]
    weights : ndarray, shape (n_points,), robust
    cells : sparse, shape (n_cells, n_points)
    """

    by_surface: sp.csr_matrix
    by_motion: FloatArray
    distance: FloatArray
    data: FloatArray
    weights: FloatArray
    cells: sp.csr_matrix


class Problem:
    """Problem of the steps: the organ's surface at rest, the cloud, and the kinds of loads."""

    def __init__(self, vademecum: Vademecum, points: FloatArray, rule: RegistrationRule) -> None:
        mesh = vademecum.mesh
        self.vademecum, self.rule = vademecum, rule
        self.points = np.ascontiguousarray(points)
        self.on_surface = mesh.surface_vertices
        self.vertices = np.ascontiguousarray(mesh.vertices[self.on_surface])
        self.faces = np.searchsorted(self.on_surface, mesh.boundary_faces).astype(np.int64)
        self.cells = cells_of(self.points, max(mesh.mean_surface_edge, rule.correlation))
        self.centre = self.vertices.mean(axis=0)
        self.young_modulus = vademecum.material.young_modulus
        self._kinds: dict[str, LoadBasis | PointForces] = {}

    def with_points(self, points: FloatArray) -> Problem:
        """Return the same organ and loads for other points."""
        other = Problem(self.vademecum, points, self.rule)
        other._kinds = self._kinds
        return other

    def with_field(self, loads: LoadBasis) -> Problem:
        """Return the problem with other loads in place of the smooth ones."""
        other = self.with_points(self.points)
        other._kinds = {"smooth": loads}
        return other

    # --- loads --------------------------------------------------------------------------------

    @property
    def allowed(self) -> FloatArray:
        """Load positions where forces may act."""
        at_rest = RigidMotion(self.centre)
        if self.rule.forces == "seen":
            at_rest = self.motion(self.start(self.rule.rigid_steps))
        return allowed_at(self.vademecum.surface, self.rule.forces, at_rest.back(self.points))

    def field(self, kind: Kind) -> LoadBasis:
        """Return tractions wherever forces may act."""
        if kind not in self._kinds:
            smooth = smooth_loads(self.vademecum, self.allowed, kind == "pressure")
            self._kinds[kind] = smooth.beside(self.supports) if self.supports else smooth
        found = self._kinds[kind]
        assert isinstance(found, LoadBasis)
        return found

    @property
    def supports(self) -> LoadBasis | None:
        """Motions of the supports, if they may move."""
        if not self.vademecum.supports or not self.rule.support_shift:
            return None
        if "supports" not in self._kinds:
            moved = moved_supports(self.vademecum, self.rule.support_shift)
            self._kinds["supports"] = moved
        found = self._kinds["supports"]
        assert isinstance(found, LoadBasis)
        return found

    def forces_at(self, chosen: list[int]) -> LoadBasis:
        """Return a few forces, beside motions of the supports."""
        forces = self.point_forces.basis(chosen)
        return forces.beside(self.supports) if self.supports else forces

    @property
    def point_forces(self) -> PointForces:
        """Places where a few forces may act."""
        if "few" not in self._kinds:
            self._kinds["few"] = PointForces.of(self.vademecum, self.allowed)
        found = self._kinds["few"]
        assert isinstance(found, PointForces)
        return found

    # --- states -------------------------------------------------------------------------------

    def start(self, rigid_steps: int) -> State:
        """Return the organ at rest after some rigid steps."""
        at = State(np.zeros_like(self.vademecum.mesh.vertices), np.zeros(6))
        scales = np.exp(self.rule.scales("smooth", self.young_modulus).middle)
        none = LoadBasis(np.zeros((1, 3, 0)), np.zeros((*at.displacement.shape, 0)), _no_loads)
        for _ in range(rigid_steps):
            found = self.equations(self.linearised(at, scales, first=True), none)
            aim = State(at.displacement, at_scales(found, self.spread_of(none), scales).mean)
            moved, at = at.far_from(aim, self), aim
            if moved <= 5.0 * self.rule.tolerance:
                break
        return at

    def state(self, loads: LoadBasis, unknowns: FloatArray) -> State:
        """Return the state by coefficients, turn and shift."""
        n = loads.size
        return State(loads.displacement(unknowns[:n]), unknowns[n:])

    def motion(self, at: State) -> RigidMotion:
        """Return the rigid part of a state."""
        return RigidMotion(self.centre).with_unknowns(at.rigid)

    def surface(self, at: State) -> FloatArray:
        """Return the organ's surface, shape (n_surface, 3) [m]."""
        return self.motion(at)(self.vertices + at.displacement[self.on_surface])

    def place(self, at: State) -> FloatArray:
        """Return all vertices in the cloud's frame, shape (n_vertices, 3) [m]."""
        return self.motion(at)(self.vademecum.mesh.vertices + at.displacement)

    @property
    def rigid_spread(self) -> FloatArray:
        """Prior standard deviations of turn and shift, shape (6,)."""
        each = np.repeat([self.rule.turn, self.rule.shift], 3) / np.sqrt(3.0)
        return np.maximum(each, _LEAST_SPREAD)

    def spread_of(self, loads: LoadBasis) -> Spread:
        """Return prior standard deviations of all unknowns, as a function of the scales."""
        return lambda scales: np.concatenate(
            [loads.spread(float(scales[0]), float(scales[1])), self.rigid_spread]
        )

    def prior_deviation(self, kind: Kind, loads: LoadBasis, scales: FloatArray) -> FloatArray:
        """Return the prior root mean square of a place, over the axes, (n_vertices,)."""
        if kind == "few":
            places = self.point_forces
            columns = places.columns * (scales[0] * places.per_metre)[None, None, :, None]
            square = (columns**2).sum(axis=(1, 3)).mean(axis=1) / 3.0
        else:
            each = loads.spread(float(scales[0]), float(scales[1]))
            square = ((loads.columns * each) ** 2).sum(axis=(1, 2)) / 3.0
        arm = ((self.vademecum.mesh.vertices - self.centre) ** 2).sum(axis=1)
        turn, shift = self.rigid_spread[0], self.rigid_spread[3]
        return np.sqrt(square + shift**2 + turn**2 * arm * 2.0 / 3.0)

    # --- equations ----------------------------------------------------------------------------

    def linearised(self, at: State, scales: FloatArray, first: bool = False) -> Seen:
        """Return the cloud at a state; at first with the noise that the distances show."""
        surface, motion = self.surface(at), self.motion(at)
        feet, face, where = closest_points(surface, self.faces, self.points)
        corners = self.faces[face]
        normals = igl.per_vertex_normals(surface, self.faces)[corners]
        normal = np.einsum("nk,nkd->nd", where, normals)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        own = normal @ motion.matrix  # in the axes of the organ
        along = np.einsum("nk,nd->nkd", where, own).reshape(len(feet), 9)
        column = (3 * corners[:, :, None] + np.arange(3)).reshape(len(feet), 9)
        starts = np.arange(0, 9 * len(feet) + 1, 9)
        shape = (len(feet), 3 * len(self.vertices))
        by_surface = sp.csr_matrix((along.ravel(), column.ravel(), starts), shape=shape)
        by_motion = motion.rows(feet, normal)
        distance = ((self.points - feet) * normal).sum(axis=1)
        moved = at.displacement[self.on_surface].ravel()
        square = float(scales[2] ** 2 + scales[3] ** 2)
        if first:
            square = max(square, (1.4826 * float(np.median(np.abs(distance)))) ** 2)
        freedom = self.rule.freedom
        return Seen(
            by_surface,
            by_motion,
            distance,
            distance + by_surface @ moved + by_motion @ at.rigid,
            (freedom + 1.0) / (freedom + distance**2 / square),
            self.cells,
        )

    def equations(self, seen: Seen, loads: LoadBasis) -> Equations:
        """Return the equations of a cloud for coefficients, turn and shift."""
        columns = loads.columns[self.on_surface].reshape(3 * len(self.on_surface), loads.size)
        rows = np.hstack([seen.by_surface @ columns, seen.by_motion])
        return equations(rows, seen.data, seen.weights, seen.cells)

    def sites(self, seen: Seen, scales: FloatArray) -> Found:
        """Return places of a few forces, likeliest first."""
        places = self.point_forces
        columns = places.columns[self.on_surface].reshape(3 * len(self.on_surface), -1)
        size = np.repeat(scales[0] * places.per_metre, 3).astype(np.float32)
        rows = (seen.by_surface.astype(np.float32) @ columns) * size
        common = seen.by_motion * self.rigid_spread
        if self.supports:
            moved = self.supports.columns[self.on_surface].reshape(3 * len(self.on_surface), -1)
            common = np.hstack([common, seen.by_surface @ moved * self.supports.spread(0.0, 0.0)])
        error = Noise(seen.weights, seen.cells, float(scales[2]), float(scales[3]))
        return find_sites(common, rows.reshape(len(rows), -1, 3), seen.data, error)

    def widened(self, scales: FloatArray, seen: Seen) -> FloatArray:
        """Return the scales with noise and mismatch as large as the distances are."""
        off = 1.4826 * float(np.median(np.abs(seen.distance)))
        larger = max(1.0, off / float(np.hypot(scales[2], scales[3])))
        return np.asarray(scales * [1.0, 1.0, larger, larger])

    def alternatives(self, seen: Seen, found: Found, scales: FloatArray) -> tuple[Alternative, ...]:
        """Return other places of the strongest force, by their likelihood for the cloud."""
        order = np.argsort(-found.gain)[:_MOST_ALTERNATIVES]
        weight = np.exp(found.gain[order] - found.gain[order[0]])
        kept = weight > _LEAST_WEIGHT
        weight = weight[kept] / weight[kept].sum()
        alternatives = []
        for part, place in zip(weight, order[kept], strict=True):
            chosen = [int(place), *(k for k in found.chosen[1:] if k != place)]
            loads = self.forces_at(chosen)
            solved: Posterior = at_scales(
                self.equations(seen, loads), self.spread_of(loads), scales
            )
            at = self.state(loads, solved.mean)
            alternatives.append(Alternative(float(part), at.displacement, self.place(at)))
        return tuple(alternatives)


def _no_loads(scale: float, length: float) -> FloatArray:
    return np.zeros(0)
