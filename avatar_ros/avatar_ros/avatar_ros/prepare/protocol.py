"""Packets between the contact node and the worker that prepares its models.

They travel as JSON through a SEQPACKET socket, which keeps their borders. The arrays of a model
stay
in shared memory; one file descriptor of it travels with the packet.

====================  ==================  =====================================================
sent by               packet              meaning
====================  ==================  =====================================================
node, first           PreparationRequest  what to prepare
node, then            ChangeRequest       change the request; numbered from 1
worker                ModelReady          a model, with its descriptor; number 0: of a new vademecum
worker                Accepted            the change is in force as soon as a vademecum comes
worker                Refused             why a change, or with number 0 a vademecum, is not used
====================  ==================  =====================================================
"""

from __future__ import annotations

import json
import socket
from dataclasses import asdict, dataclass, field
from typing import Any

from avatar_ros.prepare.requests import Change, PreparationRequest, PreparedModel
from avatar_ros.prepare.shared_arrays import map_shared

_MAX_BYTES = 1 << 18  # largest packet: the longest scene, with its quotes escaped [bytes]


@dataclass(frozen=True)
class ChangeRequest:
    """Packet with a numbered change of the request."""

    number: int
    change: Change


@dataclass(frozen=True)
class ModelReady:
    """Packet with a model: fields of PreparedModel; ``contents`` locates its shared arrays."""

    number: int
    change: Change
    id: str
    name: str
    contents: list[dict[str, Any]]
    ranges: dict[str, tuple[float, float]]
    effects: tuple[str, ...]
    cloud_divisor: int | None
    curve: dict[str, Any] | None
    notices: tuple[str, ...] = ()
    held: dict[str, Any] = field(default_factory=dict)

    def map(self, handle: int) -> PreparedModel:
        """Return the model with its arrays mapped into this process; close the descriptor."""
        return PreparedModel(
            self.id,
            self.name,
            map_shared(handle, self.contents),
            self.ranges,
            tuple(self.effects),
            self.cloud_divisor,
            self.curve,
            tuple(self.notices),
            self.held,
        )


@dataclass(frozen=True)
class Accepted:
    """Packet that accepts a change before there is a vademecum."""

    number: int
    change: Change


@dataclass(frozen=True)
class Refused:
    """Packet that refuses a change, or with number 0 a vademecum."""

    number: int
    reason: str


Packet = PreparationRequest | ChangeRequest | ModelReady | Accepted | Refused
_KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (PreparationRequest, ChangeRequest, ModelReady, Accepted, Refused)
}


class Channel:
    """One end of the socket."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    @staticmethod
    def pair() -> tuple[socket.socket, socket.socket]:
        """Return both ends of a new socket."""
        return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def send(self, packet: Packet, *handles: int, wait: bool = True) -> None:
        """Send a packet with file descriptors; ``wait``: wait for room in the socket.

        Raises
        ------
        OSError
            If the other end is closed, or the packet is too large or must not wait.
        """
        text = json.dumps([type(packet).__name__, asdict(packet)], ensure_ascii=False)
        flags = 0 if wait else socket.MSG_DONTWAIT
        socket.send_fds(self._end, [text.encode(errors="replace")], handles, flags)

    def receive(self) -> tuple[Packet, list[int]] | None:
        """Return the next packet and its file descriptors; None once the other end is closed."""
        data, handles, _, _ = socket.recv_fds(self._end, _MAX_BYTES, 1)
        if not data:
            return None
        kind, fields = json.loads(data)
        return _KINDS[kind](**fields), handles
