"""An OpenIGTLink server for one program at a time, such as 3D Slicer.

The messages are those of pyigtl (protocol: openigtlink.org, version 3). Its server is not used: it
takes the signals of the process, reads bodies of any size, and keeps a client that has left.

One thread accepts a client and reads, another writes. If several messages for one device wait, only
the newest is sent: a slow program gets fewer pictures, not old ones.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from contextlib import suppress

from pyigtl import StringMessage, TransformMessage
from pyigtl.messages import MessageBase

MAX_BODY = 1 << 16  # largest message that is read [bytes]; a transform has 48
_HEARD = {"TRANSFORM": TransformMessage, "STRING": StringMessage}  # all other messages are skipped
_VERSIONS = (1, 2)  # versions of the header; the second is that of protocol 3
_POLL = 0.2  # period of checks whether to end [s]
_CHUNK = 1 << 16
_SEND_TIMEOUT = 5.0  # time for a client that does not read, before it is dropped [s]


class LinkError(Exception):
    """Data from a client that are no OpenIGTLink."""


class Link:
    """Server that listens until :meth:`close`.

    Parameters
    ----------
    host, port : str, int
        Address to listen on; port 0: any free one.
    hear : callable
        Called with each received transform or string, in a separate thread.
    report : callable
        Called with one line when a client comes, leaves or is dropped, in a separate thread.

    Attributes
    ----------
    n_clients : int
        Number of clients that have connected so far.

    Raises
    ------
    OSError
        If the address cannot be listened to.
    """

    def __init__(
        self,
        host: str,
        port: int,
        hear: Callable[[MessageBase], None],
        report: Callable[[str], None],
    ) -> None:
        self.n_clients = 0
        self._hear, self._report = hear, report
        self._waiting: dict[str, bytes] = {}  # packed messages by device, oldest first
        self._change = threading.Condition()
        self._client: socket.socket | None = None
        self._is_closing = False
        self._listener = socket.create_server((host, port))
        self._listener.settimeout(_POLL)
        self._threads = [
            threading.Thread(target=work, name=f"OpenIGTLink, {name}", daemon=True)
            for name, work in (("in", self._accept), ("out", self._write))
        ]
        for thread in self._threads:
            thread.start()

    @property
    def port(self) -> int:
        """Return the port that it listens on."""
        return int(self._listener.getsockname()[1])

    @property
    def is_connected(self) -> bool:
        """Return whether there is a client."""
        return self._client is not None

    def send(self, message: MessageBase) -> None:
        """Queue a message, in place of a waiting one for its device; return at once."""
        if not self.is_connected:
            return
        packed = message.pack()
        with self._change:
            self._waiting.pop(message.device_name, None)
            self._waiting[message.device_name] = packed
            self._change.notify()

    def close(self) -> None:
        """Drop the client and stop listening."""
        with self._change:
            self._is_closing = True
            self._change.notify()
        self._listener.close()
        self._drop()
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        while not self._is_closing:
            try:
                client, (host, *_) = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return  # closed
            client.settimeout(_SEND_TIMEOUT)
            with self._change:
                self._waiting.clear()
                self._client, self.n_clients = client, self.n_clients + 1
            self._report(f"connected to {host}")
            self._report(self._read(client))
            self._drop()

    def _read(self, client: socket.socket) -> str:
        """Read until the client leaves; return why it ended."""
        try:
            while not self._is_closing:
                self._take(client)
        except (EOFError, ConnectionError, OSError):
            return "the program has left"
        except LinkError as error:
            return f"the program was dropped: {error}"
        return "closed"

    def _take(self, client: socket.socket) -> None:
        header = _exactly(client, MessageBase.IGTL_HEADER_SIZE)
        try:
            fields = MessageBase.parse_header(header)
            kind, size = fields["message_type"], fields["body_size"]
        except Exception as error:
            raise LinkError("it does not speak OpenIGTLink") from error
        if fields["header_version"] not in _VERSIONS:  # e.g. a website
            raise LinkError("it does not speak OpenIGTLink")
        if kind not in _HEARD:
            _skip(client, size)
            return
        if size > MAX_BODY:
            raise LinkError(f"a {kind} of {size} bytes; at most {MAX_BODY} are read")
        body = _exactly(client, size)
        message = _HEARD[kind]()
        try:
            message.unpack(fields, body)
        except Exception as error:
            raise LinkError(f"a {kind} that cannot be read") from error
        self._hear(message)

    def _write(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._waiting or self._is_closing)
                if self._is_closing:
                    return
                packed, client = self._waiting.pop(next(iter(self._waiting))), self._client
            if client is None:
                continue
            try:
                client.sendall(packed)
            except OSError:
                self._drop()

    def _drop(self) -> None:
        """Disconnect the client; its reader notices."""
        with self._change:
            client, self._client = self._client, None
            self._waiting.clear()
        if client is not None:
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            client.close()


def _exactly(client: socket.socket, size: int) -> bytes:
    """Return the next ``size`` bytes, however long they take to come."""
    received = bytearray()
    while len(received) < size:
        received += _some(client, size - len(received))
    return bytes(received)


def _skip(client: socket.socket, size: int) -> None:
    while size > 0:
        size -= len(_some(client, size))


def _some(client: socket.socket, most: int) -> bytes:
    while True:
        try:
            chunk = client.recv(min(most, _CHUNK))
        except TimeoutError:
            continue  # nothing came for a while
        if not chunk:
            raise EOFError
        return chunk
