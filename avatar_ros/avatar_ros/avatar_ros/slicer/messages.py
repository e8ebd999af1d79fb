"""The organ and its tool as OpenIGTLink messages, in mm and RAS; the cell uses metres.

The organ's frame has the axes RAS (right, anterior, superior), as Slicer's world does.
"""

from __future__ import annotations

import numpy as np
from pyigtl import PolyDataMessage, StringMessage, TransformMessage
from scipy.spatial.transform import Rotation

# devices of messages to the program
ORGAN, DEFORMED, TOOL, CONTACT = "Organ", "OrganDeformed", "Tool", "Contact"
TARGET, BUILD = "ToolTarget", "BuildPatient"  # devices of messages from it; BUILD goes both ways

_MM = 1e3
_MOST_TEXT = 500  # longest text [characters]


def surface(device: str, points: np.ndarray, polygons: np.ndarray) -> PolyDataMessage:
    """Return triangles (:func:`polygons_of`) between points (n, 3) [m]."""
    return PolyDataMessage(points=_MM * points, polygons=polygons, device_name=device)


def polygons_of(faces: np.ndarray) -> np.ndarray:
    """Return triangles (m, 3) in VTK's order: 3 and three points for each, shape (4 m,)."""
    return np.insert(faces, 0, 3, axis=1).astype(np.uint32).ravel()


def pose(device: str, position: np.ndarray, quaternion: np.ndarray) -> TransformMessage:
    """Return a pose at a position (3,) [m] with a unit quaternion x, y, z, w."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    matrix[:3, 3] = _MM * position
    return TransformMessage(matrix, device_name=device)


def text(device: str, line: str) -> StringMessage:
    """Return a line in ASCII: pyigtl sends no other characters."""
    plain = line.encode("ascii", "replace").decode()
    return StringMessage(plain[:_MOST_TEXT], device_name=device)


def pose_of(message: TransformMessage) -> tuple[np.ndarray, np.ndarray] | None:
    """Return position [m] and unit quaternion of a transform; None if it is no rigid motion."""
    matrix = np.asarray(message.matrix, float)
    rotation, position = matrix[:3, :3], matrix[:3, 3] / _MM
    if not np.isfinite(matrix).all() or np.linalg.det(rotation) <= 0.0:
        return None
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3:
        return None
    return position, Rotation.from_matrix(rotation).as_quat()
