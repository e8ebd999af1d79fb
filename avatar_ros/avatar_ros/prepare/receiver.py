"""The process that receives vademecums, verifies them and prepares their contact models.

Run as ``python -m avatar_ros.prepare.receiver`` by :class:`avatar_ros.prepare.handover.Handover`,
never by hand.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from avatar_core.errors import one_line
from avatar_ros.framework import realtime
from avatar_ros.framework.reader import Reader
from avatar_ros.prepare.budgets import Budgets, OvertakenError
from avatar_ros.prepare.orders import PACKET, Change, Order
from avatar_ros.prepare.shared_arrays import map_shared, share

_SHOWN = 80  # letters of a name from elsewhere
_LARGEST = 1 << 30  # vademecum that can be received [bytes]


class Shown(NamedTuple):
    """A model that was sent, of which plan and with which detail."""

    plan: Any
    detail: Any
    model: Any


class Receiver:
    """Verifies and prepares what comes in, and reports through a socket.

    Vademecums come in the thread of the node, changes of the order in that of :meth:`listen`. What
    is prepared is timed when it is in use, unless something waits: then that is prepared first.

    stop : true when the process is to end
    """

    def __init__(
        self, order: Order, report: socket.socket, stop: Callable[[], bool] = lambda: False
    ) -> None:
        self._order = order
        self._report = report
        self._vademecum: Any = None
        self._reader = Reader(_LARGEST)
        self._budgets = Budgets()
        self._lock = threading.Lock()
        self._stop = stop
        self._waiting: set[int] = set()  # threads

    @contextlib.contextmanager
    def _turn(self) -> Iterator[None]:
        """Who comes in ends the timing that is under way."""
        self._waiting.add(threading.get_ident())
        with self._lock:
            self._waiting.discard(threading.get_ident())
            yield

    def receive(self, message: Any) -> None:
        """Take a VademecumFile."""
        with self._turn():
            if self._vademecum is not None and message.id == self._vademecum.id:
                return  # a loader that was started again
            try:
                vademecum = _verified(message.id, bytes(message.data), self._reader)
                shown = self._hand_over(vademecum, self._order, {"number": 0, "change": {}})
            except Exception as error:  # whatever a file from elsewhere provokes, the loop goes on
                refusal = f"vademecum {message.name[:_SHOWN]!r} refused: {one_line(error)}"
                self._send({"number": 0, "refusal": refusal})
                return
            self._vademecum = vademecum
            self._time(shown)

    def listen(self) -> None:
        """Take changes of the order until the line is closed."""
        while packet := self._report.recv(PACKET):
            asked = json.loads(packet)
            with self._turn():
                try:
                    shown = self._change(asked["number"], asked["change"])
                except Exception as error:  # as above
                    self._send({"number": asked["number"], "refusal": one_line(error)})
                    continue
                if shown is not None:
                    self._time(shown)

    def _change(self, number: int, change: Change) -> Shown | None:
        """What is shown then; None without a vademecum."""
        from avatar_core.errors import SceneError

        change = _with_plain_scene(change)
        order = replace(self._order, **change)
        note = {"number": number, "change": change}
        shown = None
        if self._vademecum is not None:
            shown = self._hand_over(self._vademecum, order, note)
        elif "scene" in change:
            raise SceneError("there is no vademecum yet; load one, then the scene")
        else:
            self._send(note)
        self._order = order
        return shown

    def _hand_over(self, vademecum: Any, order: Order, note: dict[str, Any]) -> Shown:
        """Prepare a vademecum as an order says, and send it with a note."""
        from avatar_core.contact.layout import Layout
        from avatar_core.contact.model import make_model
        from avatar_core.scene.file import parse_scene
        from avatar_ros.prepare import scenes

        scene = parse_scene(order.scene, "scene") if order.scene else None
        plan = scenes.plan(vademecum, order, scene)
        detail = self._budgets.detail(plan, order)
        layout = scenes.lay_out(plan, detail, order.period)
        handle, contents = share(layout.flat())
        coordinates = vademecum.parametric.coordinates if vademecum.parametric else ()
        note |= {
            "id": vademecum.id,
            "name": vademecum.name,
            "arrays": contents,
            "ranges": {c.name: (c.low, c.high) for c in coordinates},
            "effects": plan.effect_names,
            "cloud_divisor": scene.cloud_divisor if scene else None,
        }
        try:
            # Compiles the step for these effects, if that was never done on this machine, from
            # arrays as the node will map them: it then finds the same types in numba's cache.
            model = make_model(Layout.of(map_shared(os.dup(handle), contents)), halves=True)
            note["curve"] = self._budgets.curve(plan, detail)
            self._send(note, handle)
        finally:
            os.close(handle)
        return Shown(plan, detail, model)

    def _time(self, shown: Shown) -> None:
        """Measure the times of what was sent, and send them, unless they were known."""
        with contextlib.suppress(OvertakenError):
            curve = self._budgets.times(
                *shown, overtaken=lambda: bool(self._waiting) or self._stop()
            )
            if curve is not None:
                self._send({"times": curve})

    def _send(self, note: dict[str, Any], *handles: int) -> None:
        socket.send_fds(self._report, [json.dumps(note).encode()], handles)


def _with_plain_scene(change: Change) -> Change:
    """A change whose scene is checked, and whole: no file has to be read again for it."""
    from avatar_core.scene.file import parse_scene, read_scene, write_scene

    if "scene_file" in change:
        return {"scene": write_scene(read_scene(change["scene_file"]))}
    if "scene" in change:
        return {"scene": write_scene(parse_scene(change["scene"], "yaml"))}
    return change


def _verified(identity: str, data: bytes, reader: Reader) -> Any:
    from avatar_core.vademecum import storage

    origin = "the received vademecum"
    vademecum = reader.read(origin, len(data), storage.parse_vademecum, data, origin)
    if vademecum.id != identity:
        raise ValueError("altered on the way, its checksum differs: load it again")
    return vademecum


def _listen(receiver: Receiver) -> None:
    """Until the contact node is gone; then at once, whatever is being prepared for it."""
    receiver.listen()
    os._exit(0)


def main() -> int:
    realtime.die_with_parent(signal.SIGTERM)
    realtime.release()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from avatar_ros.framework import qos
    from avatar_ros.framework.managed_node import StopSignal, spin_until
    from avatar_ros.msg import VademecumFile

    stop = StopSignal()
    report = socket.socket(fileno=os.dup(sys.stdin.fileno()))
    order = Order(**json.loads(report.recv(PACKET)))
    receiver = Receiver(order, report, lambda: bool(stop))
    threading.Thread(target=_listen, args=[receiver], name="changes", daemon=True).start()
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
