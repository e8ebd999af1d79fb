"""Between the core's arrays and ROS messages.

In the loop no message object is built: a message serialised once is a template, in which only
numbers are written over. Where they lie is not computed but looked for, by serialising messages
with marks in these places, so the templates hold for whatever serialisation the middleware uses.
Functions below "In the loop" neither allocate anything large nor raise.
"""

from __future__ import annotations

import array
import dataclasses
import math
import struct
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PoseStamped, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import Header

from avatar_ros.msg import Contact, ContactState, VademecumFile, VademecumInfo

POINT_BYTES = 24  # x y z dx dy dz, float32
_CONTACT_NUMBERS = 10  # position, normal, force, penetration
_STAMP_BYTES = 8
_UNIT_NORM_TOLERANCE = 1e-3  # of a quaternion; float32 poses keep 1e-7
_MARK = 0x5A3C_96E1_1EAD_BEEF
NO_STAMP = bytes(_STAMP_BYTES)


class LayoutError(RuntimeError):
    """The middleware's serialisation is not what a template needs."""


def find_bytes(mark: bytes, serialised: bytes) -> int:
    """Where a mark lies.

    Raises
    ------
    LayoutError : not exactly once
    """
    start = serialised.find(mark)
    if start < 0 or serialised.find(mark, start + 1) >= 0:
        raise LayoutError("a field is not stored once and in full: use rmw_fastrtps_cpp")
    return start


def find_number(message: Any, set_number: Callable[[float], None]) -> int:
    """Byte offset of the float64 that ``set_number`` sets in ``message``; raises LayoutError."""
    mark: float = struct.unpack("=d", struct.pack("=Q", _MARK))[0]
    set_number(mark)
    start = find_bytes(struct.pack("=d", mark), serialize_message(message))
    set_number(0.0)
    return start


def _find_stamp(message: Any) -> int:
    message.header.stamp.sec, message.header.stamp.nanosec = 0x5A3C96E1, 0x1EADBEEF
    start = find_bytes(struct.pack("=iI", 0x5A3C96E1, 0x1EADBEEF), serialize_message(message))
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    return start


# --- In the loop -----------------------------------------------------------------------------


class PoseReader:
    """Reads serialised PoseStamped of one frame.

    ``read`` returns a status of ContactState; after STATUS_OK ``position`` holds the tip
    [m], ``orientation`` its unit quaternion (x, y, z, w) and ``stamp`` the eight bytes of the
    time stamp.
    """

    def __init__(self, frame_id: str) -> None:
        message = PoseStamped(header=Header(frame_id=frame_id))
        pose = message.pose
        self._stamp = _find_stamp(message)
        self._numbers = find_number(message, lambda x: setattr(pose.position, "x", x))
        last = find_number(message, lambda x: setattr(pose.orientation, "w", x))
        if last != self._numbers + 48:
            raise LayoutError("a pose is not seven float64 in a row: use rmw_fastrtps_cpp")
        serialised = serialize_message(message)
        self._length = last + 8
        self._encoding = serialised[:2]
        self._frame_start = self._stamp + _STAMP_BYTES
        mark = frame_id.encode() + b"\0"
        self._frame_end = serialised.index(mark, self._frame_start) + len(mark)
        self._frame = serialised[self._frame_start : self._frame_end]
        self._unpack = struct.Struct("=7d").unpack_from
        self.position = (0.0, 0.0, 0.0)
        self.orientation = (0.0, 0.0, 0.0, 1.0)
        self.stamp = NO_STAMP

    def read(self, raw: bytes) -> int:
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


def rotation_between(
    before: tuple[float, float, float, float], now: tuple[float, float, float, float]
) -> tuple[float, float, float]:
    """Rotation vector from one orientation to another, in the frame of both [rad].

    Twice the vector part of q_now q_before*, with the sign of the shorter way: to second order
    in the angle, 4 % short at 1 rad.
    """
    a, b, c, d = before
    i, j, k, w = now
    twice = 2.0 if a * i + b * j + c * k + d * w >= 0.0 else -2.0
    return (
        twice * (d * i - w * a - j * c + k * b),
        twice * (d * j - w * b - k * a + i * c),
        twice * (d * k - w * c - i * b + j * a),
    )


