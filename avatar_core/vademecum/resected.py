"""Volumes of both parts of a resected organ, and margins of structures inside."""

from __future__ import annotations

import numpy as np

from avatar_core.geometry.point_location import closest_points
from avatar_core.vademecum.model import Vademecum


def part_volumes(v: Vademecum) -> tuple[float, float]:
    """Volumes of the parts off and on the side of the resection's normal [m^3]."""
    second = v.mesh.is_second_side
    return float(v.mesh.tet_volumes[~second].sum()), float(v.mesh.tet_volumes[second].sum())


def margins(v: Vademecum) -> dict[str, float]:
    """Least distance of each structure inside to the resection at rest [m]; 0 if it is cut."""
    if v.resection is None or v.display is None:
        return {}
    second = np.zeros(len(v.mesh.vertices), bool)
    second[v.mesh.tets[v.mesh.is_second_side]] = True
    out = {}
    for name, faces in v.structures.items():
        used = np.unique(faces)
        points = v.display.vertices[used].astype(float)
        nearest, _, _ = closest_points(v.mesh.vertices, v.mesh.cut_faces[0], points)
        side = second[v.display.corners[used, 0]]
        is_cut = bool(side.any() and not side.all())
        out[name] = 0.0 if is_cut else float(np.linalg.norm(points - nearest, axis=1).min())
    return out
