"""The force of a ball on one organ that is given in two ways: turned, or meshed more coarsely.

The patient is the same, so that the forces should be the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from avatar_core.certify.contact_sites import Site, draw_sites, pressed
from avatar_core.contact.model import model_of
from avatar_core.geometry.groups import REGIONS
from avatar_core.geometry.mesh import TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.pipeline import OrganOptions, build
from avatar_core.vademecum.model import Vademecum

TURN = np.radians(30.0)  # about the axis S
COARSE = 700  # vertices of the coarser mesh
BALL, DEPTH = Tip("sphere", 5e-3), 2e-3  # [m]


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences of the forces at some places of an organ given in two ways.

    difference : ndarray, shape (n,), |F' / F - 1|, F of the first way
    said : ndarray, shape (n,), the sum of both estimated errors of the step, over F
    """

    difference: np.ndarray
    said: np.ndarray

    def figures(self, name: str) -> dict[str, float]:
        """Return the quantiles, and the fraction of places that the estimated errors cover."""
        return {
            f"{name}_median": float(np.median(self.difference)),
            f"{name}_p95": float(np.quantile(self.difference, 0.95)),
            f"{name}_worst": float(self.difference.max()),
            f"{name}_coverage": float(np.mean(self.difference <= self.said)),
            f"{name}_places": float(len(self.difference)),
        }


def differences(surface: SurfaceMesh, options: OrganOptions, n: int) -> dict[str, float]:
    """Return figures of the organ turned, and of its coarser mesh, against the given organ.

    All three are held, and open to tools, at the same points, because rules depend on the axes.
    """
    cosine, sine = np.cos(TURN), np.sin(TURN)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    groups = _groups(tetrahedralize(surface, options.n_vertices))
    with TemporaryDirectory() as folder:
        here, there = Path(folder, "here.npz"), Path(folder, "there.npz")
        np.savez(here, allow_pickle=False, **groups)
        aside = {name: points @ turn.T for name, points in groups.items()}
        np.savez(there, allow_pickle=False, **aside)
        options = replace(options, groups=here)
        whole, coarse = build(surface, options), build(surface, replace(options, n_vertices=COARSE))
        moved = replace(surface, vertices=surface.vertices @ turn.T)
        turned = build(moved, replace(options, groups=there))
    sites = draw_sites(whole, surface, n + 2, seed=11)[:-2]
    others = [replace(s, point=turn @ s.point, normal=turn @ s.normal) for s in sites]
    return {
        **_between(whole, sites, turned, others).figures("turned"),
        **_between(whole, sites, coarse, sites).figures("coarse"),
    }


def _groups(mesh: TetMesh) -> dict[str, np.ndarray]:
    """Return the corners and middles of the faces that the rules clamp and open [m]."""
    regions, corners = regions_by_rule(mesh), mesh.vertices[mesh.boundary_faces]
    points = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1)
    return {name: points[getattr(regions, name)].reshape(-1, 3) for name in REGIONS}


def _between(
    one: Vademecum, here: Sequence[Site], other: Vademecum, there: Sequence[Site]
) -> Differences:
    """Compare places where both touch: at the border of the access, one of them may not."""
    first, second = (_forces(v, sites) for v, sites in ((one, here), (other, there)))
    both = np.isfinite(first[0] + second[0])
    (a, error_a), (b, error_b) = first[:, both], second[:, both]
    return Differences(np.abs(b / a - 1.0), (error_a + error_b) / a)


def _forces(vademecum: Vademecum, sites: Sequence[Site]) -> np.ndarray:
    """Return sizes of the forces, and their estimated errors, (2, n) [N]; NaN if refused."""
    data = model_of(vademecum, (BALL,), cloud="off", effects=()).data()
    found = np.empty((2, len(sites)))
    for k, site in enumerate(sites):
        found[:, k] = np.linalg.norm(pressed(data, site, BALL, DEPTH)), data.out.force_error[0]
    return found
