"""Parts of programs that show the organ: the newest cloud on request, triangles as a message.

There are no callbacks, so a cloud that is not shown costs no time: a viewer takes 30 of the 1,000
that arrive each second.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Vector3
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from avatar_ros.framework import qos
from avatar_ros.framework.ports import PolledSubscriptions
from avatar_ros.framework.templates import (
    NO_STAMP,
    POINT_BYTES,
    CloudTemplate,
    LayoutError,
    StampedTemplate,
    find_bytes,
    find_number,
)

RATE = 30.0  # rate of pictures [Hz]


class NewestCloud:
    """Subscribes `deformation` and returns each newest cloud once."""

    def __init__(self, node: Node, frame_id: str, n_points: int) -> None:
        template = CloudTemplate(frame_id, n_points)
        self._length = len(template.serialise(NO_STAMP))
        self._start, self._stamp, self._n_points = template.start, template.stamp_start, n_points
        self._node = node
        self._subscription = node.create_subscription(
            PointCloud2,
            "deformation",
            _never_called,
            qos.NEWEST,
            callback_group=PolledSubscriptions(),
            raw=True,
        )

    def take(self) -> tuple[bytes, np.ndarray] | None:
        """Return stamp and points (n_points, 6) float32 [m] of this organ's new cloud, or None."""
        with self._subscription.handle:
            taken = self._subscription.handle.take_message(PointCloud2, True)
        if taken is None or not 0 <= len(taken[0]) - self._length < POINT_BYTES:
            return None  # the middleware may add some bytes at the end
        raw = bytes(taken[0])
        points = np.frombuffer(raw, np.float32, 6 * self._n_points, self._start)
        return raw[self._stamp : self._stamp + len(NO_STAMP)], points.reshape(-1, 6)

    def close(self) -> None:
        """Stop listening."""
        self._node.destroy_subscription(self._subscription)


class TriangleTemplate(StampedTemplate):
    """A serialised Marker of triangles, of which only stamp, corners and colours are overwritten.

    Attributes
    ----------
    corners : ndarray, shape (3 n_triangles, 3)
        View, float64 [m].
    colours : ndarray, shape (3 n_triangles, 4)
        View, float32: red, green, blue, opacity, 0 to 1.
    """

    def __init__(self, frame_id: str, name: str, n_triangles: int) -> None:
        n = 3 * n_triangles
        points = [Point() for _ in range(n)]
        shades = [ColorRGBA() for _ in range(n)]
        message = Marker(
            header=Header(frame_id=frame_id),
            ns=name,
            type=Marker.TRIANGLE_LIST,
            action=Marker.ADD,
            scale=Vector3(x=1.0, y=1.0, z=1.0),
            color=ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0),
            points=points,
            colors=shades,
        )
        message.pose.orientation.w = 1.0
        start = find_number(message, lambda x: setattr(points[0], "x", x))
        last = find_number(message, lambda x: setattr(points[-1], "z", x))
        first_shade, last_shade = (_find_colour(message, shades[k]) for k in (0, -1))
        if last != start + 24 * n - 8 or last_shade != first_shade + 16 * (n - 1):
            raise LayoutError("triangles are not numbers in a row: use rmw_fastrtps_cpp")
        super().__init__(message)
        self.corners = self._numbers(start, 3 * n).reshape(n, 3)
        self.colours = np.frombuffer(self._buffer, np.float32, 4 * n, first_shade).reshape(n, 4)


def _find_colour(message: Marker, shade: ColorRGBA) -> int:
    """Return the offset of one of the message's colours [bytes]."""
    marks = (0.123456, 0.345678, 0.567891, 0.789123)
    shade.r, shade.g, shade.b, shade.a = marks
    start = find_bytes(struct.pack("=4f", *marks), serialize_message(message))
    shade.r, shade.g, shade.b, shade.a = 0.0, 0.0, 0.0, 0.0
    return start


def _never_called(message: Any) -> None:
    """Do nothing: clouds are taken, not delivered."""
