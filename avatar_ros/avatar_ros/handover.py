"""A vademecum on its way into the loop's process, without the loop noticing.

Deserialising 40 MB, verifying them and preparing the contact model would each hold Python's
global lock for tens of milliseconds. A process of its own does all three: it subscribes to
`vademecum`, and puts the prepared arrays into a sealed piece of shared memory, whose handle it
sends through a socket. The loop's process only maps that memory; nothing lies in a file system.

Run as ``python -m avatar_ros.handover JSON`` by ``Handover``, never by hand.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import mmap
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from avatar_ros import realtime

_ALIGNMENT = 64
_PACKET = 1 << 16
_RESTART_DELAY = 1.0  # [s]
_STOP_TIMEOUT = 1.0  # [s]
_SEALS = fcntl.F_SEAL_SEAL | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE


@dataclass(frozen=True)
class Order:
    """What the receiving process prepares, and where it gets it."""

    topic: str
    node_name: str
    namespace: str
    tip_radii: tuple[float, ...]
    modes: int | None
    cloud: Literal["surface", "volume", "off"]
    material: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Prepared:
    """A verified vademecum's contact model as arrays in shared memory.

    ranges : lowest and highest value of each coordinate that the vademecum has
    """

    id: str
    name: str
    arrays: dict[str, np.ndarray]
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)


class Handover:
    """Keeps the receiving process running and calls back with what it prepared.

    Both callbacks run in a thread of this object, one at a time.

    on_model : called with each vademecum that was verified and prepared
    on_refusal : called with one line when one was refused or the process ended
    """

    def __init__(
        self,
        order: Order,
        on_model: Callable[[Prepared], None],
        on_refusal: Callable[[str], None],
    ) -> None:
        self._order = order
        self._on_model = on_model
        self._on_refusal = on_refusal
        self._stop = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._line: socket.socket | None = None
        self._thread = threading.Thread(target=self._supervise, name="handover", daemon=True)
        self._thread.start()

    def choose(self, material: dict[str, float]) -> None:
        """Have the vademecum prepared anew at other values of its coordinates; returns at once."""
        self._order = replace(self._order, material=material)  # for a process that is started anew
        if self._line is not None:
            with contextlib.suppress(OSError):
                self._line.send(json.dumps(material).encode())

    def stop(self) -> None:
        """End the receiving process; returns when it has ended."""
        self._stop.set()
        process = self._process
        if process is not None:
            _end(process)
        self._thread.join(_STOP_TIMEOUT)

    def _supervise(self) -> None:
        while not self._stop.is_set():
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with ours:
                with theirs:
                    self._process = _start(self._order, theirs)
                    self._line = ours
                self._receive(ours)
                self._line = None
            _end(self._process)
            if not self._stop.is_set():
                self._on_refusal("the process that receives vademecums ended; starting another")
                self._stop.wait(_RESTART_DELAY)

    def _receive(self, ours: socket.socket) -> None:
        while True:
            packet, handles, _, _ = socket.recv_fds(ours, _PACKET, 1)
            if not packet:
                return
            note = json.loads(packet)
            if handles:
                arrays = _map(handles[0], note["arrays"])
                self._on_model(Prepared(note["id"], note["name"], arrays, note["ranges"]))
            else:
                self._on_refusal(note["refusal"])


def _start(order: Order, theirs: socket.socket) -> subprocess.Popen[bytes]:
    environment = realtime.single_threaded_libraries(dict(os.environ))
    return subprocess.Popen(
        [sys.executable, "-m", "avatar_ros.handover", json.dumps(asdict(order))],
        stdin=theirs.fileno(),
        env=environment,
        cwd="/",  # -m would let whatever lies where the node was started stand first
        start_new_session=True,  # Ctrl-C is for the node, which then ends this one
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


# --- Arrays in shared memory -----------------------------------------------------------------


def share(arrays: dict[str, np.ndarray]) -> tuple[int, list[dict[str, Any]]]:
    """Copy arrays into sealed anonymous shared memory; returns its handle and a table of contents.

    Sealed: neither side can change or shorten it afterwards, so a fault in one cannot reach the
    other through it.
    """
    contents = []
    end = 0
    for name, values in arrays.items():
        start = -(-end // _ALIGNMENT) * _ALIGNMENT
        end = start + values.nbytes
        contents.append(
            {"name": name, "start": start, "shape": values.shape, "dtype": values.dtype.str}
        )
    handle = os.memfd_create("avatar-model", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(handle, max(end, 1))
    with mmap.mmap(handle, max(end, 1)) as memory:
        for entry, values in zip(contents, arrays.values(), strict=True):
            _view(memory, entry)[...] = values
    fcntl.fcntl(handle, fcntl.F_ADD_SEALS, _SEALS)
    return handle, contents


def _map(handle: int, contents: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Map shared arrays, private to this process, with all pages present; closes the handle."""
    try:
        # Writable, but a private copy: jitted code compiled for ordinary arrays accepts it.
        memory = mmap.mmap(handle, 0, mmap.MAP_PRIVATE, mmap.PROT_READ | mmap.PROT_WRITE)
    finally:
        os.close(handle)
    realtime.bring_into_memory(np.frombuffer(memory, dtype=np.uint8))
    return {entry["name"]: _view(memory, entry) for entry in contents}


