"""A vademecum on its way into the loop's process, without the loop noticing.

Deserialising 40 MB, verifying them and preparing the contact model would each hold Python's
global lock for tens of milliseconds; compiling the step for a new selection of effects, for tens of
seconds. A process of its own does all that: it subscribes to `vademecum`, and puts the prepared
arrays into a sealed piece of shared memory, whose handle it sends through a socket. The loop's
process only maps that memory, and reads the compiled step from numba's cache.

The socket carries JSON: to the process the whole ``Order`` first, then changes of it, each with a
number; back a note for each, with what is in force from now on or why it is refused. A model is
sent as soon as it is prepared; how long its steps take is measured then, and sent after it.

Run as ``python -m avatar_ros.handover`` by ``Handover``, never by hand.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from avatar_core.errors import one_line
from avatar_ros import realtime
from avatar_ros.budgets import Budgets, OvertakenError
from avatar_ros.reader import Reader
from avatar_ros.shared_arrays import map_shared, share

if TYPE_CHECKING:
    from avatar_core.cloud_arrays import Cloud

_PACKET = 1 << 18  # the longest scene, quotes and all
_SHOWN = 80  # letters of a name from elsewhere
_LARGEST = 1 << 30  # vademecum that can be received [bytes]
_RESTART_DELAY = 1.0  # [s]
_STOP_TIMEOUT = 1.0  # [s]


@dataclass(frozen=True)
class Order:
    """What the receiving process prepares, and where it gets it.

    tip_radii, modes, cloud : without a scene; their number is that of the tools in any case
    period : of the steps [s]
    material : values by name of the coordinate; they go before those of the scene
    scene : YAML; empty for the natural effects of the vademecum
    budget : fields of an avatar_core.accuracy.Budget; empty for all modes in ordinary precision
    """

    topic: str
    node_name: str
    namespace: str
    tip_radii: tuple[float, ...]
    modes: int | None
    cloud: Cloud
    period: float
    material: dict[str, float] = field(default_factory=dict)
    scene: str = ""
    budget: dict[str, Any] = field(default_factory=dict)


Change = dict[str, Any]  # fields of an Order; or scene_file, a path, in place of scene


@dataclass(frozen=True)
class Prepared:
    """A verified vademecum's contact model as arrays in shared memory.

    ranges : lowest and highest value of each coordinate that the vademecum has
    effects : that are simulated, by name
    cloud_divisor : of the scene; None without one
    curve : the AccuracyCurve of what is shown and of fewer modes, in plain form, with NaN for times
        that were not measured yet; None: no errors were measured
    """

    id: str
    name: str
    arrays: dict[str, np.ndarray]
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    effects: tuple[str, ...] = ()
    cloud_divisor: int | None = None
    curve: dict[str, Any] | None = None


# Called with what is in use now and "", or with None and why it was refused; with None and "" if
# there is no vademecum yet, and the change waits for one.
Answer = Callable[[Prepared | None, str], None]


OVERTAKEN = "overtaken by a later one, which is tried instead"


class Handover:
    """Keeps the receiving process running and calls back with what it prepared.

    Callbacks run in a thread of this object, one at a time. Changes are passed on one by one, when
    the last is in use; of those that wait only the newest of a kind counts, so that a slider that
    is dragged fills neither time nor memory.

    on_model : called with each model that was verified and prepared; puts it into use
    on_times : called with the curve of the model in use when its times were measured
    on_refusal : called with one line when a vademecum was refused or the process ended
    """

    def __init__(
        self,
        order: Order,
        on_model: Callable[[Prepared], None],
        on_times: Callable[[dict[str, Any]], None],
        on_refusal: Callable[[str], None],
    ) -> None:
        self._order = order  # in force, for a process that is started anew
        self._on_model = on_model
        self._on_times = on_times
        self._on_refusal = on_refusal
        self._stop = threading.Event()
        self._lock = threading.Lock()  # of the four below
        self._line: socket.socket | None = None
        self._waiting: dict[str, tuple[Change, Answer]] = {}  # by kind
        self._asked: Answer | None = None
        self._number = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._supervise, name="handover", daemon=True)
        self._thread.start()

    @property
    def scene(self) -> str:
        """YAML of the scene in force; empty for the natural effects of the vademecum."""
        return self._order.scene

    def ask(self, change: Change, answer: Answer) -> None:
        """Have the vademecum prepared anew after a change of the order; returns at once.

        A change of the same kind that waits is refused as ``OVERTAKEN``, in the caller's thread.
        """
        kind = next((kind for kind in ("material", "budget") if kind in change), "scene")
        with self._lock:
            _, overtaken = self._waiting.pop(kind, (None, None))
            self._waiting[kind] = (change, answer)
        if overtaken is not None:
            overtaken(None, OVERTAKEN)
        self._pass_on()

    def _pass_on(self) -> None:
        """Send the next change, if the process is there and has answered the last."""
        with self._lock:
            if self._line is None or self._asked is not None or not self._waiting:
                return
            change, answer = self._waiting.pop(next(iter(self._waiting)))
            self._number += 1
            packet = json.dumps({"number": self._number, "change": change}, ensure_ascii=False)
            try:
                self._line.send(packet.encode(errors="replace"), socket.MSG_DONTWAIT)
            except OSError as error:
                refusal = f"not passed on ({error.strerror}); ask with less"
            else:
                self._asked, refusal = answer, ""
        if refusal:
            answer(None, refusal)
            self._pass_on()

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
                    ours.send(json.dumps(asdict(self._order)).encode())
                    self._process = _start(theirs)
                    with self._lock:
                        self._line = ours
                self._pass_on()
                with contextlib.suppress(ConnectionResetError):  # it ended with packets unread
                    self._receive(ours)
                with self._lock:
                    self._line = None
                    answer, self._asked = self._asked, None
            _end(self._process)
            if answer is not None:  # not tried again: it may be what ended the process
                answer(None, "the process that prepares models ended; ask again")
            if not self._stop.is_set():
                self._on_refusal("the process that receives vademecums ended; starting another")
                self._stop.wait(_RESTART_DELAY)
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for _, answer in waiting.values():
            answer(None, "the node was cleaned up meanwhile; configure and ask again")

    def _receive(self, ours: socket.socket) -> None:
        taken = False  # the last model that came
        while True:
            packet, handles, _, _ = socket.recv_fds(ours, _PACKET, 1)
            if not packet:
                return
            note = json.loads(packet)
            if "times" in note:
                if taken:
                    self._on_times(note["times"])
                continue
            refusal, prepared = note.get("refusal", ""), None
            if handles:
                try:
                    prepared = _prepared(note, handles[0])
                    self._on_model(prepared)
                except Exception as error:  # the node goes on with what it has
                    prepared, refusal = None, one_line(error)
                taken = prepared is not None
            if not refusal:
                self._order = replace(self._order, **note["change"])
            if note["number"] == 0:  # a vademecum came
                if refusal:
                    self._on_refusal(refusal)
                continue
            with self._lock:
                answer, self._asked = self._asked, None
            if answer is not None:
                answer(prepared, refusal)
            self._pass_on()


def _prepared(note: dict[str, Any], handle: int) -> Prepared:
    return Prepared(
        id=note["id"],
        name=note["name"],
        arrays=map_shared(handle, note["arrays"]),
        ranges=note["ranges"],
        effects=tuple(note["effects"]),
        cloud_divisor=note["cloud_divisor"],
        curve=note["curve"],
    )


def _start(theirs: socket.socket) -> subprocess.Popen[bytes]:
    environment = realtime.single_threaded_libraries(dict(os.environ))
    return subprocess.Popen(
        [sys.executable, "-m", "avatar_ros.handover"],
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


# --- The receiving process -------------------------------------------------------------------


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
        while packet := self._report.recv(_PACKET):
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
        from avatar_core.contact import make_model
        from avatar_core.contact_layout import Layout
        from avatar_core.scene_file import parse_scene
        from avatar_ros import scenes

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
    from avatar_core.scene_file import parse_scene, read_scene, write_scene

    if "scene_file" in change:
        return {"scene": write_scene(read_scene(change["scene_file"]))}
    if "scene" in change:
        return {"scene": write_scene(parse_scene(change["scene"], "yaml"))}
    return change


def _verified(identity: str, data: bytes, reader: Reader) -> Any:
    from avatar_core import storage

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

    from avatar_ros import qos
    from avatar_ros.managed_node import StopSignal, spin_until
    from avatar_ros.msg import VademecumFile

    stop = StopSignal()
    report = socket.socket(fileno=os.dup(sys.stdin.fileno()))
    order = Order(**json.loads(report.recv(_PACKET)))
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
