"""The body of a tool's tip, as the planning page draws it."""

from __future__ import annotations

import numpy as np

from avatar_core.geometry.tip import Tip

_N_RINGS = 24
_N_SIDES = 32
_SHAFT = 2.0  # length of the shaft over the tip, in radii
_LENGTH, _WIDTH = 0.09, 0.5  # whole shaft: length [m], radius in radii of the tip


def tip_body(tip: Tip) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) [m] and faces (m, 3) of a tip and a piece of its shaft.

    The pose of the tip is at the origin, its shaft along z.
    """
    if tip.shape in ("sphere", "patch"):
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _N_RINGS)
        return _revolved(tip.radius * np.cos(angle), tip.radius * np.sin(angle))
    r = np.linspace(0.0, tip.radius, _N_RINGS)
    z = tip.height(r) - tip.offset
    top = z[-1] + _SHAFT * tip.radius
    return _revolved(np.append(r, [tip.radius, 0.0]), np.append(z, [top, top]))


def shaft_body(tip: Tip) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) [m] and faces (m, 3) of the shaft, without contact, along z."""
    r = _WIDTH * tip.radius * np.array([0.0, 1.0, 1.0, 0.0])
    return _revolved(r, np.array([0.0, 0.0, _LENGTH, _LENGTH]))


def _revolved(r: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface that a line of points (r, z) draws around z."""
    angle = np.linspace(0.0, 2.0 * np.pi, _N_SIDES, endpoint=False)
    vertices = np.stack(
        np.broadcast_arrays(r[:, None] * np.cos(angle), r[:, None] * np.sin(angle), z[:, None]),
        axis=2,
    )
    low = np.arange((len(r) - 1) * _N_SIDES)
    beside = low - low % _N_SIDES + (low + 1) % _N_SIDES
    high, high_beside = low + _N_SIDES, beside + _N_SIDES
    faces = [np.column_stack([low, beside, high_beside]), np.column_stack([low, high_beside, high])]
    return vertices.reshape(-1, 3), np.concatenate(faces)


def turn_to(direction: np.ndarray) -> np.ndarray:
    """Return the quaternion w x y z that turns z to a unit vector by the shortest way."""
    x, y, z = direction
    quaternion = np.array([1.0 + z, -y, x, 0.0])
    size = float(np.linalg.norm(quaternion))
    return quaternion / size if size > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])


def turned(points: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return points turned by a quaternion w x y z."""
    w, v = quaternion[0], quaternion[1:]
    return points + 2.0 * np.cross(v, np.cross(v, points) + w * points)


def along_shaft(quaternion: np.ndarray) -> np.ndarray:
    """Return the direction of z after a quaternion w x y z has turned it."""
    w, x, y, z = quaternion
    return 2.0 * np.array([x * z + w * y, y * z - w * x, 0.5 - x * x - y * y])
