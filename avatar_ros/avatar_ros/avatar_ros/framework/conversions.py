"""Conversions between the core's arrays and ROS messages, outside the loop.

Conversions in the loop are in :mod:`avatar_ros.framework.templates`.
"""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import Header

from avatar_interfaces.msg import VademecumFile, VademecumInfo


def vademecum_info(info: dict[str, Any], header: Header) -> VademecumInfo:
    """Convert the fields of an ``avatar_core.vademecum.record.VademecumInfo`` to its message."""
    return VademecumInfo(header=header, **info)


def vademecum_file(identity: str, name: str, data: bytes) -> VademecumFile:
    """Return the message with the content of a vademecum file."""
    message = VademecumFile(id=identity, name=name)
    # assigning bytes would check each of them: 100 times slower
    message.data = array.array("B", data)
    return message


def surface_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return triangles in the organ frame; ``vertices`` (n, 3) [m], ``faces`` (m, 3)."""
    return Mesh(
        vertices=[Point(x=x, y=y, z=z) for x, y, z in vertices.astype(np.float64).tolist()],
        triangles=[
            MeshTriangle(vertex_indices=np.asarray(face, dtype=np.uint32)) for face in faces
        ],
    )


def mesh_arrays(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and faces (m, 3) of a message, without checking the values."""
    n, m = len(mesh.vertices), len(mesh.triangles)
    numbers = (x for p in mesh.vertices for x in (p.x, p.y, p.z))
    corners = (corner for triangle in mesh.triangles for corner in triangle.vertex_indices)
    vertices = np.fromiter(numbers, np.float64, 3 * n)  # lists would take ten times the memory
    return vertices.reshape(n, 3), np.fromiter(corners, np.int64, 3 * m).reshape(m, 3)
