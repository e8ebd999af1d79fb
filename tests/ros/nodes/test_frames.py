"""Frames of the cell as tf2's listener hears them, and our builds of foreign messages."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from crtk_msgs.msg import OperatingState, StringStamped
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation
from tf2_msgs.msg import TFMessage

from avatar_interfaces.msg import ContactState
from avatar_ros.framework import qos
from avatar_ros.framework.parameters import IDENTITY
from avatar_ros.loop.safety import Safety
from avatar_ros.nodes.contact_frames import static_transforms
from tests.ros.helpers.refusals import refusal
from tests.ros.helpers.running import running

pytestmark = pytest.mark.long  # it builds an organ and starts nodes

LISTENER = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # tf2's of tf_static
# type hashes of the originals, RIHS01 (REP 2016)
HASHES = {
    OperatingState: ("5cc57eea589b217fe5194bf2735b91d4a7f2dd5ac1245ae657f7ea7590c2c80e"),
    StringStamped: ("83efb802e6596e03f69ac322e3231037329946f2bd13ed48874d97f5b8f5db1d"),
    TFMessage: "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}


def heard(probe: Any) -> dict[tuple[str, str], tuple[np.ndarray, Rotation]]:
    """Return translation and rotation, by parent and child."""
    message = probe.next(TFMessage, "/tf_static", LISTENER)
    return {(t.header.frame_id, t.child_frame_id): _pose(t) for t in message.transforms}


def _pose(transform: TransformStamped) -> tuple[np.ndarray, Rotation]:
    to, turn = transform.transform.translation, transform.transform.rotation
    return np.array([to.x, to.y, to.z]), Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])


def test_a_late_listener_learns_where_the_organ_lies(
    own_domain: dict[str, str], probe: Any
) -> None:
    with running("contact", own_domain):
        probe.next(ContactState, "contact_state", qos.state(1))  # it is active
        found = heard(probe)
    assert found.keys() == {("world", "organ")}
    position, turn = found["world", "organ"]
    assert not position.any() and turn.magnitude() == 0.0


def test_a_point_of_the_tool_is_where_the_loop_has_it(
    own_domain: dict[str, str], probe: Any
) -> None:
    """Through both transforms, as tf2 chains them; the rotation is normalised."""
    place = [0.1, -0.2, 0.3, 0.5, 0.5, 0.5, 0.5]
    values = [f"parent_transform:={place}", "parent_frame:=room", "tool_frame:=base"]
    near = [1.0, 2.0, 3.0, 0.0, 0.0, 0.70711, 0.70711]
    with running("contact", own_domain, *values, f"tool_transform:={near}"):
        found = heard(probe)
    assert found.keys() == {("room", "organ"), ("organ", "base")}
    (to, turn), (to_tool, turn_tool) = found["room", "organ"], found["organ", "base"]
    tip = np.array([0.01, 0.02, 0.03])
    organ = np.array([1.0 - 0.02, 2.0 + 0.01, 3.0 + 0.03])  # a quarter turn about z
    np.testing.assert_allclose(turn_tool.apply(tip) + to_tool, organ, atol=1e-15)
    room = np.array([organ[2] + 0.1, organ[0] - 0.2, organ[1] + 0.3])  # z to x, x to y, y to z
    np.testing.assert_allclose(turn.apply(organ) + to, room, atol=1e-15)


@pytest.mark.parametrize(
    ("organ", "tools", "parent", "frames"),
    [
        ("organ", "", "world", [("world", "organ")]),
        ("organ", "organ", "", []),
        ("world", "", "world", []),
        ("organ", "world", "world", [("organ", "world")]),
    ],
)
def test_a_frame_gets_one_parent_and_no_loop(
    organ: str, tools: str, parent: str, frames: list[tuple[str, str]]
) -> None:
    settings: Any = SimpleNamespace(
        frame_id=organ, parent_frame=parent, parent_transform=IDENTITY, safety=Safety(frame=tools)
    )
    message = static_transforms(settings, Time())
    assert [(t.header.frame_id, t.child_frame_id) for t in message.transforms] == frames


def test_a_pose_that_is_none_is_refused_in_one_line(own_domain: dict[str, str]) -> None:
    said = refusal("contact", "parent_transform:=[0.0,0.0,0.0,0.0,0.0,0.0,2.0]")
    assert "parameter parent_transform: give x y z in metres" in said and "\n" not in said


@pytest.mark.parametrize("kind", HASHES, ids=lambda kind: kind.__name__)
def test_what_we_build_of_others_matches_theirs(probe: Any, kind: type) -> None:
    """As announced: a holder of the original that compares hashes would otherwise not match."""
    topic = f"/{kind.__name__}"
    publisher = probe.node.create_publisher(kind, topic, LISTENER)
    probe.until(lambda: bool(probe.node.get_publishers_info_by_topic(topic)), 60.0)
    (end,) = probe.node.get_publishers_info_by_topic(topic)
    assert str(end.topic_type_hash) == f"RIHS01_{HASHES[kind]}"
    probe.node.destroy_publisher(publisher)
