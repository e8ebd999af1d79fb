"""Force at some places and depths as a function of the material, from a few vademecums.

    ln F(p) ~ sum_n l_n(p) ln F(p_n)

over the points of :mod:`avatar_core.uncertainty.material_grid`. The displacement elsewhere is
interpolated alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.contact.layout import Shape, lay_out
from avatar_core.contact.model import ContactModel, Status, step
from avatar_core.errors import ContactError
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.geometry.point_location import carriers
from avatar_core.geometry.tip import Tip
from avatar_core.uncertainty.material_grid import MaterialGrid
from avatar_core.vademecum.accuracy import Detail
from avatar_core.vademecum.model import Vademecum

_ABOVE = 2e-3  # over the surface, where a tip starts [m]
_STEP = 2e-3  # in which it comes down, at most: it must not be taken for one that jumped [m]


@dataclass(frozen=True, eq=False)
class ForceTable:
    """Forces and displacements at the points of a grid of materials.

    places : ndarray, shape (n_places, 3), load positions that are pressed [m]
    log_force : ndarray, shape (n_points, n_places, n_depths), logarithm of the force [N]
    log_moved : ndarray, shape (n_points, n_places, n_depths), logarithm of the displacement of the
        target [m]
    """

    grid: MaterialGrid
    places: FloatArray
    log_force: FloatArray
    log_moved: FloatArray

    def force(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Return the force at values of all coordinates and "young" [N].

        Each value has the shape (n,); the result (n, n_places, n_depths).
        """
        softer = np.log(self.grid.softer(values))
        found = np.tensordot(self.grid.weights(values), self.log_force, 1)
        return np.asarray(np.exp(found + softer[:, None, None]))

    def moved(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Return target's displacement at these values, of the same shape [m]; E has no effect."""
        return np.asarray(np.exp(np.tensordot(self.grid.weights(values), self.log_moved, 1)))


def force_table(
    vademecum: Vademecum,
    tip: Tip,
    places: Sequence[int],
    depths: Sequence[float],
    target: FloatArray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ForceTable:
    """Press at load positions, at every point of the coordinates; return the table.

    Parameters
    ----------
    places : Sequence[int]
        Load positions.
    depths : Sequence[float]
        Depths of the tip below the surface, rising [m].
    target : ndarray, shape (3,)
        Point of the organ whose displacement is asked for [m].
    progress : Callable[[int, int], None]
        Called with the number of finished materials, and of all.

    Raises
    ------
    ContactError
        If a tip finds no surface at a place, or has no force there.
    """
    grid, force, moved = MaterialGrid.of(vademecum), [], []
    shape = Shape.of(vademecum, (tip,))
    for done, here in enumerate(grid.materials(vademecum)):
        model = ContactModel(lay_out(here, (tip,), Detail(1, "off"), shape=shape))
        found = _pressed(model, here.surface, tip, places, depths)
        force.append(found)
        moved.append(found * _motion(here, places, target)[:, None])
        progress(done + 1, grid.n_points)
    least = np.finfo(float).tiny  # where the target is clamped
    return ForceTable(
        grid,
        vademecum.surface.centers[list(places)],
        np.log(force),
        np.log(np.maximum(moved, least)),
    )


def _pressed(
    model: ContactModel,
    surface: LoadSurface,
    tip: Tip,
    places: Sequence[int],
    depths: Sequence[float],
) -> FloatArray:
    """Return the forces on a tip that is pressed along the normal, (n_places, n_depths) [N]."""
    data, force = model.data(), np.empty((len(places), len(depths)))
    for i, j in enumerate(places):
        data.reset()
        before = -_ABOVE
        for k, depth in enumerate(depths):
            for part in np.linspace(before, depth, 2 + int((depth - before) / _STEP)):
                at = surface.centers[j] + (tip.offset - part) * surface.normals[j]
                status = step(model, data, at[None])
            felt = status in (Status.OK, Status.EXTRAPOLATED)
            before, force[i, k] = depth, felt * np.linalg.norm(data.out.force[0])
        if not (force[i] > 0.0).all():
            x, y, z = 1e3 * surface.centers[j]
            raise ContactError(
                f"no force acts on a tip {1000.0 * depths[0]:g} to {1000.0 * depths[-1]:g} mm "
                f"deep at ({x:.0f}, {y:.0f}, {z:.0f}) mm; choose another place, or other "
                "depths"
            )
    return force


def _motion(vademecum: Vademecum, places: Sequence[int], target: FloatArray) -> FloatArray:
    """Return a point's displacement by a unit normal force at each place, (n,) [m/N]."""
    corners, weights = carriers(vademecum.mesh, target[None])
    normals, found = vademecum.surface.normals, []
    for j in places:
        by_axis = vademecum.displacement(np.array([j]), np.ones(1)).reshape(-1, 3, 3)
        moved = np.tensordot(weights[0], by_axis[corners[0]], 1)
        found.append(np.linalg.norm(moved @ normals[j]))
    return np.array(found)
