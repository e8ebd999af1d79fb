"""Bags of a simulated cell, written by rosbags and by mcap-ros2-support."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from avatar_core.contact.effects import Effect
from avatar_core.contact.status import Status
from avatar_core.contact.tool_path import push_and_slide
from avatar_core.geometry.tip import Tip
from avatar_core.haptics.force_guard import DEVICES, ForceGuard, ForceLimits
from avatar_core.vademecum.model import Vademecum
from tests.helpers.contact import prepare, solve
from tests.helpers.paths import ROOT

MESSAGES = ROOT / "avatar_ros" / "avatar_interfaces" / "msg"
PERIOD = 1_000_000  # [ns]
START = 1_700_000_000_000_000_000  # [ns]
POSE, WRENCH = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/WrenchStamped"
STATE, INFO = "avatar_interfaces/msg/ContactState", "avatar_interfaces/msg/VademecumInfo"
RADIUS = 5e-3


def own_types() -> dict[str, Any]:
    """Return the types of avatar_ros, read from its own files."""
    found: dict[str, Any] = {}
    for name in ("Contact", "ContactState", "VademecumInfo"):
        text = (MESSAGES / f"{name}.msg").read_text()
        found |= get_types_from_msg(text, f"avatar_interfaces/msg/{name}")
    return found


STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(own_types())


@dataclass(frozen=True)
class Message:
    """A message as a recorder receives it."""

    received: int
    topic: str
    kind: str
    content: Any


@dataclass
class Cell:
    """Answers of a contact loop, one entry per period; forces as computed and as sent."""

    vademecum_id: str
    stamp: np.ndarray
    tip: np.ndarray
    force: np.ndarray
    sent: np.ndarray
    share: np.ndarray
    status: np.ndarray
    orientation: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    def messages(
        self, tool: str = "/tool", frame: str = "organ", states: bool = False
    ) -> list[Message]:
        """Return poses and wrenches as a recorder would receive them, a fifth of a period apart."""
        found = []
        for k, stamp in enumerate(self.stamp.tolist()):
            head = header(stamp, frame)
            pose = make("geometry_msgs/msg/Pose", vector(self.tip[k], "Point"), self._turned(k))
            found.append(Message(stamp, f"{tool}/measured_cp", POSE, make(POSE, head, pose)))
            at = stamp + PERIOD // 5
            parts = vector(self.sent[k]), vector(np.zeros(3))
            wrench = make(WRENCH, head, make("geometry_msgs/msg/Wrench", *parts))
            found.append(Message(at, f"{tool}/servo_cf", WRENCH, wrench))
            if states:
                name = tool.rpartition("/")[2]
                found.append(Message(at, "/contact_state", STATE, self._state(k, name)))
        return found

    def _turned(self, k: int) -> Any:
        q = self.orientation[k] if len(self.orientation) else [0.0, 0.0, 0.0, 1.0]
        return vector(q, "Quaternion")

    def _state(self, k: int, tool: str) -> Any:
        """Return a state whose force two contacts divide; the second bears nothing."""
        zero = vector(np.zeros(3))
        contacts = [
            make(
                "avatar_interfaces/msg/Contact",
                vector(self.tip[k], "Point"),
                zero,
                vector(part),
                0.0,
            )
            for part in (self.force[k], np.zeros(3))
        ]
        head = header(int(self.stamp[k]), "organ")
        status, share = int(self.status[k]), float(self.share[k])
        return make(
            STATE,
            head,
            tool,
            status,
            self.vademecum_id,
            contacts[: 2 * any(self.force[k])],
            0.1,
            share,
            False,
        )


def simulated_cell(
    vademecum: Vademecum, effects: Iterable[Effect] = (), limits: ForceLimits = DEVICES["sigma"]
) -> Cell:
    """Simulate a push and a slide at 1 kHz, starting 250 ms off the organ; forces are guarded."""
    path = push_and_slide(vademecum, RADIUS, 4e-3, 3e-3, 500, 40)
    off = path[0] + 0.05 * (path[0] - path[len(path) // 2]) / np.linalg.norm(path[0] - path[250])
    tips = np.concatenate([np.repeat(off[None], 250, 0), path, np.repeat(off[None], 30, 0)])
    data = prepare(vademecum, (Tip("sphere", RADIUS),), cloud="off", effects=tuple(effects))
    guard, n = ForceGuard(limits), len(tips)
    force, sent, share = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    status = np.zeros(n, int)
    for k, tip in enumerate(tips):
        solve(data, tip[None])
        force[k], status[k] = data.out.force[0], int(data.out.status[0])
        sent[k] = force[k]
        guard.update(k * 1e-3, True, sent[k], np.zeros(3))
        share[k] = guard.sent_fraction
        if status[k] == 0 and not guard.engaged:
            status[k] = Status.ENGAGING
    stamp = START + PERIOD * np.arange(n)
    return Cell(vademecum.id, stamp, tips, force, sent, share, status)


def make(kind: str, *fields: Any) -> Any:
    return STORE.types[kind](*fields)


def vector(values: Any, kind: str = "Vector3") -> Any:
    return make(f"geometry_msgs/msg/{kind}", *(float(value) for value in values))


def header(stamp: int, frame: str) -> Any:
    time = make("builtin_interfaces/msg/Time", *divmod(stamp, 1_000_000_000))
    return make("std_msgs/msg/Header", time, frame)


def info(identity: str) -> Message:
    """Return the latched announcement of the loader."""
    fields = ["liver", "liver.obj", "1.0", "RAS", *[1] * 6, *[0.5] * 4, True, *[0.01] * 7]
    message = make(INFO, header(START, "organ"), identity, *fields)
    return Message(START, "/vademecum_info", INFO, message)


def write_rosbag(
    folder: Path,
    messages: Iterable[Message],
    plugin: str = "MCAP",
    version: Any = 9,
    compression: str = "NONE",
) -> Path:
    """Write a bag in a folder by rosbags; return the folder."""
    writer = Writer(folder, version=version, storage_plugin=StoragePlugin[plugin])
    writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        topics: dict[str, Any] = {}
        for one in messages:
            if one.topic not in topics:
                topics[one.topic] = writer.add_connection(one.topic, one.kind, typestore=STORE)
            content = STORE.serialize_cdr(one.content, one.kind)
            writer.write(topics[one.topic], one.received, content)
    return folder


def write_mcap(
    path: Path,
    messages: Iterable[Message],
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 1 << 16,
) -> Path:
    """Write an MCAP file by mcap-ros2-support."""
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=chunk_size, compression=compression)
        schemas: dict[str, Any] = {}
        for one in messages:
            if one.kind not in schemas:
                text, _ = STORE.generate_msgdef(one.kind, ros_version=2)
                schemas[one.kind] = writer.register_msgdef(one.kind, text)
            writer.write_message(
                one.topic, schemas[one.kind], _plain(one.content), log_time=one.received
            )
        writer.finish()
    return path


def _plain(message: Any) -> Any:
    """Return a message as mcap-ros2-support takes it: plain objects."""
    if hasattr(message, "__msgtype__"):
        held = {key: _plain(value) for key, value in vars(message).items()}
        return SimpleNamespace(**held)
    return [_plain(one) for one in message] if isinstance(message, list) else message


def only(messages: Iterable[Message], *endings: str) -> Iterator[Message]:
    """Select messages of the topics with these endings."""
    return (one for one in messages if one.topic.endswith(endings))


def renamed(messages: Iterable[Message], old: str, new: str) -> list[Message]:
    return [replace(one, topic=one.topic.replace(old, new)) for one in messages]
