"""Serialised templates say what message objects would say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from avatar_ros.framework.state_template import StateTemplate
from avatar_ros.framework.templates import (
    CloudTemplate,
    PoseReader,
    PoseTemplate,
    WrenchReader,
    WrenchTemplate,
    stamp_bytes,
    stamp_nanoseconds,
)
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from avatar_ros.msg import ContactState

STAMP = 1_700_000_000_123_456_789
FRAMES = ("o", "organ", "patient/organ_1")  # of lengths that pad differently


def _pose(frame: str = "organ", **changed: float) -> bytes:
    numbers = {"x": 1.0, "y": -2.0, "z": 3.0, "qx": 0.0, "qy": 0.6, "qz": 0.0, "qw": 0.8}
    numbers |= changed
    header = Header(frame_id=frame)
    header.stamp.sec, header.stamp.nanosec = divmod(STAMP, 1_000_000_000)
    pose = Pose(
        position=Point(x=numbers["x"], y=numbers["y"], z=numbers["z"]),
        orientation=Quaternion(x=numbers["qx"], y=numbers["qy"], z=numbers["qz"], w=numbers["qw"]),
    )
    return serialize_message(PoseStamped(header=header, pose=pose))


@pytest.mark.parametrize("frame", FRAMES)
def test_a_pose_is_read(frame: str) -> None:
    reader = PoseReader(frame)
    assert reader.read(_pose(frame)) == ContactState.STATUS_OK
    assert reader.position == (1.0, -2.0, 3.0)
    assert stamp_nanoseconds(reader.stamp) == STAMP


@pytest.mark.parametrize(
    "changed",
    [{"x": math.nan}, {"z": math.inf}, {"qw": 0.9}, {"qy": math.nan}, {"qy": 0.0, "qw": 0.0}],
)
def test_an_impossible_pose_is_refused(changed: dict[str, float]) -> None:
    assert PoseReader("organ").read(_pose(**changed)) == ContactState.STATUS_INVALID_POSE


def test_a_pose_without_stamp_is_refused() -> None:
    unstamped = serialize_message(PoseStamped(header=Header(frame_id="organ")))
    assert PoseReader("organ").read(unstamped) == ContactState.STATUS_INVALID_POSE


@pytest.mark.parametrize("frame", ["organ2", "orga", "", "world"])
def test_a_pose_in_another_frame_is_refused(frame: str) -> None:
    assert PoseReader("organ").read(_pose(frame)) == ContactState.STATUS_UNKNOWN_FRAME


def test_a_pose_cut_anywhere_is_refused() -> None:
    whole = _pose()
    reader = PoseReader("organ")
    refused = [reader.read(whole[:n]) != ContactState.STATUS_OK for n in range(len(whole))]
    assert all(refused)


@pytest.mark.parametrize("frame", FRAMES)
def test_wrench(frame: str) -> None:
    template = WrenchTemplate(frame)
    template.force[:], template.torque[:] = (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)
    serialised = template.serialise(stamp_bytes(STAMP))
    wrench = deserialize_message(serialised, WrenchStamped)
    assert wrench.header.frame_id == frame
    assert (wrench.wrench.force.x, wrench.wrench.force.z) == (1.0, 3.0)
    assert (wrench.wrench.torque.x, wrench.wrench.torque.z) == (4.0, 6.0)
    assert WrenchReader(frame).read(serialised) == (STAMP, (1.0, 2.0, 3.0))


def test_tool_and_contact_understand_each_other() -> None:
    template, reader = PoseTemplate("organ"), PoseReader("organ")
    template.position[:] = (0.1, 0.2, 0.3)
    assert reader.read(template.serialise(stamp_bytes(STAMP))) == ContactState.STATUS_OK
    assert reader.position == (0.1, 0.2, 0.3)


@pytest.mark.parametrize("frame", FRAMES)
def test_cloud(frame: str) -> None:
    template = CloudTemplate(frame, 5)
    template.points[:] = np.arange(30).reshape(5, 6)
    cloud = deserialize_message(template.serialise(stamp_bytes(STAMP)), PointCloud2)
    assert cloud.header.frame_id == frame
    assert (cloud.width, cloud.height, cloud.point_step, cloud.row_step) == (5, 1, 24, 120)
    numbers = np.frombuffer(bytes(cloud.data), np.float32).reshape(5, 6)
    np.testing.assert_array_equal(numbers, template.points)


@pytest.mark.parametrize("n_contacts", [0, 1, 3, 64])
@pytest.mark.parametrize("identity", ["", "ab" * 32])
def test_state(n_contacts: int, identity: str) -> None:
    template = StateTemplate("organ", "tool", identity, 64)
    template.contacts[:] = np.arange(640).reshape(64, 10)
    state = deserialize_message(
        template.serialise(stamp_bytes(STAMP), 7, n_contacts, 0.125), ContactState
    )
    assert (state.tool, state.vademecum_id, state.status) == ("tool", identity, 7)
    assert [c.penetration for c in state.contacts] == [10.0 * i + 9 for i in range(n_contacts)]
    assert state.force_error == 0.125
