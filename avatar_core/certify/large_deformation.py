"""Errors of a vademecum with large deformation on unseen pushes and pulls.

The reference is the full nonlinear finite element solution on the same mesh, by Newton's method.
Patches are centred at face centroids, and moved along the normal to depths that the build does not
use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.certify.combinations import CombinedRow, mean_error
from avatar_core.common.arrays import FloatArray
from avatar_core.errors import EquilibriumError
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.newton import NewtonRule, press
from avatar_core.fem.norms import relative_l2
from avatar_core.fem.patch_loads import patch_loads, patch_normals
from avatar_core.vademecum.large_deformation import PUSH, LargeCertificate
from avatar_core.vademecum.model import Vademecum

_PUSHES_PER_PULL = 3


@dataclass(frozen=True)
class LargeRow:
    """One push or pull: errors at equal depth.

    triangle : accessible face whose centroid is pushed
    depth : inward depth, negative for a pull [m]
    l2 : |u - u_FE| / |u_FE|, mass-weighted
    contact : |F / F_FE - 1|
    linear_l2, linear_contact : the same errors of the linear vademecum
    within : whether the push lies in the stored range
    """

    triangle: int
    depth: float
    l2: float
    contact: float
    linear_l2: float
    linear_contact: float
    within: bool


def certify_large(
    vademecum: Vademecum,
    problem: Hyperelasticity,
    n_sites: int = 12,
    max_push: float = 20e-3,
    seed: int = 0,
    progress: Callable[[float, float], None] = lambda fraction, error: None,
) -> tuple[LargeCertificate, tuple[LargeRow, ...]]:
    """Push at random centroids to the depths 1/4, 1/2, 3/4 and 1 of the stored range there.

    Each third of them is pulled as far too. Random factors of 0.9 to 1 keep the depths from being
    round.

    progress : called with the finished fraction and the mean error so far
    """
    surface = vademecum.surface
    rng = np.random.default_rng(seed)
    sites = rng.permutation(len(surface.corners))[:n_sites]
    rows: list[LargeRow] = []
    n_lost = 0
    error = np.nan
    for done, triangle in enumerate(sites):
        depths = max_push * np.array([0.25, 0.5, 0.75, 1.0]) * rng.uniform(0.9, 1.0, 4)

        def pushed(fraction: float, done: int = done, error: float = error) -> None:
            progress((done + fraction) / len(sites), error)

        for side in (1.0, -1.0)[: 2 if done % _PUSHES_PER_PULL == 0 else 1]:
            found, lost = push_rows(
                vademecum, problem, int(triangle), side * depths, progress=pushed
            )
            rows += found
            n_lost += lost
        error = float(np.mean([row.l2 for row in rows] or [np.nan]))
        progress((done + 1) / len(sites), error)
    return summary(vademecum, rows, len(sites), n_lost), tuple(rows)


def with_combinations(
    certificate: LargeCertificate, rows: Sequence[CombinedRow]
) -> LargeCertificate:
    """Return the certificate with the figures of pushes together with other effects."""
    return replace(
        certificate,
        oblique_contact_mean=mean_error(rows, "oblique"),
        two_tools_contact_mean=mean_error(rows, "two tools"),
        gravity_contact_mean=mean_error(rows, "gravity"),
    )


def push_rows(
    vademecum: Vademecum,
    problem: Hyperelasticity,
    triangle: int,
    depths: FloatArray,
    barycentric: tuple[float, float, float] = (1 / 3, 1 / 3, 1 / 3),
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[list[LargeRow], bool]:
    """Return errors at a point of one face, and whether equilibrium was lost in the stored range.

    depths : all inward, or all negative [m]
    barycentric : place of the point; the centroid by default
    progress : called with the fraction of the last depth that is reached
    """
    surface = vademecum.surface
    place = np.array([barycentric])
    center = place @ surface.centers[surface.corners[triangle]]
    normal = patch_normals(vademecum.mesh, center, surface.patch_radius)[0]
    side = float(np.sign(depths[0]))
    load = patch_loads(problem.linear, center, surface.patch_radius) @ (-side * normal)
    positions, weights = (x[0] for x in surface.weights(np.array([triangle]), place))
    linear, mass = replace(vademecum, large=None), vademecum.mesh.lumped_mass
    rows: list[LargeRow] = []
    rule = NewtonRule(exact_stability=False)
    try:
        for state in press(problem, load, np.ones(1), list(abs(depths)), rule, progress=progress):
            truth = state.displacement[: 3 * len(vademecum.mesh.vertices)]
            depth, exact = side * state.depth, side * float(state.force[0])
            force, found = vademecum.push_to(positions, weights, depth)
            plain, straight = linear.push_to(positions, weights, depth)
            rows.append(
                LargeRow(
                    triangle,
                    depth,
                    float(relative_l2(found.displacement, truth, mass)),
                    abs(force / exact - 1.0),
                    float(relative_l2(straight.displacement, truth, mass)),
                    abs(plain / exact - 1.0),
                    found.within,
                )
            )
    except EquilibriumError:
        next_depth = depths[len(rows)]
        return rows, vademecum.push_to(positions, weights, float(next_depth))[1].within
    return rows, False


def summary(
    vademecum: Vademecum, rows: list[LargeRow], n_sites: int, n_lost: int
) -> LargeCertificate:
    """Return means and worst over the pushes and pulls within the stored range."""
    assert vademecum.large is not None
    inside = [row for row in rows if row.within and row.depth > 0.0]
    pulled = [row for row in rows if row.within and row.depth < 0.0]

    def values(name: str, some: list[LargeRow] = inside) -> FloatArray:
        return np.array([getattr(row, name) for row in some] or [np.nan])

    return LargeCertificate(
        l2_mean=float(values("l2").mean()),
        l2_worst=float(values("l2").max()),
        contact_mean=float(values("contact").mean()),
        contact_worst=float(values("contact").max()),
        linear_l2_mean=float(values("linear_l2").mean()),
        linear_contact_mean=float(values("linear_contact").mean()),
        n_sites=n_sites,
        n_pushes=len(inside),
        n_lost=n_lost,
        depth=float(values("depth").max()),
        reach_median=float(np.median(vademecum.large.reach[PUSH])),
        reach_least=float(vademecum.large.reach[PUSH].min()),
        n_pulls=len(pulled),
        pull_l2_mean=float(values("l2", pulled).mean()),
        pull_l2_worst=float(values("l2", pulled).max()),
        pull_contact_mean=float(values("contact", pulled).mean()),
        pull_linear_l2_mean=float(values("linear_l2", pulled).mean()),
    )
