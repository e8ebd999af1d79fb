"""Direction of a tool's axis, from its pose to the torque on it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation

from avatar_core.contact.effects import Tilt
from avatar_core.geometry.tip import Tip
from avatar_core.haptics.force_guard import DEVICES, ForceGuard
from avatar_interfaces.msg import ContactState
from avatar_ros.framework.templates import rotated
from avatar_ros.loop.contact_loop import ActiveModel
from avatar_ros.loop.safety import Safety
from avatar_ros.loop.tool_channel import ToolChannel
from tests.helpers.contact import prepare, solve, turning
from tests.ros.conftest import TIP_RADIUS, TOUCH_DEPTH
from tests.ros.helpers.stepped_loop import SteppedLoop, pose

PUNCH = Tip("flat", 4e-3)


def punch_bench(bench: Any, organ: Any) -> SteppedLoop:
    """Return a loop whose tool is a punch with its shaft along +x of its pose."""
    made: SteppedLoop = bench(20e-3)
    data = prepare(organ, (PUNCH,), cloud="off", effects=(Tilt((1.0, 0.0, 0.0)),))
    made.loop.active = made.loop._used = ActiveModel("a", data, made.settings)
    return made


def torque(bench: SteppedLoop) -> np.ndarray:
    sent = deserialize_message(bench.poses[0].sent[-1], WrenchStamped).wrench.torque
    return np.array([sent.x, sent.y, sent.z])


def leaning(normal: np.ndarray, angle: float) -> Rotation:
    """Return a pose whose x axis is tilted off a normal."""
    aside = np.cross(normal, [0.3, 0.5, 0.8])
    axis = np.cos(angle) * normal + np.sin(angle) * aside / np.linalg.norm(aside)
    turn, _ = Rotation.align_vectors(axis[None], [[1.0, 0.0, 0.0]])
    return turn


@pytest.mark.parametrize("turned", [False, True])
def test_a_punch_leans_as_its_pose_says(
    bench: Any, organ: Any, touch: tuple[np.ndarray, np.ndarray], turned: bool
) -> None:
    """The torque is the core's; in a frame of the tool it comes in that frame."""
    made, normal = punch_bench(bench, organ), touch[1]
    surface = touch[0] - (TIP_RADIUS - TOUCH_DEPTH) * normal
    lean, frame, shift = leaning(normal, 0.2), Rotation.identity(), np.zeros(3)
    if turned:
        frame, shift = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]), np.array([0.3, -0.1, 0.2])
        own = Safety(leap=math.inf)
        own = replace(own, frame="device", transform=(*shift, *frame.as_quat()))
        made.tools[0] = ToolChannel(made.poses[0], made.poses[0], "organ", own)
        made.loop._tools = made.tools
    reference = prepare(organ, (PUNCH,), cloud="off", effects=(Tilt(),))
    axis = turning(np.array(Tilt().axis), lean.as_matrix()[:, 0])
    own_turn = (frame.inv() * lean).as_quat()
    for depth in np.arange(-2e-3, 3.1e-3, 0.5e-3):
        tip = surface - depth * normal
        where = frame.inv().apply(tip - shift)
        made.step(pose(where, quaternion=own_turn, frame="device" if turned else "organ"))
        solve(reference, tip[None], axis)
    expected = reference.out.torque[0]
    assert np.linalg.norm(expected) > 1e-3
    np.testing.assert_allclose(frame.apply(torque(made)), expected, atol=1e-9)


def test_a_pose_that_is_refused_lets_the_torque_fade(
    bench: Any, organ: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    made, normal = punch_bench(bench, organ), touch[1]
    surface = touch[0] - (TIP_RADIUS - TOUCH_DEPTH) * normal
    turn = leaning(normal, 0.2).as_quat()
    for depth in np.arange(-2e-3, 3.1e-3, 0.5e-3):
        made.step(pose(surface - depth * normal, quaternion=turn))
    for _ in range(20):
        made.step(pose(surface - 3e-3 * normal, quaternion=np.full(4, np.nan)))
    assert not made.loop.active.data.state.axis.any()
    assert np.isfinite(torque(made)).all()


def test_a_leap_is_no_lever(bench: Any, organ: Any, touch: tuple[np.ndarray, np.ndarray]) -> None:
    """A torque about the origin of the tool's frame keeps the last pose that was used."""
    made: SteppedLoop = bench(20e-3)
    made.tools[0] = ToolChannel(made.poses[0], made.poses[0], "organ", Safety(wrench="spatial"))
    made.loop._tools = made.tools
    made.loop.settings = replace(made.settings, safety=Safety(wrench="spatial"))
    made.loop.guards = [ForceGuard(DEVICES["sigma"])]
    tip = touch[0]
    for depth in [*np.arange(-6e-3, 0.0, 0.5e-3), *np.zeros(200)]:
        made.step(pose(touch[0] - depth * touch[1]))
    before = torque(made)
    assert np.linalg.norm(before) > 1e-3
    status, force = made.step(pose(tip + np.array([50.0, 0.0, 0.0])))
    assert status == ContactState.STATUS_LEAP and np.linalg.norm(force) > 0.1
    assert np.linalg.norm(torque(made)) <= np.linalg.norm(before)


def test_a_vector_turns_as_scipys() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        quaternion, vector = Rotation.random(random_state=rng).as_quat(), rng.normal(size=3)
        found = rotated(tuple(vector), tuple(quaternion))
        np.testing.assert_allclose(found, Rotation.from_quat(quaternion).apply(vector), atol=1e-14)