def _view(memory: mmap.mmap, entry: dict[str, Any]) -> np.ndarray:
    return np.ndarray(tuple(entry["shape"]), entry["dtype"], memory, entry["start"])


# --- The receiving process -------------------------------------------------------------------


class Receiver:
    """Verifies and prepares what comes in, and reports through a socket.

    Vademecums come in the thread of the node, values of the material in that of :meth:`listen`.
    """

    def __init__(self, order: Order, report: socket.socket) -> None:
        self._order = order
        self._report = report
        self._vademecum: Any = None
        self._lock = threading.Lock()

    def receive(self, message: Any) -> None:
        """Take a VademecumFile."""
        with self._lock:
            if self._vademecum is not None and message.id == self._vademecum.id:
                return  # a loader that was started again
            try:
                vademecum = _verified(message.id, memoryview(message.data))
                self._hand_over(vademecum)
            except Exception as error:  # whatever a file from elsewhere provokes, the loop goes on
                self._refuse(f"vademecum {message.name!r} refused", error)
                return
            self._vademecum = vademecum

    def listen(self) -> None:
        """Take values of the material until the line is closed."""
        while packet := self._report.recv(_PACKET):
            with self._lock:
                before = self._order
                self._order = replace(self._order, material=json.loads(packet))
                if self._vademecum is None:
                    continue
                try:
                    self._hand_over(self._vademecum)
                except Exception as error:  # as above
                    self._order = before
                    self._refuse("material refused", error)

    def _hand_over(self, vademecum: Any) -> None:
        """Prepare a vademecum at the values in force, and send it."""
        from avatar_core import contact
        from avatar_core.parametric import at_values

        order = self._order
        coordinates = vademecum.parametric.coordinates if vademecum.parametric else ()
        chosen = at_values(vademecum, order.material)
        arrays = contact.model_arrays(chosen, tuple(order.tip_radii), order.modes, order.cloud)
        handle, contents = share(dict(arrays._asdict()))
        note = {
            "id": vademecum.id,
            "name": vademecum.name,
            "arrays": contents,
            "ranges": {c.name: (c.low, c.high) for c in coordinates},
        }
        try:
            self._send(note, handle)
        finally:
            os.close(handle)

    def _refuse(self, what: str, error: Exception) -> None:
        reason = " ".join(str(error).split()) or type(error).__name__
        self._send({"refusal": f"{what}: {reason}"})

    def _send(self, note: dict[str, Any], *handles: int) -> None:
        socket.send_fds(self._report, [json.dumps(note).encode()], handles)


def _verified(identity: str, data: memoryview) -> Any:
    from avatar_core import storage

    vademecum = storage.parse_vademecum(data, "the received vademecum")
    if vademecum.id != identity:
        raise ValueError("altered on the way, its checksum differs: load it again")
    return vademecum


def main() -> int:
    realtime.die_with_parent(signal.SIGTERM)
    realtime.release()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from avatar_ros import qos
    from avatar_ros.managed_node import StopSignal, spin_until
    from avatar_ros.msg import VademecumFile

    stop = StopSignal()
    order = Order(**json.loads(sys.argv[1]))
    report = socket.socket(fileno=os.dup(sys.stdin.fileno()))
    receiver = Receiver(order, report)
    threading.Thread(target=receiver.listen, name="material", daemon=True).start()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(
        order.node_name,
        namespace=order.namespace,
        start_parameter_services=False,
        enable_rosout=False,
    )
    node.create_subscription(
        VademecumFile,
        order.topic,
        receiver.receive,
        qos.LATCHED,
    )
    with contextlib.suppress(BrokenPipeError):  # the contact node is gone
        spin_until(stop, node)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
