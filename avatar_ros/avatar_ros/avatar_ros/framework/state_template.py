"""Template of ContactState, whose number of contacts changes from step to step."""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from avatar_interfaces.msg import Contact, ContactState
from avatar_ros.framework.templates import STAMP_BYTES, LayoutError, find_number, find_stamp

_CONTACT_NUMBERS = 10  # position, normal, force, penetration


class StateTemplate:
    """A serialised ContactState with room for ``capacity`` contacts.

    Attributes
    ----------
    contacts : ndarray, shape (capacity, 10)
        View of their numbers: position, normal, force, penetration.
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
        # offset of the number of contacts [bytes]
        least = _find_byte(message, set_count, lambda read: len(read.contacts))
        self._count = least if sys.byteorder == "little" else least - 3
        set_count(capacity)
        contact = message.contacts[0]
        self._stamp = find_stamp(message)
        start = find_number(message, lambda x: setattr(contact.position, "x", x))
        last = find_number(message, lambda x: setattr(contact, "penetration", x))
        serialised = serialize_message(message)
        self._head = bytearray(serialised[:start])
        end = start + 8 * _CONTACT_NUMBERS * capacity
        self._tail = bytearray(serialised[end:])
        self._error = find_number(message, lambda x: setattr(message, "force_error", x)) - end
        self._force_share = find_number(message, lambda x: setattr(message, "force_share", x)) - end
        self._held = _find_flag(message) - end
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
        held: bool = False,
    ) -> bytes:
        """Return the message with its first ``n_contacts`` contacts. Real-time safe."""
        head = self._head
        head[self._stamp : self._stamp + STAMP_BYTES] = stamp
        head[self._status] = status
        head[self._count : self._count + 4] = n_contacts.to_bytes(4, sys.byteorder)
        used = 8 * _CONTACT_NUMBERS * n_contacts
        struct.pack_into("=d", self._tail, self._error, force_error)
        struct.pack_into("=d", self._tail, self._force_share, force_share)
        self._tail[self._held] = held
        return bytes(head) + bytes(memoryview(self._block)[:used]) + bytes(self._tail)

    def _reads_back(self, n_contacts: int) -> bool:
        """Return whether the middleware reads back what was written; padding may hold any value."""
        self.contacts[:] = np.arange(self.contacts.size).reshape(self.contacts.shape)
        sent = self.serialise(struct.pack("=iI", 3, 4), 5, n_contacts, 0.25, 0.5, True)
        read = deserialize_message(sent, ContactState)
        numbers = [_contact_numbers(contact) for contact in read.contacts]
        written = self.contacts[:n_contacts].tolist()
        self.contacts[:] = 0.0
        stamp = read.header.stamp
        return (
            numbers == written
            and (stamp.sec, stamp.nanosec, read.status) == (3, 4, 5)
            and (read.force_error, read.force_share, read.held) == (0.25, 0.5, True)
        )


def _contact_numbers(contact: Contact) -> list[float]:
    p, n, f = contact.position, contact.normal, contact.force
    return [p.x, p.y, p.z, n.x, n.y, n.z, f.x, f.y, f.z, contact.penetration]


def _find_flag(message: ContactState) -> int:
    """Return the offset of ``held``: the last byte that changes with it."""
    message.held = True
    with_it = serialize_message(message)
    message.held = False
    without = serialize_message(message)
    pairs = enumerate(zip(with_it, without, strict=True))
    found = [i for i, pair in pairs if pair == (1, 0)]
    if not found:
        raise LayoutError("a truth value is not stored in a byte: use rmw_fastrtps_cpp")
    return found[-1]


def _find_byte(
    message: ContactState, set_byte: Callable[[int], None], read_byte: Callable[[ContactState], int]
) -> int:
    """Return the offset of the byte that ``set_byte`` sets, the only one that is read back.

    A small number cannot be marked, and one comparison is not enough: padding may hold anything,
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
        changed[i] = 4  # at most the present number, so that no reader runs out of bytes
        if read_byte(deserialize_message(bytes(changed), ContactState)) == 4:
            found.append(i)
    if len(found) != 1:
        raise LayoutError("a number is not stored in one place: use rmw_fastrtps_cpp")
    return found[0]