def stamp_nanoseconds(stamp: bytes) -> int:
    """Time of a stamp since the epoch of its clock [ns]."""
    seconds, nanoseconds = struct.unpack("=iI", stamp)
    return int(seconds * 1_000_000_000 + nanoseconds)


def stamp_bytes(nanoseconds: int) -> bytes:
    return struct.pack("=iI", nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)


class StampedTemplate:
    """A message serialised once; each time only its stamp and its numbers are written anew."""

    def __init__(self, message: Any) -> None:
        self._stamp = _find_stamp(message)
        self._buffer = bytearray(serialize_message(message))

    def serialise(self, stamp: bytes) -> bytes:
        self._buffer[self._stamp : self._stamp + _STAMP_BYTES] = stamp
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
    """Reads serialised WrenchStamped of one frame: stamp [ns] and force [N]."""

    def __init__(self, frame_id: str) -> None:
        message = WrenchStamped(header=Header(frame_id=frame_id))
        force = message.wrench.force
        self._stamp = _find_stamp(message)
        self._start = find_number(message, lambda x: setattr(force, "x", x))
        self._unpack = struct.Struct("=3d").unpack_from

    def read(self, raw: bytes) -> tuple[int, tuple[float, ...]]:
        stamp = stamp_nanoseconds(raw[self._stamp : self._stamp + _STAMP_BYTES])
        return stamp, self._unpack(raw, self._start)


