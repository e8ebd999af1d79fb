"""Large pushes together with other effects: the error of superposing them linearly.

Only the response of a patch to its own normal force is nonlinear; oblique forces, other tips and
preloads are superposed. Each combination is compared with full nonlinear finite elements under the
same motion of the patch:

    oblique   30 degrees off the normal
    two tools 40 mm apart, pushed to the same depth together
    gravity   the organ hangs under its own weight before it is pushed
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ConvergenceError, EquilibriumError
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.newton import NewtonRule, State, press
from avatar_core.fem.patch_loads import patch_loads, patch_normals
from avatar_core.vademecum.large_deformation import PUSH, powers
from avatar_core.vademecum.model import Vademecum

COMBINATIONS = ("oblique", "two tools", "gravity")
DEPTH_FRACTIONS = (0.25, 0.5, 0.75)  # of the depth aimed at: 5, 10 and 15 mm of 20
OBLIQUE = np.radians(30.0)
APART = 40e-3  # [m]
DENSITY, GRAVITY = 1060.0, 9.81  # density of liver [kg/m^3], gravity [m/s^2]
_MAX_ITERATIONS = 30  # iterations of Newton's method


@dataclass(frozen=True)
class CombinedRow:
    """One push: the error of its forces at equal depth.

    site : accessible face whose centroid is pushed
    depth : depth [m]
    contact : |F - F_FE| / |F_FE|
    linear_contact : the same error of the linear vademecum
    within : whether the push lies in the stored range
    """

    combination: str
    site: int
    depth: float
    contact: float
    linear_contact: float
    within: bool


def push_errors(
    vademecum: Vademecum,
    problem: Hyperelasticity,
    depths: Sequence[float],
    n_sites: int,
    seed: int = 0,
    beyond: bool = False,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[CombinedRow]:
    """Return the errors of every combination, site and depth that has an equilibrium.

    Parameters
    ----------
    depths : Sequence[float]
        Increasing depths [m].
    n_sites, seed : int
        Number of sites, and the seed that draws them.
    beyond : bool
        Whether to include pushes that the vademecum reports as beyond its stored range.
    progress : Callable[[float], None]
        Called with the finished fraction.
    """
    rng = np.random.default_rng(seed)
    surface = vademecum.surface
    rows: list[CombinedRow] = []
    done, whole = 0, n_sites * len(COMBINATIONS)

    def pushed(fraction: float) -> None:
        progress((done + fraction) / whole)

    for triangle in rng.permutation(len(surface.corners))[:n_sites]:
        for name, combined in _at_site(vademecum, problem, int(triangle), rng).items():
            some = [depth for depth in depths if beyond or combined.reaches(depth)]
            states = _states(problem, combined, some, pushed)
            rows += [_row(name, int(triangle), combined, state) for state in states]
            done += 1
            progress(done / whole)
    return rows


def mean_error(rows: Sequence[CombinedRow], combination: str) -> float:
    """Return the mean error of the pushes within the stored range [-]; NaN without pushes."""
    found = [row.contact for row in rows if row.combination == combination and row.within]
    return float(np.mean(found)) if found else float("nan")


@dataclass(frozen=True, eq=False)
class _DepthCurve:
    """Added depth h(a) = sum_k beta_k a^k of a tip, tangential beyond its reach."""

    depth: FloatArray  # (2,) beta_k
    reach: float

    def __call__(self, a: float) -> float:
        return float(powers(max(a, 0.0), self.reach) @ self.depth)


@dataclass(frozen=True, eq=False)
class _Combined:
    """Forces f that move their patches to d n = C f + s h(s gamma f), m of them.

    loads : ndarray, shape (3 n_nodes, m), unit loads
    motion : ndarray, shape (m,), n
    preload : ndarray, shape (3 n_nodes,), or None
    compliance : ndarray, shape (m, m), C
    own : ndarray, shape (m,), gamma of each tip along its normal
    curves : h of each tip
    normal_fraction : s, the normal fraction of the force
    """

    loads: FloatArray
    motion: FloatArray
    compliance: FloatArray
    own: FloatArray
    curves: tuple[_DepthCurve, ...]
    normal_fraction: float = 1.0
    preload: FloatArray | None = None

    def motion_under(self, force: FloatArray) -> FloatArray:
        """Return d n of each patch along its load [m]."""
        a = self.normal_fraction * self.own * force
        added = [curve(x) for curve, x in zip(self.curves, a, strict=True)]
        return self.compliance @ force + self.normal_fraction * np.array(added)

    def forces(self, depth: float) -> FloatArray:
        """Return the forces that reach a depth, by Newton's method from the linear ones [N].

        Raises ConvergenceError if it finds none.
        """
        goal = depth * self.motion
        force = self.linear_forces(depth)
        for _ in range(_MAX_ITERATIONS):
            residual = goal - self.motion_under(force)
            if np.abs(residual).max() < 1e-9 * goal.max():
                return force
            step = 1e-5 * np.abs(force).max()
            ahead = [self.motion_under(force + step * e) for e in np.eye(len(goal))]
            slope = (np.stack(ahead, axis=1) - self.motion_under(force)[:, None]) / step
            force = force + np.linalg.solve(slope, residual)
        raise ConvergenceError(
            f"no forces found that push {depth * 1e3:.3g} mm deep in {_MAX_ITERATIONS} Newton "
            "iterations; certify shallower pushes"
        )

    def linear_forces(self, depth: float) -> FloatArray:
        """Return the forces that reach a depth in the linear vademecum [N]."""
        return np.linalg.solve(self.compliance, depth * self.motion)

    def reaches(self, depth: float) -> bool:
        """Return whether no tip goes beyond its reach."""
        a = self.normal_fraction * self.own * self.forces(depth)
        return all(x <= curve.reach for curve, x in zip(self.curves, a, strict=True))


@dataclass(frozen=True, eq=False)
class _Site:
    """One face's centroid: its place in the vademecum and its loads."""

    positions: np.ndarray
    weights: FloatArray
    inward: FloatArray
    loads: FloatArray  # (3 n_nodes, 3)

    def compliance(self, vademecum: Vademecum, other: _Site) -> FloatArray:
        """Return C(s, s')."""
        return vademecum.compliance(self.positions, self.weights, other.positions, other.weights)

    def depth_curve(self, vademecum: Vademecum) -> _DepthCurve:
        """Return the depth that large deformation adds."""
        large = vademecum.large
        assert large is not None
        reach = float(large.reach[PUSH, self.positions].min())
        return _DepthCurve(large.depth[PUSH][:, self.positions] @ self.weights, reach)


