"""3D Slicer next to the cell: the organ at rest and deformed, the tool, and patients to build.

Needs the extra ``slicer``. Slicer's module OpenIGTLinkIF connects to it as a client.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from shape_msgs.msg import Mesh

from avatar_core.geometry.tip import MAX_TOOLS
from avatar_interfaces.action import BuildPatient
from avatar_interfaces.msg import ContactState, VademecumInfo
from avatar_ros.framework import qos
from avatar_ros.framework.announced import Announced
from avatar_ros.framework.conversions import mesh_arrays
from avatar_ros.framework.managed_node import ManagedNode, run
from avatar_ros.framework.parameters import AUTOSTART, Parameter
from avatar_ros.framework.ports import PolledSubscriptions
from avatar_ros.loop.statuses import explanation
from avatar_ros.ui.session.requests import Requests, Wanted
from avatar_ros.ui.view.display import NewestCloud

try:
    from avatar_ros.slicer import messages
    from avatar_ros.slicer.follower import Follower
    from avatar_ros.slicer.link import Link
except ImportError as error:
    raise SystemExit("slicer_bridge: pyigtl is missing; pip install '.[slicer]'") from error

_DRIVE_PERIOD = 5e-3  # period of the tool's poses while a program moves it [s]
_FIDELITIES = ("interpolated", "reduced", "solved")

SLICER_BRIDGE = (
    AUTOSTART,
    Parameter("host", "127.0.0.1", "address to listen on; 0.0.0.0: all, without any protection"),
    Parameter("port", 18944, "port to listen on, Slicer's default", range=(1, 65535)),
    Parameter("rate", 10.0, "largest rate of messages to Slicer [Hz]", range=(0.1, 30.0)),
    Parameter("tool", "tool", "name of the tool that is shown and moved"),
)


class SlicerBridge(ManagedNode):
    """Sends the cell's data at display rate, and moves the tool by the received poses."""

    def __init__(self) -> None:
        self._link: Link | None = None
        self._follower = Follower()
        # requests to build patients, as they were written
        self._asked: deque[str] = deque(maxlen=8)
        self._requests: Requests | None = None
        self._announced: list[Announced] = []
        self._own_subscriptions: list[Any] = []
        self._timer: Any = None
        self._drive: Any = None  # publisher and timer, while a program moves the tool
        self._frame = ""
        self._surface: tuple[np.ndarray, np.ndarray] | None = None  # vertices [m], polygons
        self._cloud: NewestCloud | None = None
        self._client = 0  # client to which the organ at rest was sent
        super().__init__("slicer_bridge", SLICER_BRIDGE)

    def configure(self) -> None:
        """Listen for Slicer, and subscribe the cell's topics."""
        tool = self.get_parameter("tool").value
        host, port = (self.get_parameter(name).value for name in ("host", "port"))
        try:
            self._link = Link(host, port, self._hear, self.get_logger().info)
        except OSError as error:
            raise OSError(
                f"cannot listen on {host}:{port} ({error}); choose another port"
            ) from error
        self._requests = Requests(self)
        polled = PolledSubscriptions()
        self._announced = [
            Announced(self, VademecumInfo, "vademecum_info", self._take_frame),
            Announced(self, Mesh, "rest_surface", self._take_surface),
        ]
        self._own_subscriptions = [
            self.create_subscription(kind, topic, _never_called, quality, callback_group=polled)
            for kind, topic, quality in (
                (PoseStamped, f"{tool}/measured_cp", qos.NEWEST),
                (ContactState, "contact_state", qos.state(MAX_TOOLS)),
            )
        ]
        self.get_logger().info(f"3D Slicer may connect to {host}:{port}, in OpenIGTLinkIF")

    def activate(self) -> None:
        """Start to send."""
        self._timer = self.create_timer(1.0 / self.get_parameter("rate").value, self._exchange)

    def deactivate(self) -> None:
        """Stop sending and moving the tool."""
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        self._stop_driving()

    def clean_up(self) -> None:
        """Close the connection and remove all topics."""
        if self._link is not None:
            self._link.close()
            self._link = None
        if self._requests is not None:
            self._requests.close()
            self._requests = None
        for subscription in self._own_subscriptions:
            self.destroy_subscription(subscription)
        for announced in self._announced:
            announced.close()
        self._announced, self._own_subscriptions = [], []
        self._forget()
        self._frame, self._surface = "", None

    def _forget(self) -> None:
        if self._cloud is not None:
            self._cloud.close()
        self._cloud, self._client = None, 0

    # --- from the cell ----------------------------------------------------------------------------

    def _take_frame(self, info: VademecumInfo) -> None:
        self._frame = info.header.frame_id
        self._lay_out()

    def _take_surface(self, surface: Mesh) -> None:
        vertices, faces = mesh_arrays(surface)
        self._surface = vertices, messages.polygons_of(faces)
        self._lay_out()

    def _lay_out(self) -> None:
        """Lay out the surface once mesh and frame have arrived, in either order."""
        if self._frame and self._surface is not None:
            self._forget()
            self._cloud = NewestCloud(self, self._frame, len(self._surface[0]))

    def _exchange(self) -> None:
        """Send new data, and handle received messages."""
        link = self._link
        if link is None or not link.is_connected:
            self._stop_driving()
            return
        if self._surface is not None and self._client != link.n_clients:
            self._client = link.n_clients
            link.send(messages.surface(messages.ORGAN, *self._surface))
            link.send(messages.surface(messages.DEFORMED, *self._surface))
        taken = self._cloud.take() if self._cloud is not None else None
        if taken is not None and self._surface is not None:
            points = taken[1][:, :3]
            link.send(messages.surface(messages.DEFORMED, points, self._surface[1]))
        self._send_tool(link)
        if self._frame and self._follower.has_target and self._drive is None:
            self._start_driving()
        while self._asked:
            self._build(self._asked.popleft())

    def _send_tool(self, link: Link) -> None:
        """Send pose and force of the tool."""
        tool = self.get_parameter("tool").value
        poses, states = map(_waiting, self._own_subscriptions)
        pose = poses[-1] if poses else None
        if pose is not None and pose.header.frame_id != self._frame:
            self.get_logger().warning(
                f"poses of {tool} come in {pose.header.frame_id!r}: Slicer does not get them, only "
                f"poses in {self._frame!r}",
                once=True,
            )
        elif pose is not None:
            p, q = pose.pose.position, pose.pose.orientation
            place = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
            link.send(messages.pose(messages.TOOL, *place))
        own = [state for state in states if state.tool == tool]  # all tools share the topic
        if own:
            link.send(messages.text(messages.CONTACT, _line_of(own[-1])))

    # --- from the program -------------------------------------------------------------------------

    def _hear(self, message: Any) -> None:
        """Note a message; called in the link's thread."""
        if message.device_name == messages.TARGET and message.message_type == "TRANSFORM":
            pose = messages.pose_of(message)
            if pose is not None:
                self._follower.follow(*pose, time.monotonic())
        elif message.device_name == messages.BUILD and message.message_type == "STRING":
            self._asked.append(message.string)

    def _start_driving(self) -> None:
        tool = self.get_parameter("tool").value
        publisher = self.create_publisher(PoseStamped, f"{tool}/measured_cp", qos.NEWEST)

        def move() -> None:
            pose = PoseStamped()
            pose.header.frame_id = self._frame
            pose.header.stamp = self.get_clock().now().to_msg()
            position, quaternion = self._follower.at(time.monotonic())
            for part, values in (
                (pose.pose.position, zip("xyz", position, strict=True)),
                (pose.pose.orientation, zip("xyzw", quaternion, strict=True)),
            ):
                for name, value in values:
                    setattr(part, name, float(value))
            publisher.publish(pose)

        self._drive = publisher, self.create_timer(_DRIVE_PERIOD, move)

    def _stop_driving(self) -> None:
        """Release the tool; the contact node fades its force out."""
        if self._drive is not None:
            publisher, timer = self._drive
            self.destroy_timer(timer)
            self.destroy_publisher(publisher)
            self._drive = None
        self._follower.stop()

    def _build(self, asked: str) -> None:
        """Build a patient from ``FILE [FIDELITY]``, and load it."""
        words = asked.split()
        fidelity = words.pop() if len(words) > 1 and words[-1] in _FIDELITIES else ""
        file = " ".join(words)
        if not file:
            self._say("write a file of the library and, after it, one of " + ", ".join(_FIDELITIES))
            return
        assert self._requests is not None
        self._requests.build_patient(
            Wanted(file, fidelity=fidelity), self._say_stage, self._say, self._load_patient
        )

    def _load_patient(self, result: BuildPatient.Result | None) -> None:
        if result is not None and self._requests is not None:
            self._requests.load_vademecum(result.file, self._say)

    def _say_stage(self, stage: str, fraction: float, error: float) -> None:
        self._say(f"{stage} {fraction:.0%}")

    def _say(self, line: str) -> None:
        if self._link is not None:
            self._link.send(messages.text(messages.BUILD, line))


def _waiting(subscription: Any) -> list[Any]:
    """Return the messages that wait at a polled subscription, oldest first."""
    found = []
    with subscription.handle:
        while taken := subscription.handle.take_message(subscription.msg_type, False):
            found.append(taken[0])
    return found


def _line_of(state: ContactState) -> str:
    """Return the force on the tool with its error, or why there is none."""
    reason = explanation(state.status)
    if reason:
        return reason
    forces = np.array([(c.force.x, c.force.y, c.force.z) for c in state.contacts]).reshape(-1, 3)
    line = f"{np.linalg.norm(forces.sum(axis=0)):.2f} N"
    if np.isfinite(state.force_error) and len(forces):
        line += f" +- {state.force_error:.2f} N"
    if state.force_share < 1.0 and len(forces):
        line += f", the device gets {state.force_share:.0%}"
    return line


def _never_called(message: Any) -> None:
    """Do nothing: messages are taken, not delivered."""


def main() -> int:
    """Run the node; return the exit code."""
    return run(SlicerBridge)


if __name__ == "__main__":
    raise SystemExit(main())
