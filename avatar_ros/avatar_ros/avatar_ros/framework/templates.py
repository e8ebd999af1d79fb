"""Messages of the loop, as bytes that were serialised once.

Building and serialising a message object costs a 1 kHz loop in Python a large part of its period. A
template is a message that is serialised once. Afterwards only its numbers are overwritten, and the
bytes are published as they are. Measured on two shared cores:

==================================  ==============  =============
message                             object          template
==================================  ==============  =============
PointCloud2, published              59 us           11 us
WrenchStamped, published            54 us           4 us
PoseStamped, taken                  41 us           2 to 5 us
==================================  ==============  =============

The constructors find the offsets of the numbers by serialising messages with marks in these
places. Templates therefore work with any serialisation of the middleware; otherwise the
constructors raise LayoutError. ``read`` and ``serialise`` are real-time safe.
"""

from __future__ import annotations

import array
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from avatar_interfaces.msg import ContactState

POINT_BYTES = 24  # x y z dx dy dz, float32
STAMP_BYTES = 8
_UNIT_NORM_TOLERANCE = 1e-3  # tolerance of a quaternion's norm; float32 poses keep 1e-7
_MARK = 0x5A3C_96E1_1EAD_BEEF
NO_STAMP = bytes(STAMP_BYTES)


class LayoutError(RuntimeError):
    """The middleware's serialisation does not suit a template."""


def find_bytes(mark: bytes, serialised: bytes) -> int:
    """Return the offset of a mark [bytes].

    Raises
    ------
    LayoutError
        If the mark does not occur exactly once.
    """
    start = serialised.find(mark)
    if start < 0 or serialised.find(mark, start + 1) >= 0:
        raise LayoutError("a field is not stored once and in full: use rmw_fastrtps_cpp")
    return start


def find_number(message: Any, set_number: Callable[[float], None]) -> int:
    """Return the offset of the float64 that ``set_number`` sets [bytes]; raise LayoutError."""
    mark: float = struct.unpack("=d", struct.pack("=Q", _MARK))[0]
    set_number(mark)
    start = find_bytes(struct.pack("=d", mark), serialize_message(message))
    set_number(0.0)
    return start


def find_stamp(message: Any) -> int:
    """Return the offset of a message's time stamp [bytes]; raise LayoutError."""
    message.header.stamp.sec, message.header.stamp.nanosec = 0x5A3C96E1, 0x1EADBEEF
    start = find_bytes(struct.pack("=iI", 0x5A3C96E1, 0x1EADBEEF), serialize_message(message))
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    return start


class PoseReader:
    """Reads serialised PoseStamped of one frame.

    Attributes
    ----------
    position : tuple of float
        Position of the tip, as read last [m].
    orientation : tuple of float
        Unit quaternion (x, y, z, w), as read last.
    stamp : bytes
        The eight bytes of the time stamp read last.
    """

    def __init__(self, frame_id: str) -> None:
        message = PoseStamped(header=Header(frame_id=frame_id))
        pose = message.pose
        self._stamp = find_stamp(message)
        self._numbers = find_number(message, lambda x: setattr(pose.position, "x", x))
        last = find_number(message, lambda x: setattr(pose.orientation, "w", x))
        if last != self._numbers + 48:
            raise LayoutError("a pose is not seven float64 in a row: use rmw_fastrtps_cpp")
        serialised = serialize_message(message)
        self._length = last + 8
        self._encoding = serialised[:2]
        self._frame_start = self._stamp + STAMP_BYTES
        mark = frame_id.encode() + b"\0"
        self._frame_end = serialised.index(mark, self._frame_start) + len(mark)
        self._frame = serialised[self._frame_start : self._frame_end]
        self._unpack = struct.Struct("=7d").unpack_from
        self.position = (0.0, 0.0, 0.0)
        self.orientation = (0.0, 0.0, 0.0, 1.0)
        self.stamp = NO_STAMP

    def read(self, raw: bytes) -> int:
        """Read a pose; return a status of ContactState. Real-time safe.

        The attributes change only with STATUS_OK.
        """
        if raw[self._frame_start : self._frame_end] != self._frame:
            return int(ContactState.STATUS_UNKNOWN_FRAME)
        stamp = raw[self._stamp : self._frame_start]
        if len(raw) < self._length or raw[:2] != self._encoding or stamp == NO_STAMP:
            return int(ContactState.STATUS_INVALID_POSE)
        x, y, z, i, j, k, w = self._unpack(raw, self._numbers)
        norm = i * i + j * j + k * k + w * w
        if not math.isfinite(x + y + z) or not abs(norm - 1.0) < 2.0 * _UNIT_NORM_TOLERANCE:
            return int(ContactState.STATUS_INVALID_POSE)
        self.position = (x, y, z)
        self.orientation = (i, j, k, w)
        self.stamp = stamp
        return int(ContactState.STATUS_OK)


