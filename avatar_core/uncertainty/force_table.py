"""The force at some places and depths as a function of the material, from a few vademecums.

    ln F(p) ~ sum_n l_n(t(p)) ln F(p_n),    F ~ E,

with l_n the Lagrange polynomials on Chebyshev's points (of the first kind) of the coordinates'
ranges, each in its own scale t, tensor-wise. The response is analytic in the coordinates, so that
the error falls geometrically with the points (Trefethen, Approximation Theory, 2013); what the
displacement elsewhere needs is interpolated alike. Young's modulus needs no point: forces at an
imposed depth are proportional to it, with supports at the same stiffness over E,

    F(E, k) = E / E0 F(E0, k E0 / E).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.contact.layout import lay_out
from avatar_core.contact.model import Status, make_model, step
from avatar_core.errors import ContactError
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.vademecum.accuracy import Detail
from avatar_core.vademecum.at_values import at_values
from avatar_core.vademecum.model import Vademecum

N_POINTS = 5  # of Chebyshev, for each coordinate
_ABOVE = 2e-3  # over the surface, where a tip starts [m]
_STEP = 2e-3  # in which it comes down, at most: it must not be taken for one that jumped [m]


@dataclass(frozen=True, eq=False)
class ForceTable:
    """Forces and displacements at Chebyshev's points of the coordinates.

    coordinates : of the vademecum
    young : Young's modulus of the forces, E0 [Pa]
    log_force : ndarray, shape (n_points, n_places, n_depths), ln of the force [N]
    log_moved : ndarray of that shape, ln of the displacement of the target [m]
    """

    coordinates: tuple[Coordinate, ...]
    young: float
    log_force: FloatArray
    log_moved: FloatArray

    def force(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """At values of all coordinates and "young", each (n,): (n, n_places, n_depths) [N]."""
        softer = np.log(np.asarray(values["young"]) / self.young)
        found = np.tensordot(weights_at(self.coordinates, self.young, values), self.log_force, 1)
        return np.asarray(np.exp(found + softer[:, None, None]))

    def moved(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Displacement of the target at these values, of that shape [m]; it knows no E."""
        weights = weights_at(self.coordinates, self.young, values)
        return np.asarray(np.exp(np.tensordot(weights, self.log_moved, 1)))


def grid_points(
    coordinates: Sequence[Coordinate], n_points: int = N_POINTS
) -> list[dict[str, float]]:
    """Values of coordinates, by name, at Chebyshev's points, ``n_points`` for each."""
    grids = product(*([c.value_at(t) for t in _points(n_points)] for c in coordinates))
    return [dict(zip([c.name for c in coordinates], point, strict=True)) for point in grids]


def weights_at(
    coordinates: Sequence[Coordinate],
    young: float,
    values: Mapping[str, FloatArray],
    n_points: int = N_POINTS,
) -> FloatArray:
    """Weights of :func:`grid_points` at some values, shape (n, n_points ** n_coordinates).

    young : Young's modulus of the points [Pa]
    values : of these coordinates and "young", each (n,)
    """
    weights = np.ones((len(np.asarray(values["young"])), 1))
    for coordinate in coordinates:
        at = np.asarray(values[coordinate.name])
        if coordinate.kind == "support":  # far from all else it changes little: the ends do
            at = np.clip(at * young / values["young"], coordinate.low, coordinate.high)
        own = _lagrange([coordinate.fraction(float(v)) for v in at], n_points)
        weights = (weights[:, :, None] * own[:, None, :]).reshape(len(own), -1)
    return weights


def force_table(
    vademecum: Vademecum,
    tip: Tip,
    places: Sequence[int],
    depths: Sequence[float],
    target: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ForceTable:
    """Press at load positions, at every point of the coordinates.

    Parameters
    ----------
    places : load positions
    depths : rising, of the tip below the surface [m]
    target : vertex whose displacement is asked for

    Raises
    ------
    ContactError
        If a tip finds no surface at a place, or is not felt there.
    """
    parametric = vademecum.parametric
    coordinates = parametric.coordinates if parametric else ()
    points = grid_points(coordinates)
    force, moved = [], []
    young = parametric.young_modulus if parametric else vademecum.material.young_modulus
    reference = {"young": young} if parametric else {}
    for done, point in enumerate(points):
        here = at_values(vademecum, reference | point)
        found = _pressed(here, tip, places, depths)
        force.append(found)
        moved.append(found * _motion(here, places, target)[:, None])
        progress(done + 1, len(points))
    least = np.finfo(float).tiny  # where the target is clamped
    return ForceTable(coordinates, young, np.log(force), np.log(np.maximum(moved, least)))


def _pressed(
    vademecum: Vademecum, tip: Tip, places: Sequence[int], depths: Sequence[float]
) -> FloatArray:
    """Forces on a tip that is pressed along the normal, (n_places, n_depths) [N]."""
    model = make_model(lay_out(vademecum, (tip,), Detail(1, "off")))
    surface, force = vademecum.surface, np.empty((len(places), len(depths)))
    for i, j in enumerate(places):
        model.reset()
        before = -_ABOVE
        for k, depth in enumerate(depths):
            for part in np.linspace(before, depth, 2 + int((depth - before) / _STEP)):
                at = surface.centers[j] + (tip.offset - part) * surface.normals[j]
                status = step(model, at[None])
            felt = status in (Status.OK, Status.EXTRAPOLATED)
            before, force[i, k] = depth, felt * np.linalg.norm(model.out.force[0])
        if not (force[i] > 0.0).all():
            x, y, z = 1e3 * surface.centers[j]
            raise ContactError(
                f"nothing is felt of a tip {1e3 * depths[0]:g} to {1e3 * depths[-1]:g} mm deep at "
                f"({x:.0f}, {y:.0f}, {z:.0f}) mm; choose another place, or other depths"
            )
    return force


def _motion(vademecum: Vademecum, places: Sequence[int], target: int) -> FloatArray:
    """Displacement of a vertex by a unit force along the normal of each place, (n,) [m/N]."""
    normals, three = vademecum.surface.normals, slice(3 * target, 3 * target + 3)
    found = []
    for j in places:
        by_axis = vademecum.displacement(np.array([j]), np.ones(1))[three]
        found.append(np.linalg.norm(by_axis @ normals[j]))
    return np.array(found)


def _points(n: int) -> FloatArray:
    """Chebyshev's points of the first kind on 0 to 1, ascending."""
    angles = np.pi * (np.arange(n) + 0.5) / n
    return np.asarray(0.5 - 0.5 * np.cos(angles))


def _lagrange(fractions: Sequence[float], n: int) -> FloatArray:
    """Weights of n Chebyshev points at some places of the range, shape (n_places, n)."""
    nodes, at = _points(n), np.asarray(fractions)[:, None]
    columns = []
    for k in range(n):
        others = np.delete(nodes, k)
        columns.append(np.prod((at - others) / (nodes[k] - others), axis=1))
    return np.stack(columns, axis=1)
