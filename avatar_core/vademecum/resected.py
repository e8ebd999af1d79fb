"""Volumes of both parts of a resected organ, and margins of structures inside."""

from __future__ import annotations

import numpy as np

from avatar_core.geometry.point_location import closest_points
from avatar_core.vademecum.model import Vademecum


def part_volumes(v: Vademecum) -> tuple[float, float]:
    """Return the volumes of the parts off and on the side of the resection's normal [m^3]."""
    second = v.mesh.is_second_side
    return float(v.mesh.tet_volumes[~second].sum()), float(v.mesh.tet_volumes[second].sum())


def margins(v: Vademecum, points: np.ndarray | None = None) -> dict[str, float]:
    """Return the least distance of each structure inside to the walls of the cut [m].

    It is 0 for a structure that is cut.

    Parameters
    ----------
    points : ndarray, shape (n, 3), optional
        Displayed vertices, moved [m]; those at rest by default.
    """
    if v.display is None or not len(v.cut_walls):
        return {}
    points = np.asarray(v.display.vertices if points is None else points, float)
    out = {}
    for name, faces in v.structures.items():
        used = np.unique(faces)
        nearest, _, _ = closest_points(points, v.cut_walls, points[used])
        side = v.mesh.on_second_side[v.display.corners[used, 0]]
        is_cut = bool(side.any() and not side.all())
        out[name] = 0.0 if is_cut else float(np.linalg.norm(points[used] - nearest, axis=1).min())
    return out
