"""The way of a tool to another place: straight, or off the organ, around it, and down again."""

from __future__ import annotations

import numpy as np

from avatar_ros.ui.view.measuring import hit, is_within
from avatar_ros.ui.view.organ import Organ

LIFT = 0.03  # height off the organ [m]
_NEAR = 0.01  # distance of a place to which a tool goes straight, if need be through tissue [m]
_AROUND = 0.02  # height over the sphere around the organ [m]
# angle between two points of the arc, so that its chord stays off the organ
_TURN = np.radians(30.0)


def way_to(organ: Organ, here: np.ndarray, there: np.ndarray) -> list[np.ndarray]:
    """Return the points to pass from one place to another, ending there; each of shape (3,) [m].

    If the other place is near, or no tissue lies between, it is the only point.
    """
    if np.linalg.norm(there - here) < _NEAR or not _crosses(organ, here, there):
        return [there]
    return way_around(organ, here, there, organ.outward(there))


def way_around(
    organ: Organ, here: np.ndarray, there: np.ndarray, normal: np.ndarray
) -> list[np.ndarray]:
    """Return a way as :func:`way_to`, but off the organ and down again in any case.

    normal : surface normal at the other place
    """
    up, down = organ.lifted(here, LIFT), there + LIFT * normal
    if not _crosses(organ, up, down):
        return [up, down, there]
    first, last = up - organ.centre, down - organ.centre
    radius = float(np.linalg.norm(organ.vertices - organ.centre, axis=1).max()) + _AROUND
    radius = max(radius, float(np.linalg.norm(first)), float(np.linalg.norm(last)))
    first, last = first / np.linalg.norm(first), last / np.linalg.norm(last)
    side = last - (last @ first) * first
    if np.linalg.norm(side) < 1e-6:  # opposite: any way around
        side = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    side /= np.linalg.norm(side)
    angle = float(np.arccos(np.clip(first @ last, -1.0, 1.0)))
    turns = np.linspace(0.0, angle, int(np.ceil(angle / _TURN)) + 1)
    arc = [organ.centre + radius * (np.cos(t) * first + np.sin(t) * side) for t in turns]
    return [up, *arc, down, there]


def _crosses(organ: Organ, begin: np.ndarray, end: np.ndarray) -> bool:
    """Return whether the straight way passes through the organ at rest."""
    way, vertices = end - begin, organ.vertices
    met = hit(begin, way, vertices, organ.faces)
    if met is None:
        return False
    length = np.linalg.norm(met.at(vertices) - begin)
    return bool(length < np.linalg.norm(way)) or is_within(met, way, vertices)
