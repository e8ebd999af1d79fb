"""From a bag to the tables of one tool: its poses, and their answers."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.bags import types
from avatar_core.bags.files import OpenBag
from avatar_core.bags.table import Table, TableWriter
from avatar_core.errors import StorageError
from avatar_core.scene.recording import FORMAT

POSES = "measured_cp"
WRENCHES = {"servo_cf": "absolute", "body/servo_cf": "body", "spatial/servo_cf": "spatial"}
STATES, INFOS, ABOUT = "contact_state", "vademecum_info", "recording"
_STEP = 4096  # messages from one call of ``progress`` to the next

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class About:
    """Metadata of a recording, as in :class:`avatar_core.scene.recording.Recording`."""

    vademecum_id: str
    vademecum_name: str
    scene: str
    rate: float
    from_rest: bool

    @staticmethod
    def parse(text: str) -> About | None:
        """Return the metadata from JSON; None if the text is anything else."""
        try:
            held = json.loads(text)
            if held.pop("format") != FORMAT:
                return None
            about = About(**held)
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
            return None
        texts = (about.vademecum_id, about.vademecum_name, about.scene)
        whole = all(isinstance(one, str) for one in texts) and isinstance(about.from_rest, bool)
        rate = about.rate if isinstance(about.rate, float) else 0.0
        return about if whole and 0.0 < rate < 1e6 else None

    def text(self) -> str:
        """Return the metadata as JSON."""
        return json.dumps({"format": FORMAT, **asdict(self)})


@dataclass(frozen=True, eq=False)
class Bag:
    """Contents of a bag for one tool.

    Attributes
    ----------
    tool : str
        The part of its topics' names before ``/measured_cp``.
    poses : Table
        Label: frame; values: position [m], unit quaternion x y z w.
    wrenches : Table or None
        Label: frame; values: force [N]; None if the bag has none.
    wrench : str
        Name of their topic, after the tool's; "" without any.
    axes : str
        Axes of the wrenches: "absolute", "body" or "spatial".
    states : Table or None
        Label: id of the vademecum. Values: status, force of the contacts [N], its estimated error
        [N], fraction that was sent. None if the bag has none.
    vademecum_ids : tuple[str, ...]
        Ids of vademecums that the bag names.
    about : About or None
        Metadata of the recording that was written as a bag; None in other bags.
    notes : tuple[str, ...]
        Unreadable or left-out messages, one line each.
    """

    path: Path
    tool: str
    poses: Table
    wrenches: Table | None
    wrench: str
    axes: str
    states: Table | None
    vademecum_ids: tuple[str, ...]
    about: About | None
    notes: tuple[str, ...]


def read_bag(
    path: str | Path,
    tool: str | None = None,
    progress: Progress | None = None,
    wrenches: Mapping[str, str] = WRENCHES,
) -> Bag:
    """Read one tool's messages from a bag.

    Parameters
    ----------
    path : str or Path
        Folder with metadata.yaml, .mcap or .db3.
    tool : str or None
        Beginning of its topics' names, with or without namespace; None if there is only one.
    progress : Progress or None
        Called with the number of messages read, and of all.
    wrenches : Mapping[str, str]
        Topics of a tool that are read, and their axes; the first with messages is taken.

    Raises
    ------
    StorageError
        If rosbags is not installed, nothing can be read, or the tool is missing.
    """
    path = Path(path)
    with OpenBag(path) as bag:
        chosen = _chosen_tool(bag, tool)
        topics = _Topics(bag.connections, chosen, wrenches)
        total = sum(one.msgcount for one in topics.connections)
        for n, (connection, received, content) in enumerate(bag.messages(topics.connections)):
            topics.take(connection, received, content)
            if progress is not None and n % _STEP == 0:
                progress(n, total)
        if progress is not None:
            progress(total, total)
        return topics.bag(path, bag.notes)


def _chosen_tool(bag: OpenBag, tool: str | None) -> str:
    """Return the beginning of the topics of the tool that is asked for, or of the only one."""
    tools = {
        one.topic.removesuffix(f"/{POSES}")
        for one in bag.connections
        if one.topic.endswith(f"/{POSES}") and types.full_name(one.msgtype) == types.POSE
    }
    held = ", ".join(sorted({f"{one.topic} ({one.msgtype})" for one in bag.connections}))
    if not tools:
        raise StorageError(
            f"{bag.path} has no NAME/{POSES} of {types.POSE}; it has {held or 'no topics'}"
        )
    if tool is not None:
        name = "/" + tool.strip("/")
        tools = {one for one in tools if one == name} or {
            one for one in tools if one.endswith(name)
        }
    if len(tools) != 1:
        which = "several tools" if tools else f"no tool '{tool}'"
        raise StorageError(f"{bag.path} has {which}; choose by --tool one of {held}")
    return tools.pop()


class _Topics:
    """The topics of a tool and those common to all tools, message by message."""

    def __init__(self, connections: Sequence[Any], tool: str, wrenches: Mapping[str, str]) -> None:
        self._tool, self._axes, self._store = tool, wrenches, types.typestore()
        namespace = tool.rpartition("/")[0]
        self._poses = TableWriter(7)
        self._wrenches = {f"{tool}/{name}": TableWriter(3) for name in wrenches}
        self._states: dict[str, TableWriter] = {}  # by the tool that they name
        self._ids: dict[str, None] = {}
        self._about: About | None = None
        readers: dict[str, tuple[str, Callable[[int, Any], None]]] = {
            f"{tool}/{POSES}": (types.POSE, self._take_pose),
            **{topic: (types.WRENCH, self._taker_of(topic)) for topic in self._wrenches},
            f"{namespace}/{STATES}": (types.STATE, self._take_state),
            f"{namespace}/{INFOS}": (types.INFO, self._take_info),
            f"{namespace}/{ABOUT}": (types.TEXT, self._take_about),
        }
        self.connections = []
        self._notes: list[str] = []
        self._readers = {}
        self._failed: dict[str, int] = {}
        for one in connections:
            kind, take = readers.get(one.topic, ("", None))
            if take is None:
                continue
            if types.full_name(one.msgtype) == kind:
                self.connections.append(one)
                self._readers[one.topic] = (kind, take)
            elif one.topic != f"{namespace}/{ABOUT}":  # anybody may call a topic that
                self._notes.append(f"{one.topic} is of {one.msgtype}, not {kind}: not read")

    def take(self, connection: Any, received: int, content: bytes) -> None:
        kind, take = self._readers[connection.topic]
        message = self._read(content, kind)
        if message is None and kind == types.STATE:
            message = self._read(content + b"\0", kind)  # older, without its last field, ``held``
        if message is None or not 0 <= received < 1 << 63:
            self._failed[connection.topic] = self._failed.get(connection.topic, 0) + 1
        else:
            take(received, message)

    def _read(self, content: bytes, kind: str) -> Any:
        try:
            return self._store.deserialize_cdr(content, kind)
        except Exception:  # any error that the library raises for a message of another type
            return None

    def bag(self, path: Path, notes: Sequence[str]) -> Bag:
        wrenches = {
            name: self._wrenches[f"{self._tool}/{name}"]
            for name in self._axes
            if len(self._wrenches[f"{self._tool}/{name}"])
        }
        chosen = next(iter(wrenches), None)
        states = self._states_of_tool()
        for topic, n in self._failed.items():
            self._notes.append(f"{n:,} messages of {topic} are damaged or of another version")
        back = self._set_back()
        if back:
            seconds = ", ".join(f"{1e-9 * step:.3g}" for step in back)
            self._notes.append(f"the clock was set back by {seconds} s: times of receipt go on")
        return Bag(
            path,
            self._tool,
            self._poses.table(back),
            None if chosen is None else wrenches[chosen].table(back),
            chosen or "",
            self._axes[chosen] if chosen else "absolute",
            None if states is None else states.table(back),
            tuple(self._ids),
            self._about,
            (*notes, *self._notes),
        )

    def _set_back(self) -> list[int]:
        """Return amounts by which the clock was set back [ns]; none unless all topics saw it."""
        topics = (self._poses, *self._wrenches.values(), *self._states.values())
        each = [one.set_back() for one in topics if len(one)]
        if len({len(steps) for steps in each}) != 1 or not each[0]:
            return []
        return [int(step) for step in np.median(each, axis=0)]

    def _states_of_tool(self) -> TableWriter | None:
        """Return states that name the tool, or the only ones there are.

        Remapped topics leave states with another name.
        """
        for name, states in self._states.items():
            if self._tool.endswith(f"/{name}"):
                return states
        return next(iter(self._states.values())) if len(self._states) == 1 else None

    def _take_pose(self, received: int, message: Any) -> None:
        p, q = message.pose.position, message.pose.orientation
        self._poses.add(
            received, _stamp(message), message.header.frame_id, (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        )

    def _taker_of(self, topic: str) -> Callable[[int, Any], None]:
        table = self._wrenches[topic]

        def take(received: int, message: Any) -> None:
            f = message.wrench.force
            table.add(received, _stamp(message), message.header.frame_id, (f.x, f.y, f.z))

        return take

    def _take_state(self, received: int, message: Any) -> None:
        states = self._states.setdefault(message.tool, TableWriter(6))
        x = y = z = 0.0
        for one in message.contacts:
            x, y, z = x + one.force.x, y + one.force.y, z + one.force.z
        states.add(
            received,
            _stamp(message),
            message.vademecum_id,
            (message.status, x, y, z, message.force_error, message.force_share),
        )
        self._name(message.vademecum_id)

    def _take_info(self, received: int, message: Any) -> None:
        self._name(message.id)

    def _name(self, identity: str) -> None:
        if identity and len(self._ids) < 1000:
            self._ids[identity] = None

    def _take_about(self, received: int, message: Any) -> None:
        self._about = About.parse(message.data) or self._about
        if self._about is not None:
            self._name(self._about.vademecum_id)


def _stamp(message: Any) -> int:
    """Return the stamp of a message [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