class CloudTemplate:
    """A serialised PointCloud2; ``points`` is a view of its numbers, shape (n_points, 6).

    start, stamp_start : of these numbers and of the stamp in the serialised message [byte]
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
        self._stamp = self.stamp_start = _find_stamp(message)
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
        self._buffer[self._stamp : self._stamp + _STAMP_BYTES] = stamp
        return bytes(self._buffer)


class StateTemplate:
    """A serialised ContactState with room for ``capacity`` contacts.

    ``contacts`` is a view of their numbers, shape (capacity, 10): position, normal, force,
    penetration.
    """

    def __init__(self, frame_id: str, tool: str, vademecum_id: str, capacity: int) -> None:
        message = ContactState(
            header=Header(frame_id=frame_id),
            tool=tool,
            vademecum_id=vademecum_id,
            force_error=math.nan,
        )

        def set_count(n_contacts: int) -> None:
            message.contacts = [Contact() for _ in range(n_contacts)]

        self._status = _find_byte(
            message, lambda status: setattr(message, "status", status), lambda read: read.status
        )
        # byte of the number of contacts
        least = _find_byte(message, set_count, lambda read: len(read.contacts))
        self._count = least if sys.byteorder == "little" else least - 3
        set_count(capacity)
        contact = message.contacts[0]
        self._stamp = _find_stamp(message)
        start = find_number(message, lambda x: setattr(contact.position, "x", x))
        last = find_number(message, lambda x: setattr(contact, "penetration", x))
        serialised = serialize_message(message)
        self._head = bytearray(serialised[:start])
        end = start + 8 * _CONTACT_NUMBERS * capacity
        self._tail = bytearray(serialised[end:])
        self._error = find_number(message, lambda x: setattr(message, "force_error", x)) - end
        self._share = find_number(message, lambda x: setattr(message, "force_share", x)) - end
        self._block = bytearray(8 * _CONTACT_NUMBERS * capacity)
        self.contacts = np.frombuffer(self._block, dtype=np.float64).reshape(capacity, -1)
        if last != start + 72 or not all(self._reads_back(n) for n in {0, 1, capacity}):
            raise LayoutError("contacts are not ten float64 each in a row: use rmw_fastrtps_cpp")

    def serialise(
        self,
        stamp: bytes,
        status: int,
        n_contacts: int,
        force_error: float,
        force_share: float = 1.0,
    ) -> bytes:
        head = self._head
        head[self._stamp : self._stamp + _STAMP_BYTES] = stamp
        head[self._status] = status
        head[self._count : self._count + 4] = n_contacts.to_bytes(4, sys.byteorder)
        used = 8 * _CONTACT_NUMBERS * n_contacts
        struct.pack_into("=d", self._tail, self._error, force_error)
        struct.pack_into("=d", self._tail, self._share, force_share)
        return bytes(head) + bytes(memoryview(self._block)[:used]) + bytes(self._tail)

    def _reads_back(self, n_contacts: int) -> bool:
        """A message of so many contacts means what was written; its padding may be anything."""
        self.contacts[:] = np.arange(self.contacts.size).reshape(self.contacts.shape)
        sent = self.serialise(struct.pack("=iI", 3, 4), 5, n_contacts, 0.25, 0.5)
        read = deserialize_message(sent, ContactState)
        numbers = [_contact_numbers(contact) for contact in read.contacts]
        written = self.contacts[:n_contacts].tolist()
        self.contacts[:] = 0.0
        stamp = read.header.stamp
        return (
            numbers == written
            and (stamp.sec, stamp.nanosec, read.status) == (3, 4, 5)
            and (read.force_error, read.force_share) == (0.25, 0.5)
        )


def _contact_numbers(contact: Contact) -> list[float]:
    p, n, f = contact.position, contact.normal, contact.force
    return [p.x, p.y, p.z, n.x, n.y, n.z, f.x, f.y, f.z, contact.penetration]


def _find_byte(
    message: ContactState,
    set_byte: Callable[[int], None],
    read_byte: Callable[[ContactState], int],
) -> int:
    """Byte offset of what ``set_byte`` sets: the only byte that follows it and is read again.

    Marks will not do for a small number, and one comparison neither: padding may hold anything,
    even a copy of the number.
    """
    values = (5, 3, 7, 2, 6)
    serialised = []
    for value in values:
        set_byte(value)
        serialised.append(serialize_message(message))
    follows = [i for i, held in enumerate(zip(*serialised, strict=False)) if held == values]
    set_byte(0)
    found = []
    for i in follows:
        changed = bytearray(serialised[-1])
        changed[i] = 4  # fewer than are there, so that no reader runs out of bytes
        if read_byte(deserialize_message(bytes(changed), ContactState)) == 4:
            found.append(i)
    if len(found) != 1:
        raise LayoutError("a number is not stored in one place: use rmw_fastrtps_cpp")
    return found[0]


# --- Outside the loop ------------------------------------------------------------------------


def vademecum_info(info: Any, header: Header) -> VademecumInfo:
    """The message of ``avatar_core.vademecum.model.VademecumInfo``, field by field."""
    return VademecumInfo(header=header, **dataclasses.asdict(info))


def vademecum_file(identity: str, name: str, data: bytes) -> VademecumFile:
    message = VademecumFile(id=identity, name=name)
    message.data = array.array("B", data)  # assigning bytes would check each one: 100 times slower
    return message


def surface_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Triangles in the organ frame; ``vertices`` (n, 3) [m], ``faces`` (m, 3)."""
    return Mesh(
        vertices=[Point(x=x, y=y, z=z) for x, y, z in vertices.astype(np.float64).tolist()],
        triangles=[
            MeshTriangle(vertex_indices=np.asarray(face, dtype=np.uint32)) for face in faces
        ],
    )


def mesh_arrays(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and faces (m, 3) of a message, whatever they hold."""
    n, m = len(mesh.vertices), len(mesh.triangles)
    numbers = (x for p in mesh.vertices for x in (p.x, p.y, p.z))
    corners = (corner for triangle in mesh.triangles for corner in triangle.vertex_indices)
    vertices = np.fromiter(numbers, np.float64, 3 * n)  # lists of them would take ten times more
    return vertices.reshape(n, 3), np.fromiter(corners, np.int64, 3 * m).reshape(m, 3)
