"""A bag of a running cell, as a recorder of ROS 2 writes it, is replayed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import StoragePlugin, Writer

from avatar_core.bags.compare import comparable
from avatar_core.bags.periods import path_of
from avatar_core.bags.read import Bag, read_bag
from avatar_core.haptics.force_guard import DEVICES
from avatar_core.scene.file import write_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.replay import replay
from avatar_core.vademecum.storage import load_vademecum
from avatar_interfaces.msg import ContactState, VademecumInfo
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.framework.ports import PolledSubscriptions
from tests.core.bags.bag_files import STORE
from tests.helpers.slowness import Deadline

pytestmark = pytest.mark.long  # it builds an organ and starts nodes

SECONDS = 4  # one touch
LEAST = 200  # periods in contact that can be compared
_BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
_RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
TOPICS = {
    "/tool/measured_cp": (PoseStamped, _BEST_EFFORT),
    "/tool/servo_cf": (WrenchStamped, _RELIABLE),
    "/contact_state": (ContactState, _RELIABLE),
    "/vademecum_info": (VademecumInfo, qos.LATCHED),
}


class Recorder:
    """Recorder of messages as the middleware gives them: bytes, with their time of receipt."""

    def __init__(self, node: Any) -> None:
        group = PolledSubscriptions()
        self.taken: dict[str, list[tuple[int, bytes]]] = {topic: [] for topic in TOPICS}
        self._subscriptions = {
            topic: node.create_subscription(
                kind, topic, lambda _: None, quality, callback_group=group, raw=True
            )
            for topic, (kind, quality) in TOPICS.items()
        }

    def take(self) -> None:
        for topic, subscription in self._subscriptions.items():
            kind = TOPICS[topic][0]
            while (taken := subscription.handle.take_message(kind, True)) is not None:
                self.taken[topic].append((taken[1]["received_timestamp"], bytes(taken[0])))

    def write(self, folder: Path, plugin: str, topics: set[str]) -> Path:
        with Writer(folder, version=9, storage_plugin=StoragePlugin[plugin]) as writer:
            for topic in topics:
                kind = TOPICS[topic][0]
                name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
                connection = writer.add_connection(topic, name, typestore=STORE)
                for received, content in self.taken[topic]:
                    writer.write(connection, received, content)
        return folder

    def forget(self) -> None:
        for topic in set(TOPICS) - {"/vademecum_info"}:  # which is sent once
            self.taken[topic].clear()


@pytest.fixture(scope="module")
def recorder(
    cell: Any,
    lasting_probe: Any,
    library: Path,
    own_domain: dict[str, str],
    tmp_path_factory: pytest.TempPathFactory,
) -> Recorder:
    """Record one touch of the scripted tool; again if a busy machine lost too many periods."""
    recorder = Recorder(lasting_probe.node)
    lasting_probe.next(ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id)
    arguments, passed = [str(library / "liver.h5"), "--seconds", str(SECONDS)], Deadline(120.0)
    organ, n_known = load_vademecum(library / "liver.h5"), 0
    while n_known <= LEAST:
        recorder.forget()
        tool = Module("bench.scripted_tool", arguments, own_domain)
        while tool.poll() is None:
            assert not passed, "no touch that can be compared"
            recorder.take()
            time.sleep(1e-3)
        assert tool.finish() == 0
        bag = recorder.write(tmp_path_factory.mktemp("touch") / "bag", "MCAP", set(TOPICS))
        path, found = compared(read_bag(bag), organ)
        n_known = int((found.known & is_touching(path)).sum())
    return recorder


def compared(bag: Bag, organ: Any) -> tuple[Any, Any]:
    path = path_of(bag, write_scene(Scene()), organ.id)
    return path, comparable(path, replay(path.recording, organ), DEVICES["sigma"])


def is_touching(path: Any) -> np.ndarray:
    """Return in which periods the first tool has a force, shape (n,)."""
    touching: np.ndarray = np.linalg.norm(path.recording.periods.force[:, 0], axis=1) > 0.1
    return touching


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("states", [True, False], ids=["states", "wrenches"])
def test_a_bag_of_a_cell_is_replayed(
    plugin: str, states: bool, recorder: Recorder, library: Path, tmp_path: Path
) -> None:
    organ = load_vademecum(library / "liver.h5")
    topics = set(TOPICS) if states else set(TOPICS) - {"/contact_state"}
    bag = read_bag(recorder.write(tmp_path / "bag", plugin, topics))
    path, found = compared(bag, organ)
    size, touching = np.linalg.norm(path.recording.periods.force, axis=2), is_touching(path)
    known = found.known & touching
    print(
        f"{len(size)} periods, {touching.sum()} in contact, {known.sum()} of these known, largest "
        f"force {size.max():.2f} N, difference {found.difference(path.recording):.1e} N"
    )
    assert bag.vademecum_ids == (organ.id,) and not bag.notes
    assert path.answers == ("states" if states else "wrenches")
    assert size.max() > 0.1
    assert known.sum() > LEAST if states else found.known.any()
    assert found.difference(path.recording) <= 1e-9
