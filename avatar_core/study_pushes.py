"""Pushes that are not one force along the normal: how a vademecum with large deformation does.

Only the answer of a tip to itself bends; oblique forces, other tips and preloads are added
linearly. Each is compared with full nonlinear finite elements under the same motion of the patch:

    oblique   30 degrees off the normal
    two tools 40 mm apart, pushed to the same depth together
    gravity   the organ hangs under its own weight before it is pushed
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar_core.compact import FloatArray
from avatar_core.equilibrium import NewtonRule, press
from avatar_core.errors import EquilibriumError
from avatar_core.hyperelasticity import Hyperelasticity
from avatar_core.large_deformation import powers
from avatar_core.loads import patch_loads, patch_normals
from avatar_core.vademecum import Vademecum

OBLIQUE = np.radians(30.0)
APART = 40e-3  # [m]
DENSITY, GRAVITY = 1060.0, 9.81  # of liver [kg/m^3], [m/s^2]
REFUSED = 0.15  # error of the force above which a scene must not combine


@dataclass(frozen=True, eq=False)
class _Site:
    """One face's centroid: its place in the vademecum and its loads."""

    positions: np.ndarray
    weights: FloatArray
    inward: FloatArray
    loads: FloatArray  # (3 n_nodes, 3)

    def compliance(self, vademecum: Vademecum, other: _Site) -> FloatArray:
        """C(s, s')."""
        return vademecum.compliance(self.positions, self.weights, other.positions, other.weights)


def push_errors(
    vademecum: Vademecum, problem: Hyperelasticity, depths: FloatArray, n_sites: int, seed: int = 0
) -> list[dict[str, float | str]]:
    """|F / F_FE - 1| of every combination, site and depth that has an equilibrium.

    Returns
    -------
    rows with keys combination, site, depth, contact and linear_contact, the error of the linear
    vademecum
    """
    rng = np.random.default_rng(seed)
    surface = vademecum.surface
    rows: list[dict[str, float | str]] = []
    for triangle in rng.permutation(len(surface.corners))[:n_sites]:
        site = _site(vademecum, problem, int(triangle))
        partner = _site(vademecum, problem, _at_distance(vademecum, int(triangle)))
        angle = rng.uniform(0.0, 2.0 * np.pi)
        for name, found in (
            ("oblique", _oblique(vademecum, problem, site, angle, depths)),
            ("two tools", _two_tools(vademecum, problem, site, partner, depths)),
            ("gravity", _gravity(vademecum, problem, site, depths)),
        ):
            for depth, contact, linear in found:
                rows.append(
                    {
                        "combination": name,
                        "site": int(triangle),
                        "depth": depth,
                        "contact": contact,
                        "linear_contact": linear,
                    }
                )
    return rows


Found = list[tuple[float, float, float]]


def _oblique(
    v: Vademecum, problem: Hyperelasticity, site: _Site, angle: float, depths: FloatArray
) -> Found:
    """A force 30 degrees off the inward normal moves its patch along itself."""
    across = np.linalg.svd(site.inward[None])[2][1:]
    sideways = np.cos(angle) * across[0] + np.sin(angle) * across[1]
    along = np.cos(OBLIQUE) * site.inward + np.sin(OBLIQUE) * sideways
    own = site.compliance(v, site)
    gamma = float(site.inward @ own @ site.inward)

    def depth_of(force: FloatArray, bent: bool) -> FloatArray:
        a = gamma * force[0] * np.cos(OBLIQUE)
        added = np.cos(OBLIQUE) * _bent(v, site, a) if bent else 0.0
        return np.array([float(along @ own @ along) * force[0] + added])

    return _compare(problem, (site.loads @ along)[:, None], np.ones(1), depths, depth_of)


