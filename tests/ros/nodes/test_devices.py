"""Drivers of haptic devices: form of the wrench, their files, and a stand-in."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from crtk_msgs.msg import OperatingState
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation

from avatar_interfaces.msg import ContactState
from avatar_ros.loop.safety import WRENCHES, Safety
from avatar_ros.loop.tool_channel import ToolChannel
from tests.helpers.paths import PARAMS
from tests.ros.conftest import PATIENT
from tests.ros.helpers.refusals import refusal
from tests.ros.helpers.running import running_cell
from tests.ros.helpers.stepped_loop import pose

pytestmark = pytest.mark.long  # it builds organs and starts nodes

DEVICES = PARAMS / "devices"
CRTK = QoSProfile(depth=10)  # profile of crtk_python_client: reliable, the last ten
# published by cisst-ros when it changes
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def wrench(raw: bytes) -> tuple[np.ndarray, np.ndarray]:
    sent = deserialize_message(raw, WrenchStamped).wrench
    return tuple(np.array([v.x, v.y, v.z]) for v in (sent.force, sent.torque))  # type: ignore[return-value]


@pytest.mark.parametrize("kind", WRENCHES)
def test_a_wrench_comes_as_crtk_names_it(
    bench: Any, touch: tuple[np.ndarray, np.ndarray], kind: str
) -> None:
    """A device with a turned and shifted base, tilted: one force in three forms."""
    frame, shift = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]), np.array([0.3, -0.1, 0.2])
    held = Rotation.from_euler("xyz", [1.0, 0.3, -0.7])  # in the device's frame
    found = {}
    for each in ("absolute", kind):
        own = Safety(leap=math.inf, frame="device", transform=(*shift, *frame.as_quat()))
        made = bench(20e-3)
        made.tools[0] = ToolChannel(
            made.poses[0], made.poses[0], "organ", replace(own, wrench=each)
        )
        made.loop._tools = made.tools
        for depth in np.arange(-6e-3, 0.1e-3, 1e-3):
            where = frame.inv().apply(touch[0] - depth * touch[1] - shift)
            made.step(pose(where, quaternion=held.as_quat(), frame="device"))
        found[each] = wrench(made.poses[0].sent[-1])
    force, torque = found["absolute"]
    assert np.linalg.norm(force) > 1.0
    expected = {
        "absolute": (force, torque),
        "body": (held.inv().apply(force), held.inv().apply(torque)),
        "spatial": (force, torque + np.cross(where, force)),
    }[kind]
    np.testing.assert_allclose(found[kind], expected, atol=1e-12 * np.linalg.norm(force))


@pytest.mark.parametrize(
    ("file", "name", "hears"),
    [
        ("touch.yaml", "arm", "servo_cf"),
        pytest.param("force_dimension.yaml", "omega", "body/servo_cf", marks=pytest.mark.long),
        pytest.param("dvrk.yaml", "MTML", "body/servo_cf", marks=pytest.mark.long),
    ],
)
def test_a_driver_feels_the_organ_by_its_file(
    own_domain: dict[str, str],
    library: Path,
    probe: Any,
    touch: tuple[np.ndarray, np.ndarray],
    file: str,
    name: str,
    hears: str,
) -> None:
    """Started by the lines of msg_docs/guides/devices.md, with poses at 500 Hz as crtk's clients.

    There is no force before it reports that it is enabled and homed, nor once it is paused or in
    fault.
    """
    frame = {"arm": "base", "omega": "omega_base", "MTML": "MTML_base"}[name]
    own = "body/servo_cf" if name == "MTML" else "servo_cf"
    topics = {"measured_cp": "measured_cp", "operating_state": "operating_state", own: hears}
    remaps = [f"tool/{ours}:=/{name}/{theirs}" for ours, theirs in topics.items()]
    words = ["--params-file", str(DEVICES / file), *PATIENT[1:]]
    words += [word for remap in remaps for word in ("-r", remap)]
    node, felt = probe.node, []
    poses = node.create_publisher(PoseStamped, f"/{name}/measured_cp", CRTK)
    states = node.create_publisher(OperatingState, f"/{name}/operating_state", LATCHED)
    node.create_subscription(WrenchStamped, f"/{name}/{hears}", felt.append, CRTK)
    now = {"status": -1}
    node.create_subscription(
        ContactState, "contact_state", lambda state: now.update(status=state.status), CRTK
    )
    turn = Rotation.from_euler("z", 0.5)

    def send() -> None:
        message = PoseStamped()
        message.header.frame_id, message.header.stamp = frame, node.get_clock().now().to_msg()
        at, to = message.pose.position, message.pose.orientation
        at.x, at.y, at.z = map(float, touch[0])
        to.x, to.y, to.z, to.w = map(float, turn.as_quat())
        poses.publish(message)

    node.create_timer(2e-3, send)
    limit = {"arm": 2.0, "omega": 12.0, "MTML": 3.0}[name]

    def says(state: str, homed: bool) -> None:
        states.publish(OperatingState(state=state, is_homed=homed))

    def reaches(status: int) -> None:
        probe.until(lambda: now["status"] == status, 60.0)

    with running_cell(own_domain, library, words=words):
        reaches(ContactState.STATUS_NO_OPERATING_STATE)
        for state, homed, status in (
            ("DISABLED", False, ContactState.STATUS_NOT_ENABLED),
            ("ENABLED", False, ContactState.STATUS_NOT_HOMED),
        ):
            says(state, homed)
            reaches(status)
        assert not any(_size(message) for message in felt)
        says("ENABLED", True)
        probe.until(lambda: _size(felt[-1]) > 0.9 * min(limit, 3.0), 60.0)
        for state in ("PAUSED", "FAULT"):
            says(state, True)
            probe.until(lambda: _size(felt[-1]) == 0.0, 60.0)
            reaches(ContactState.STATUS_NOT_ENABLED)
            says("ENABLED", True)
            probe.until(lambda: _size(felt[-1]) > 0.9 * min(limit, 3.0), 60.0)
    forces = np.array([_size(message) for message in felt])
    assert forces.max() <= limit * (1.0 + 1e-9)
    assert felt[-1].header.frame_id == frame


def test_beside_a_device_a_tool_of_software_speaks_in_the_organs_frame(
    own_domain: dict[str, str], library: Path, probe: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    """A planning page runs beside a Touch whose device has not been enabled yet."""
    words = ["--params-file", str(DEVICES / "touch.yaml"), *PATIENT[1:]]
    elsewhere = "tool_transform:=[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]"
    values = ("tools:=[stylus, page]", "software_tools:=page", elsewhere)
    node, felt, states = probe.node, [], []
    poses = node.create_publisher(PoseStamped, "page/measured_cp", CRTK)
    node.create_subscription(WrenchStamped, "page/servo_cf", felt.append, CRTK)
    node.create_subscription(ContactState, "contact_state", states.append, CRTK)

    def send() -> None:
        message = PoseStamped()
        message.header.frame_id, message.header.stamp = "organ", node.get_clock().now().to_msg()
        at = message.pose.position
        at.x, at.y, at.z = map(float, touch[0])
        message.pose.orientation.w = 1.0
        poses.publish(message)

    node.create_timer(2e-3, send)
    with running_cell(own_domain, library, *values, words=words):
        probe.until(lambda: bool(felt) and _size(felt[-1]) > 0.5, 60.0)
        of_device = {s.status for s in states if s.tool == "stylus"}
    assert felt[-1].header.frame_id == "organ"
    assert of_device and ContactState.STATUS_OK not in of_device


def test_software_that_is_no_tool_is_refused() -> None:
    said = refusal("contact", "tools:=[stylus, page]", "software_tools:=[page, pgae]")
    assert said == "parameter software_tools: there is no tool 'pgae' among stylus, page"


def _size(message: WrenchStamped) -> float:
    force = message.wrench.force
    return math.hypot(force.x, force.y, force.z)
