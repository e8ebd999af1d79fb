"""The jaw of a tool, read from its driver's joint states, without any process."""

from __future__ import annotations

import math
from typing import Any

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from avatar_ros.framework.parameters import ParameterError
from avatar_ros.loop.jaw import JawChannel, JointReader, chosen_jaw


class Driver:
    """The other end of the topic."""

    def __init__(self) -> None:
        self.handle, self.sent = self, list[bytes]()
        self.jaw = JawChannel(self, (0.1, 0.2))

    def take_message(self, kind: Any, raw: bool) -> Any:
        return (self.sent.pop(), {}) if self.sent else None

    def says(self, *positions: float) -> bool:
        self.sent.append(serialize_message(JointState(name=["jaw"], position=list(positions))))
        return self.jaw.take()


@pytest.mark.parametrize("names", [[], ["jaw"], ["a", "left_jaw_joint"], ["x" * 31] * 5])
@pytest.mark.parametrize("frame", ["", "organ", "tool_frame_of_psm1"])
def test_the_first_position_is_read_whatever_the_names(names: list[str], frame: str) -> None:
    message = JointState(
        header=Header(frame_id=frame), name=names, position=[0.375, -1.0], velocity=[9.0]
    )
    assert JointReader().read(serialize_message(message)) == 0.375


def test_a_message_without_position_or_cut_short_says_nothing() -> None:
    reader = JointReader()
    whole = serialize_message(JointState(name=["jaw"], position=[0.5]))
    assert math.isnan(reader.read(serialize_message(JointState(name=["jaw"], effort=[1.0]))))
    assert all(math.isnan(reader.read(whole[:n])) for n in range(30))
    assert math.isnan(reader.read(b"\xff" * 200))


def test_a_jaw_is_closed_below_one_position_and_open_above_another() -> None:
    driver = Driver()
    assert not driver.jaw.take()  # nothing heard
    assert [driver.says(p) for p in (0.5, 0.15, 0.05, 0.15, 0.19, 0.25, 0.15)] == [
        False, False, True, True, True, False, False,
    ]  # fmt: skip
    assert driver.says(-0.2)
    assert driver.says(math.nan) and driver.says()  # an empty message changes nothing


def test_thresholds_that_cross_are_refused() -> None:
    with pytest.raises(ParameterError, match=r"jaw.open: 0.1 lies below jaw.closed, 0.3"):
        chosen_jaw({"jaw.closed": 0.3, "jaw.open": 0.1})
