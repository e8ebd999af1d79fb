"""What the planning page writes about a force."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")

from avatar_ros.ui.texts import frame_text

pytestmark = pytest.mark.ros


def test_a_limited_force_is_no_measurement() -> None:
    """The organ pushes with 25 N; the device gets its 20 N, and the page says both."""
    text = frame_text(25.0, 2.7, 0.8, 0.0071, None)
    assert "Force **25.00 N** ± 2.70 N, **limited: the device gets 20.00 N**" in text
    assert "**7.1 mm**" in text


def test_a_force_that_the_device_gets_is_written_once() -> None:
    assert "limited" not in frame_text(3.3, 0.1, 1.0, 0.001, 12)
    assert "limited" not in frame_text(0.0, 0.0, 0.0, 0.0, None)  # nothing is held back
