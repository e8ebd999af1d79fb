"""Compiled kernels for displayed vertices that are not the mesh's own.

A displayed vertex x is interpolated from four vertices x_i of the mesh
(:mod:`avatar_core.vademecum.display`). Near a tip the field of a patch bends within a triangle, but
is known there (:mod:`avatar_core.tips.dent`). Along the inward normal, p is its displacement on a
half-space, faded by h, and u_tip that of the tip:

    u(x) = sum_i w_i [u(x_i) + n h p(x_i)]  -  n h u_tip(x),

so that only smooth fields are interpolated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast
from avatar_core.tips.dent import add_dents, points_around

if TYPE_CHECKING:
    from avatar_core.vademecum.display import Display

_NOWHERE = 1e3  # farther than any tip reaches [m]

DISPLAY = kind(
    "Display",
    corner=array("v 4", np.int32),  # points of the mesh that carry each displayed vertex
    weight=array("v 4", np.float32),
    rest=array("p 3", np.float32),  # the mesh's points at rest [m]
    start=array("q", np.int64),  # first of the mesh's points around each load position, in
    around=array("a", np.int32),  # points that a tip near the load position may move
)


def display_arrays(
    display: Display,
    vertex: np.ndarray,
    place: np.ndarray,
    vertices: np.ndarray,
    positions: np.ndarray,
    patch_radius: float,
) -> Any:
    """Return the corners and weights of the displayed vertices, a tuple of DISPLAY.

    vertex : mesh vertex in each place of the blocks; -1 where a block is not full
    place : place of each vertex in the blocks
    vertices : ndarray, shape (n_vertices, 3), of the mesh [m]
    positions : ndarray, shape (n_positions, 3), of the patches [m]
    """
    rest = np.where(vertex[:, None] < 0, _NOWHERE, vertices[vertex])
    return DISPLAY(
        np.ascontiguousarray(place[display.corners]),
        display.weights,
        rest.astype(np.float32),
        *points_around(rest, positions, patch_radius),
    )


@fast
def write_cloud(model, data):  # type: ignore[no-untyped-def]
    """Write the cloud from the modes' displacement in ``data.field``, with the tips' dents.

    If displayed vertices are not the mesh's, the cloud holds those.
    """
    cloud, dents, shown = data.out.cloud, model.dent, model.display
    flat = cloud.reshape(6 * cloud.shape[0])
    if not model.display.on:
        _write(model.rest, model.place, data.field, cloud)
        add_dents(model, data, dents.start, dents.around, model.rest, flat, 6, 1.0, 1.0)
        return
    add_dents(model, data, shown.start, shown.around, shown.rest, data.field, 3, 0.0, 1.0)
    _interpolate(model, model.rest, data.field, cloud)
    add_dents(model, data, dents.start, dents.around, model.rest, flat, 6, 1.0, 0.0)


@fast
def _write(rest, place, field, cloud):  # type: ignore[no-untyped-def]
    """Write deformed position and displacement of every point, (n_points, 6)."""
    for v in range(place.shape[0]):
        first = 3 * place[v]
        x, y, z = field[first], field[first + 1], field[first + 2]
        cloud[v, 0], cloud[v, 1], cloud[v, 2] = rest[v, 0] + x, rest[v, 1] + y, rest[v, 2] + z
        cloud[v, 3], cloud[v, 4], cloud[v, 5] = x, y, z


@fast
def _interpolate(model, rest, field, cloud):  # type: ignore[no-untyped-def]
    """Write the cloud of displayed vertices from the displacement of the mesh's."""
    corner, weight = model.display.corner, model.display.weight
    for v in range(corner.shape[0]):
        a, b = 3 * corner[v, 0], 3 * corner[v, 1]
        c, e = 3 * corner[v, 2], 3 * corner[v, 3]
        wa, wb, wc, we = weight[v, 0], weight[v, 1], weight[v, 2], weight[v, 3]
        for d in range(3):
            inside = wc * field[c + d] + we * field[e + d]
            u = wa * field[a + d] + wb * field[b + d] + inside
            cloud[v, d], cloud[v, 3 + d] = rest[v, d] + u, u
