"""Worker process that receives vademecums, verifies them and prepares their contact models.

Run as ``python -m avatar_ros.prepare.worker`` by
:class:`avatar_ros.prepare.supplier.ModelSupplier`, never by hand.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from dataclasses import replace
from typing import Any

from avatar_core.common.confined import Imported
from avatar_core.common.processes import return_memory
from avatar_core.errors import one_line
from avatar_ros.framework import realtime
from avatar_ros.framework.reader import Reader
from avatar_ros.prepare.bands import BandPreparer
from avatar_ros.prepare.protocol import (
    Accepted,
    ChangeRequest,
    Channel,
    ModelReady,
    Packet,
    Refused,
)
from avatar_ros.prepare.requests import Change, PreparationRequest
from avatar_ros.prepare.shared_arrays import map_shared, write_shared

_MAX_NAME = 80  # longest part of a foreign name that is quoted [characters]
_MAX_BYTES = 1 << 30  # largest vademecum that can be received [bytes]
_PARSE = Imported("avatar_core.vademecum.storage", "parse_vademecum")


class ModelPreparer:
    """Verifies and prepares received vademecums, and reports through a socket.

    Vademecums come in the thread of the node, changes of the request in that of :meth:`listen`.
    """

    def __init__(self, request: PreparationRequest, channel: Channel) -> None:
        self._request = request
        self._channel = channel
        self._vademecum: Any = None
        self._reader = Reader(_MAX_BYTES)
        self._bands = BandPreparer()
        self._lock = threading.Lock()

    def expect(self) -> None:
        """Start the verifying process before a vademecum comes; return at once."""
        loads = threading.Thread(target=self._reader.load, args=[_PARSE], daemon=True)
        loads.start()

    def receive(self, message: Any) -> None:
        """Take a VademecumFile."""
        with self._lock:
            if self._vademecum is not None and message.id == self._vademecum.id:
                return  # announced again by a restarted loader
            threading.Thread(target=_import_libraries, name="imports", daemon=True).start()
            try:
                vademecum = _verified(message.id, bytes(message.data), self._reader)
                self._prepare(vademecum, self._request, 0, {})
            except Exception as error:  # whatever an untrusted file provokes
                self._send_refused(message, one_line(error))
                return
            self._vademecum = vademecum
            return_memory()

    def refuse(self, message: Any, reason: str) -> None:
        """Report a VademecumFile that is not taken, unless it is in use."""
        if self._vademecum is None or message.id != self._vademecum.id:
            self._send_refused(message, reason)

    def listen(self) -> None:
        """Take changes of the request until the socket is closed."""
        while received := self._channel.receive():
            asked, _ = received
            assert isinstance(asked, ChangeRequest)
            with self._lock:
                try:
                    self._change(asked.number, asked.change)
                except Exception as error:  # as above
                    self._send(Refused(asked.number, one_line(error)))

    def _change(self, number: int, change: Change) -> None:
        """Send the model for a change; without a vademecum, that it is accepted."""
        from avatar_core.errors import SceneError

        change = _with_scene_text(change)
        request = replace(self._request, **change)
        if self._vademecum is not None:
            self._prepare(self._vademecum, request, number, change)
        elif "scene" in change:
            raise SceneError("there is no vademecum yet; load one, then the scene")
        else:
            self._send(Accepted(number, change))
        self._request = request

    def _prepare(
        self, vademecum: Any, request: PreparationRequest, number: int, change: Change
    ) -> None:
        """Prepare the model of a vademecum that a request asks for, and send it."""
        from avatar_core.common.array_table import flat, gathered
        from avatar_core.contact.force_band import ForceBand
        from avatar_core.contact.layout import MODEL
        from avatar_core.contact.model import ContactModel
        from avatar_core.scene.file import parse_scene
        from avatar_ros.prepare.scenes import model_spec, usable_material

        scene = parse_scene(request.scene, "scene") if request.scene else None
        material, notices = usable_material(vademecum, request.material)
        spec = model_spec(vademecum, replace(request, material=material), scene)
        held, bands, unused = self._bands.prepare(spec, request.uncertainty)
        handle, contents = write_shared(flat(spec.layout(spec.finest, request.period)) | bands)
        try:
            # compiles the step, if that was never done on this machine: the node then finds it in
            # numba's cache
            arrays = map_shared(os.dup(handle), contents)
            ForceBand.of(ContactModel(gathered(MODEL, arrays)).data(), arrays)
            ready = ModelReady(
                number,
                change,
                id=vademecum.id,
                name=vademecum.name,
                contents=contents,
                ranges=vademecum.ranges,
                effects=spec.effect_names,
                cloud_divisor=scene.cloud_divisor if scene else None,
                curve=spec.curve.plain() if spec.curve else None,
                notices=notices + unused,
                held=held,
            )
            self._send(ready, handle)
        finally:
            os.close(handle)

    def _send_refused(self, message: Any, reason: str) -> None:
        self._send(Refused(0, f"vademecum {message.name[:_MAX_NAME]!r} refused: {reason}"))

    def _send(self, packet: Packet, *handles: int) -> None:
        self._channel.send(packet, *handles)


def _with_scene_text(change: Change) -> Change:
    """Return the change with its scene checked and complete, so that no file is read again."""
    from avatar_core.scene.file import parse_scene, read_scene, write_scene

    if "scene_file" in change:
        return {"scene": write_scene(read_scene(change["scene_file"]))}
    if "scene" in change:
        return {"scene": write_scene(parse_scene(change["scene"], "yaml"))}
    return change


def _verified(identity: str, data: bytes, reader: Reader) -> Any:
    origin = "the received vademecum"
    vademecum = reader.read(origin, len(data), _PARSE, data, origin)
    if vademecum.id != identity:
        raise ValueError("altered in transport, its checksum differs: load it again")
    return vademecum


def _import_libraries() -> None:
    """Import the libraries while another process verifies; not before, to save memory."""
    from avatar_core.common.jit import load_compiler
    from avatar_core.contact import model  # noqa: F401
    from avatar_ros.prepare import scenes  # noqa: F401

    load_compiler()


def _listen(preparer: ModelPreparer) -> None:
    """Listen until the contact node is gone; then end at once, even while preparing."""
    preparer.listen()
    os._exit(0)


def main() -> int:
    """Serve as the worker process; return the exit code."""
    realtime.die_with_parent(signal.SIGTERM)
    realtime.release()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from avatar_interfaces.msg import VademecumFile
    from avatar_ros.framework.announced import Announced
    from avatar_ros.framework.managed_node import spin_until
    from avatar_ros.framework.stop_signal import StopSignal

    stop = StopSignal()
    channel = Channel(socket.socket(fileno=os.dup(sys.stdin.fileno())))
    received = channel.receive()
    if received is None:  # the contact node is gone
        return 0
    request, _ = received
    assert isinstance(request, PreparationRequest)
    preparer = ModelPreparer(request, channel)
    preparer.expect()
    threading.Thread(target=_listen, args=[preparer], name="changes", daemon=True).start()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(
        request.node_name,
        namespace=request.namespace,
        start_parameter_services=False,
        enable_rosout=False,
    )
    Announced(node, VademecumFile, request.topic, preparer.receive, preparer.refuse)
    with contextlib.suppress(BrokenPipeError):  # the contact node is gone
        spin_until(stop, node)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
