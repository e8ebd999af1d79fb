"""Serialised templates equal message objects, and read any pose."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from avatar_interfaces.msg import ContactState
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
from avatar_ros.loop.tool_channel import OK
from tests.ros.helpers.stepped_loop import NOW, pose

STAMP = NOW + 123_456_789  # [ns]
PLACE = np.array([1.0, -2.0, 3.0])
FRAMES = ("o", "organ", "patient/organ_1")  # lengths that pad differently


@pytest.mark.parametrize("frame", FRAMES)
def test_a_pose_is_read(frame: str) -> None:
    reader = PoseReader(frame)
    assert reader.read(pose(PLACE, STAMP, frame=frame)) == OK
    assert reader.position == (1.0, -2.0, 3.0)
    assert stamp_nanoseconds(reader.stamp) == STAMP


def test_a_pose_cut_anywhere_is_refused() -> None:
    whole = pose(PLACE)
    reader = PoseReader("organ")
    refused = [reader.read(whole[:n]) != OK for n in range(len(whole))]
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
    assert reader.read(template.serialise(stamp_bytes(STAMP))) == OK
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


# --- Any pose -------------------------------------------------------------------------------------

often = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
INVALID = int(ContactState.STATUS_INVALID_POSE)
UNKNOWN_FRAME = int(ContactState.STATUS_UNKNOWN_FRAME)


@often
@given(norm=st.floats(0.0, 2.0), axis=st.tuples(*4 * [st.floats(-1.0, 1.0)]))
@example(norm=0.0, axis=(0.0, 0.0, 0.0, 1.0))
@example(norm=2.0, axis=(0.0, 0.0, 0.0, 1.0))
@example(norm=1.0, axis=(1e-200, 0.0, 0.0, 0.0))
def test_only_unit_quaternions_are_orientations(
    norm: float, axis: tuple[float, float, float, float]
) -> None:
    size = np.linalg.norm(axis)
    quaternion = norm * np.array(axis) / size if size > 1e-6 else np.zeros(4)
    found = float(np.linalg.norm(quaternion))
    if abs(abs(found - 1.0) - 1e-3) < 1e-5:
        return  # at the tolerance itself
    status = PoseReader("organ").read(pose(np.zeros(3), quaternion=quaternion))
    assert status == (OK if abs(found - 1.0) < 1e-3 else INVALID)


@often
@given(st.tuples(*7 * [st.sampled_from([0.0, 1.0, math.nan, math.inf, -math.inf, 1e308, 1e200])]))
def test_numbers_beyond_all_measure_are_refused(numbers: tuple[float, ...]) -> None:
    reader = PoseReader("organ")
    status = reader.read(pose(np.array(numbers[:3]), quaternion=np.array(numbers[3:])))
    assert status in (OK, INVALID)
    if status == OK:
        assert np.isfinite(numbers).all()
        assert sum(q * q for q in numbers[3:]) == pytest.approx(1.0, abs=3e-3)


@often
@given(st.data())
def test_no_bytes_upset_the_reader(data: st.DataObject) -> None:
    """Flipped, cut, continued or random bytes: a status, and nothing is kept unless it is OK."""
    reader, whole = PoseReader("organ"), bytearray(pose(np.array([1.0, 2.0, 3.0])))
    for place, value in data.draw(
        st.lists(st.tuples(st.integers(0, len(whole) - 1), st.integers(0, 255)), max_size=8)
    ):
        whole[place] = value
    cut = data.draw(st.integers(0, len(whole)))
    raw = data.draw(
        st.sampled_from([bytes(whole), bytes(whole[:cut]), bytes(whole[cut:]), bytes(whole) * 2])
        | st.binary(max_size=200)
    )
    status = reader.read(raw)
    assert status in (OK, INVALID, UNKNOWN_FRAME)
    if status == OK:
        assert np.isfinite(reader.position).all()
        assert len(reader.stamp) == 8
    else:
        assert reader.position == (0.0, 0.0, 0.0)
        assert stamp_nanoseconds(reader.stamp) == 0


@often
@given(
    frame=st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=40),
    tool=st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40),
    capacity=st.integers(1, 8),
)
@example(frame="\x05\x03\x07\x02", tool="\x05\x03\x07\x02", capacity=5)
@example(frame="Ω", tool="", capacity=1)
def test_state_of_any_names(frame: str, tool: str, capacity: int) -> None:
    template = StateTemplate(frame, tool, "", capacity)
    template.contacts[:] = 0.5
    raw = template.serialise(stamp_bytes(NOW), 9, capacity, 2.0)
    state = deserialize_message(raw, ContactState)
    assert (state.header.frame_id, state.tool, state.status) == (frame, tool, 9)
    assert [c.penetration for c in state.contacts] == [0.5] * capacity
    assert PoseReader(frame).read(pose(np.zeros(3), frame=frame)) == OK
    assert PoseReader(frame).read(pose(np.zeros(3), frame=frame + "x")) == UNKNOWN_FRAME
