"""Contacts that a build does not use: tips anywhere over the accessible faces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import igl
import numpy as np
import scipy.sparse as sp

from avatar_core.common.processes import on_all_cores
from avatar_core.common.splines import evaluate
from avatar_core.errors import ConvergenceError
from avatar_core.fem.patch_loads import LoadSurface, patch_loads

if TYPE_CHECKING:
    from avatar_core.fem.elasticity import Elasticity
    from avatar_core.vademecum.model import Vademecum
    from avatar_core.vademecum.tip_field import TipField

HEIGHTS = (0.0, 10e-3)  # heights of a ball's centre above the surface, up to 10 mm [m]
_OPEN = 0.999  # access from which a tip may touch without the force fading
_WAY = np.linspace(2e-3, 14e-3, 8)  # heights above a tip along its approach [m]
_BATCH = 40  # patches solved at once
MAX_DRAWS = 1000  # for one contact, on average; on livers most draws succeed


@dataclass(frozen=True, eq=False)
class UnseenContacts:
    """Tips and the points that they touch, each (n, 3).

    Attributes
    ----------
    tip : ndarray, shape (n, 3)
        Centre of the sphere [m].
    place : ndarray, shape (n, 3)
        Point of the faces under its contact, the closest to tip - phi n [m].
    normal : ndarray, shape (n, 3)
        Normal n, along which the step presses.
    """

    tip: np.ndarray
    place: np.ndarray
    normal: np.ndarray

    def solved(
        self, surface: LoadSurface, elasticity: Elasticity, single: bool = False
    ) -> Iterator[tuple[float, np.ndarray]]:
        """Solve each contact by full finite elements, on all cores.

        Parameters
        ----------
        single : bool
            Solve in single precision.

        Yields
        ------
        compliance : float
            n . C n of a patch at the place [m/N].
        displacement : ndarray, shape (n_vertices, 3)
            Displacement by its unit force along n [m/N].
        """
        n = len(self.tip)

        def solve(batch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            loads = patch_loads(elasticity, self.place[batch], surface.patch_radius)
            along = loads @ sp.block_diag(self.normal[batch][:, :, None])
            solution = elasticity.solve(along, single)
            compliance = np.asarray(along.multiply(solution).sum(axis=0)).ravel()
            return compliance, elasticity.at_vertices(solution).T.reshape(len(batch), -1, 3)

        elasticity.factorize(single)
        batches = np.array_split(np.arange(n), -(-n // _BATCH))
        for compliance, vertex in on_all_cores(solve, batches):
            yield from zip(compliance, vertex, strict=True)


def draw_contacts(vademecum: Vademecum, n: int, seed: int) -> UnseenContacts:
    """Return tips above points that are drawn evenly over the accessible faces.

    Each can come in along its normal: no other lobe of the organ hangs over it.

    Raises
    ------
    ConvergenceError
        If a tip finds no free place in ``MAX_DRAWS`` random draws.
    """
    surface, field = vademecum.surface, vademecum.tip_field
    rng = np.random.default_rng(seed)
    corner = surface.centers[surface.corners]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    tips, normals, feet = np.empty((3, n, 3))
    found, draws = 0, 0
    while found < n:
        draws += 1
        if draws > MAX_DRAWS * (found + 1):
            raise ConvergenceError(
                f"{found} of {n} tips found a place on the accessible surface in {draws - 1} "
                "random draws; open a larger or smoother region to the tool"
            )
        face = rng.choice(len(corner), p=area / area.sum())
        point = rng.dirichlet(np.ones(3)) @ corner[face]
        tip = point + rng.uniform(*HEIGHTS) * surface.face_normals[face]
        gradient = np.zeros(3)
        if _at(field, field.access, tip, gradient) < _OPEN:
            continue
        phi = _at(field, field.distance, tip, gradient)
        normal = gradient / np.linalg.norm(gradient)
        if _is_obstructed(field, tip, normal):
            continue
        tips[found], normals[found], feet[found] = tip, normal, tip - phi * normal
        found += 1
    place = igl.point_mesh_squared_distance(feet, surface.centers, surface.corners)[2]
    return UnseenContacts(tips, np.ascontiguousarray(place), normals)


def _is_obstructed(field: TipField, tip: np.ndarray, normal: np.ndarray) -> bool:
    """Return whether the organ itself is in the way of a tip along its normal."""
    way = tip + np.outer(_WAY, normal)
    slope = np.zeros(3)
    return min(_at(field, field.distance, p, slope, outside=np.inf) for p in way) <= 0.0


def _at(
    field: TipField,
    values: np.ndarray,
    point: np.ndarray,
    gradient: np.ndarray,
    outside: float = 0.0,
) -> float:
    return float(evaluate(values, field.origin, field.spacing[0], point, gradient, outside))