def rotated(
    vector: tuple[float, float, float], orientation: tuple[float, float, float, float]
) -> tuple[float, float, float]:
    """Rotate a vector into the frame in which an orientation is given. Real-time safe."""
    x, y, z = vector
    i, j, k, w = orientation
    a, b, c = 2.0 * (j * z - k * y), 2.0 * (k * x - i * z), 2.0 * (i * y - j * x)
    return (x + w * a + j * c - k * b, y + w * b + k * a - i * c, z + w * c + i * b - j * a)


def stamp_nanoseconds(stamp: bytes) -> int:
    """Return the time of a stamp since the epoch of its clock [ns]. Real-time safe."""
    seconds, nanoseconds = struct.unpack("=iI", stamp)
    return int(seconds * 1_000_000_000 + nanoseconds)


def stamp_bytes(nanoseconds: int) -> bytes:
    """Return the stamp of a time [ns], the inverse of :func:`stamp_nanoseconds`. Real-time safe."""
    return struct.pack("=iI", nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)


class StampedTemplate:
    """A message serialised once, of which only the stamp and the numbers are overwritten."""

    def __init__(self, message: Any) -> None:
        self._stamp = find_stamp(message)
        self._buffer = bytearray(serialize_message(message))

    def serialise(self, stamp: bytes) -> bytes:
        """Return the message with this stamp and the present numbers. Real-time safe."""
        self._buffer[self._stamp : self._stamp + STAMP_BYTES] = stamp
        return bytes(self._buffer)

    def _numbers(self, start: int, count: int) -> np.ndarray:
        return np.frombuffer(self._buffer, dtype=np.float64, count=count, offset=start)


class WrenchTemplate(StampedTemplate):
    """A serialised WrenchStamped; ``force`` and ``torque`` are views of its numbers."""

    def __init__(self, frame_id: str) -> None:
        message = WrenchStamped(header=Header(frame_id=frame_id))
        wrench = message.wrench
        start = find_number(message, lambda x: setattr(wrench.force, "x", x))
        last = find_number(message, lambda x: setattr(wrench.torque, "z", x))
        if last != start + 40:
            raise LayoutError("a wrench is not six float64 in a row: use rmw_fastrtps_cpp")
        super().__init__(message)
        numbers = self._numbers(start, 6)
        self.force, self.torque = numbers[:3], numbers[3:]


class PoseTemplate(StampedTemplate):
    """A serialised PoseStamped without rotation; ``position`` is a view of its numbers."""

    def __init__(self, frame_id: str) -> None:
        message = PoseStamped(header=Header(frame_id=frame_id))
        position = message.pose.position
        start = find_number(message, lambda x: setattr(position, "x", x))
        message.pose.orientation.w = 1.0
        super().__init__(message)
        self.position = self._numbers(start, 3)


class WrenchReader:
    """Reads serialised WrenchStamped of one frame."""

    def __init__(self, frame_id: str) -> None:
        message = WrenchStamped(header=Header(frame_id=frame_id))
        force = message.wrench.force
        self._stamp = find_stamp(message)
        self._start = find_number(message, lambda x: setattr(force, "x", x))
        self._unpack = struct.Struct("=3d").unpack_from

    def read(self, raw: bytes) -> tuple[int, tuple[float, ...]]:
        """Return stamp [ns] and force [N]. Real-time safe."""
        stamp = stamp_nanoseconds(raw[self._stamp : self._stamp + STAMP_BYTES])
        return stamp, self._unpack(raw, self._start)


class CloudTemplate:
    """A serialised PointCloud2.

    Attributes
    ----------
    points : ndarray, shape (n_points, 6)
        View of its numbers.
    start, stamp_start : int
        Offsets of these numbers and of the stamp in the message [bytes].
    """

    def __init__(self, frame_id: str, n_points: int) -> None:
        names = ("x", "y", "z", "dx", "dy", "dz")
        message = PointCloud2(
            header=Header(frame_id=frame_id),
            height=1,
            width=n_points,
            fields=[
                PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
                for i, name in enumerate(names)
            ],
            point_step=POINT_BYTES,
            row_step=POINT_BYTES * n_points,
            is_dense=True,
        )
        self._stamp = self.stamp_start = find_stamp(message)
        mark = struct.pack("=QQQ", _MARK, _MARK ^ 1, _MARK ^ 2)
        data = array.array("B", bytes(POINT_BYTES * n_points))
        data[:POINT_BYTES] = array.array("B", mark)
        message.data = data
        self._buffer = bytearray(serialize_message(message))
        self.start = find_bytes(mark, bytes(self._buffer))
        self.points = np.frombuffer(
            self._buffer, dtype=np.float32, count=6 * n_points, offset=self.start
        ).reshape(n_points, 6)
        self.points[:] = 0.0

    def serialise(self, stamp: bytes) -> bytes:
        """Return the message with this stamp and the present numbers. Real-time safe."""
        self._buffer[self._stamp : self._stamp + STAMP_BYTES] = stamp
        return bytes(self._buffer)