def _two_tools(
    v: Vademecum, problem: Hyperelasticity, one: _Site, other: _Site, depths: FloatArray
) -> Found:
    """Two patches pushed along their normals to one depth."""
    sites = (one, other)
    compliance = np.array(
        [[a.inward @ a.compliance(v, b) @ b.inward for b in sites] for a in sites]
    )

    def depth_of(force: FloatArray, bent: bool) -> FloatArray:
        depth = compliance @ force
        if bent:
            depth += [_bent(v, s, compliance[i, i] * force[i]) for i, s in enumerate(sites)]
        return np.asarray(depth)

    loads = np.stack([site.loads @ site.inward for site in sites], axis=1)
    return _compare(problem, loads, np.ones(2), depths, depth_of)


def _gravity(v: Vademecum, problem: Hyperelasticity, site: _Site, depths: FloatArray) -> Found:
    """A push along the normal of an organ that already hangs from its clamp (to -y: supine)."""
    weight = np.zeros((problem.n_nodes, 3))
    weight[: len(v.mesh.vertices), 1] = -DENSITY * GRAVITY * v.mesh.vertex_volumes
    gamma = float(site.inward @ site.compliance(v, site) @ site.inward)

    def depth_of(force: FloatArray, bent: bool) -> FloatArray:
        a = gamma * force
        return a + (_bent(v, site, float(a[0])) if bent else 0.0)

    load = (site.loads @ site.inward)[:, None]
    return _compare(problem, load, np.ones(1), depths, depth_of, weight.ravel())


def _compare(  # type: ignore[no-untyped-def]
    problem: Hyperelasticity,
    loads: FloatArray,
    motion: FloatArray,
    depths: FloatArray,
    depth_of,
    preload: FloatArray | None = None,
) -> Found:
    """Depth, error and linear error of the forces of a motion, until equilibrium is lost."""
    found: Found = []
    try:
        states = press(
            problem, loads, motion, list(depths), NewtonRule(exact_stability=False), preload
        )
        for state in states:
            truth, goal = state.force, state.depth * motion
            errors = [
                np.linalg.norm(_forces(depth_of, goal, truth, bent) - truth) / np.linalg.norm(truth)
                for bent in (True, False)
            ]
            found.append((state.depth, float(errors[0]), float(errors[1])))
    except EquilibriumError:
        pass
    return found


def _forces(depth_of, goal: FloatArray, start: FloatArray, bent: bool) -> FloatArray:  # type: ignore[no-untyped-def]
    """The forces at which the depths are reached, by Newton's method."""
    force = start.copy()
    for _ in range(30):
        left = goal - depth_of(force, bent)
        if np.abs(left).max() < 1e-9 * goal.max():
            break
        step = 1e-5 * np.abs(start).max()
        slope = np.stack(
            [
                (depth_of(force + step * e, bent) - depth_of(force, bent)) / step
                for e in np.eye(len(goal))
            ],
            axis=1,
        )
        force = force + np.linalg.solve(slope, left)
    return force


def _bent(v: Vademecum, site: _Site, a: float) -> float:
    """sum_k beta_k a^k at a site, tangential beyond its reach."""
    assert v.large is not None
    terms = powers(max(a, 0.0), float(v.large.reach[site.positions].min()))
    return float(terms @ (v.large.depth[:, site.positions] @ site.weights))


def _site(v: Vademecum, problem: Hyperelasticity, triangle: int) -> _Site:
    surface = v.surface
    center = surface.centroids[[triangle]]
    positions, weights = surface.weights(np.array([triangle]), np.full((1, 3), 1.0 / 3.0))
    loads = patch_loads(problem.linear, center, surface.patch_radius).toarray()
    normal = patch_normals(v.mesh, center, surface.patch_radius)[0]
    return _Site(positions[0], weights[0], -normal, loads)


def _at_distance(v: Vademecum, triangle: int) -> int:
    """The face whose centroid lies closest to 40 mm away."""
    distance = np.linalg.norm(v.surface.centroids - v.surface.centroids[triangle], axis=1)
    return int(np.abs(distance - APART).argmin())
