"""The contact loop stepped by hand on its own clock, without any other process.

Tools read serialised poses from a queue of depth one, as the subscription's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from avatar_core.geometry.tip import Tip
from avatar_interfaces.msg import ContactState
from avatar_ros.loop import contact_loop
from avatar_ros.loop.contact_loop import ActiveModel, ContactLoop
from avatar_ros.loop.safety import Safety
from avatar_ros.loop.settings import LoopSettings
from avatar_ros.loop.tool_channel import OK, ToolChannel
from tests.helpers.contact import prepare
from tests.ros.helpers.unlimited_guard import UnlimitedGuard

SECOND = 1_000_000_000
TIP = np.array([0.0, 0.6, 0.0, 0.8])  # a unit quaternion
NOW = 1_700_000_000 * SECOND


def pose(
    position: np.ndarray, stamp: int = NOW, quaternion: np.ndarray = TIP, frame: str = "organ"
) -> bytes:
    header = Header(frame_id=frame)
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, SECOND)
    x, y, z = (float(p) for p in position)
    i, j, k, w = (float(q) for q in quaternion)
    message = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))
    return serialize_message(PoseStamped(header=header, pose=message))


class Queue:
    """Subscription of depth one, and publisher."""

    def __init__(self) -> None:
        self.handle = self
        self.waiting: bytes | None = None
        self.number = 0  # sequence number of the message that is taken next
        self.sent: list[bytes] = []

    def take_message(self, kind: type, raw: bool) -> tuple[bytes, dict[str, int]] | None:
        taken, self.waiting = self.waiting, None
        self.number += 1
        info = {"publication_sequence_number": self.number}
        return None if taken is None else (taken, info)

    def publish_raw(self, message: bytes) -> None:
        self.sent.append(message)


class SteppedLoop:
    """Loop on a clock of its own; ``now`` is in seconds since its begin."""

    def __init__(self, organ: Any, context: Any, timeout: float, n_tools: int = 1) -> None:
        names = tuple(f"tool{i}" for i in range(n_tools))
        base: dict[str, Any] = dict.fromkeys(LoopSettings.__dataclass_fields__)
        base |= {"tools": names, "tips": (Tip(),) * n_tools, "scene": "", "rate": 1000.0}
        base |= {
            "safety": Safety(leap=math.inf),
            "cloud": "off",
            "cloud_divisor": 1,
            "frame_id": "organ",
            "material": {},
        }
        self.settings = LoopSettings(**(base | {"pose_timeout": timeout}))
        self.now = 0.0
        self.poses = [Queue() for _ in names]
        self.tools = [ToolChannel(queue, queue, "organ") for queue in self.poses]
        self.state = Queue()
        outlets = SimpleNamespace(
            state=self.state, deformation=Queue(), statistics=Queue(), diagnostics=Queue()
        )
        self.loop = ContactLoop(self.settings, self.tools, outlets, context)
        self.loop.guards = [UnlimitedGuard() for _ in names]
        data = prepare(organ, (Tip("sphere", 5e-3),) * n_tools, cloud="off")
        self.loop.active = ActiveModel("a", data, self.settings)
        self.loop._used = self.loop.active  # at once, not faded in

    def step(self, *messages: bytes | None, after: float = 1e-3) -> tuple[int, np.ndarray]:
        """Return status and force of the first tool in the period after some messages."""
        for queue, message in zip(self.poses, messages, strict=False):
            queue.waiting = message if message is not None else queue.waiting
        self.now += after
        self.loop._step()
        state = deserialize_message(self.state.sent[-len(self.tools)], ContactState)
        force = deserialize_message(self.poses[0].sent[-1], WrenchStamped).wrench.force
        return state.status, np.array([force.x, force.y, force.z])

    def press(self, touch: tuple[np.ndarray, np.ndarray], depth: float) -> np.ndarray:
        """Come in from the surface, 1 mm per period; return the tip there."""
        for d in np.append(np.arange(-6e-3, depth, 1e-3), depth):
            status, _ = self.step(pose(touch[0] - d * touch[1]))
            assert status == OK
        return touch[0] - depth * touch[1]


@contextmanager
def stepped_loops(
    organ: Any, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., SteppedLoop]]:
    """Make loops of an organ; the last one sets the clock of all."""
    context = rclpy.Context()
    context.init()
    made: list[SteppedLoop] = []
    clock = SimpleNamespace(
        monotonic_ns=lambda: round(1e9 * made[-1].now) if made else 0,
        time_ns=lambda: NOW + (round(1e9 * made[-1].now) if made else 0),
    )
    monkeypatch.setattr(contact_loop, "time", clock)

    def make(timeout: float = 0.02, n_tools: int = 1) -> SteppedLoop:
        made.append(SteppedLoop(organ, context, timeout, n_tools))
        return made[-1]

    yield make
    context.try_shutdown()