def _at_site(
    v: Vademecum, problem: Hyperelasticity, triangle: int, rng: np.random.Generator
) -> dict[str, _Combined]:
    """Return all combinations at one face, by name."""
    site = _site(v, problem, triangle)
    partner = _site(v, problem, _at_distance(v, triangle))
    found = (
        _oblique(v, site, rng.uniform(0.0, 2.0 * np.pi)),
        _two_tools(v, site, partner),
        _gravity(v, problem, site),
    )
    return dict(zip(COMBINATIONS, found, strict=True))


def _oblique(v: Vademecum, site: _Site, angle: float) -> _Combined:
    """Return a force 30 degrees off the inward normal, which moves its patch along itself."""
    across = np.linalg.svd(site.inward[None])[2][1:]
    sideways = np.cos(angle) * across[0] + np.sin(angle) * across[1]
    along = np.cos(OBLIQUE) * site.inward + np.sin(OBLIQUE) * sideways
    own = site.compliance(v, site)
    return _Combined(
        loads=(site.loads @ along)[:, None],
        motion=np.ones(1),
        compliance=np.array([[along @ own @ along]]),
        own=np.array([site.inward @ own @ site.inward]),
        curves=(site.depth_curve(v),),
        normal_fraction=float(np.cos(OBLIQUE)),
    )


def _two_tools(v: Vademecum, one: _Site, other: _Site) -> _Combined:
    """Return two patches pushed along their normals to one depth."""
    sites = (one, other)
    compliance = np.array(
        [[a.inward @ a.compliance(v, b) @ b.inward for b in sites] for a in sites]
    )
    return _Combined(
        loads=np.stack([site.loads @ site.inward for site in sites], axis=1),
        motion=np.ones(2),
        compliance=compliance,
        own=np.diag(compliance),
        curves=(one.depth_curve(v), other.depth_curve(v)),
    )


def _gravity(v: Vademecum, problem: Hyperelasticity, site: _Site) -> _Combined:
    """Return a push along the normal of an organ that hangs from its clamp (to -y: supine)."""
    weight = np.zeros((problem.n_nodes, 3))
    weight[: len(v.mesh.vertices), 1] = -DENSITY * GRAVITY * v.mesh.vertex_volumes
    gamma = np.array([[site.inward @ site.compliance(v, site) @ site.inward]])
    return _Combined(
        loads=(site.loads @ site.inward)[:, None],
        motion=np.ones(1),
        compliance=gamma,
        own=gamma[0],
        curves=(site.depth_curve(v),),
        preload=weight.ravel(),
    )


def _states(
    problem: Hyperelasticity,
    combined: _Combined,
    depths: Sequence[float],
    progress: Callable[[float], None],
) -> Iterator[State]:
    """Yield the full equilibria at the depths, until there is none."""
    if not depths:
        return
    rule = NewtonRule(exact_stability=False)
    c = combined
    try:
        yield from press(problem, c.loads, c.motion, depths, rule, c.preload, progress)
    except EquilibriumError:
        return


def _row(name: str, site: int, combined: _Combined, state: State) -> CombinedRow:
    """Compare the vademecum with a full equilibrium."""
    depth, truth = float(state.depth), state.force
    curved, linear = (
        float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
        for found in (combined.forces(depth), combined.linear_forces(depth))
    )
    return CombinedRow(name, site, depth, curved, linear, combined.reaches(depth))


def _site(v: Vademecum, problem: Hyperelasticity, triangle: int) -> _Site:
    surface = v.surface
    center = surface.centroids[[triangle]]
    positions, weights = surface.weights(np.array([triangle]), np.full((1, 3), 1.0 / 3.0))
    loads = patch_loads(problem.linear, center, surface.patch_radius).toarray()
    normal = patch_normals(v.mesh, center, surface.patch_radius)[0]
    return _Site(positions[0], weights[0], -normal, loads)


def _at_distance(v: Vademecum, triangle: int) -> int:
    """Return the face whose centroid lies closest to 40 mm away."""
    distance = np.linalg.norm(v.surface.centroids - v.surface.centroids[triangle], axis=1)
    return int(np.abs(distance - APART).argmin())
