"""An OpenIGTLink program beside the cell: pyigtl's own client, and sockets with false messages."""

from __future__ import annotations

import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyigtl", reason="the extra slicer is not installed")

import pyigtl
from pyigtl.messages import message_type_to_class_constructor as kinds
from rclpy.action import ActionServer
from sensor_msgs.msg import PointCloud2

from avatar_interfaces.action import BuildPatient
from avatar_interfaces.msg import ContactState
from avatar_interfaces.srv import LoadVademecum
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.nodes.slicer_bridge import SLICER_BRIDGE
from avatar_ros.slicer import messages
from avatar_ros.slicer.follower import LONGEST, Follower
from avatar_ros.slicer.link import MAX_BODY, Link
from tests.helpers.slowness import Deadline, end_of, wait_until, within
from tests.ros.conftest import Probe
from tests.ros.helpers.doc_pages import parameter_rows, yaml_parameters
from tests.ros.helpers.hand import wait_for_model
from tests.ros.helpers.running import running

pytestmark = pytest.mark.long  # it builds an organ and starts nodes

SECONDS = 30.0  # for an answer
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def unpacked(self: Any, content: bytes) -> None:
    """POLYDATA, which pyigtl 0.3.4 sends but cannot read: 10 numbers, points, four cell types.

    See openigtlink.org/protocols/v3_polydata.html.
    """
    n_points, _, size_vertices, _, size_lines, _, size_polygons = struct.unpack(">7I", content[:28])
    assert size_vertices == size_lines == 0
    start = 40
    self.points = np.frombuffer(content, ">f4", 3 * n_points, start).reshape(-1, 3)
    start += 12 * n_points
    self.polygons = np.frombuffer(content, ">u4", size_polygons // 4, start)


@pytest.fixture(scope="module", autouse=True)
def reads_surfaces() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pyigtl.PolyDataMessage, "_unpack_content", unpacked)
        patch.setitem(kinds, "POLYDATA", pyigtl.PolyDataMessage)
        yield


@pytest.fixture(scope="module")
def probe(lasting_probe: Any) -> Any:
    return lasting_probe


@pytest.fixture(scope="module")
def port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@pytest.fixture(scope="module")
def bridge(own_domain: dict[str, str], port: int) -> Iterator[Module]:
    with running("slicer_bridge", own_domain, f"port:={port}") as process:
        yield process


@pytest.fixture
def slicer(bridge: Module, port: int) -> Iterator[Any]:
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
    yield client
    client.stop()


def heard(client: Any, probe: Any, device: str, wanted: Any = lambda message: True) -> Any:
    """Return the next message for a device that is wanted."""
    passed = Deadline(SECONDS)
    while not passed:
        probe.spin(0.05)
        message = client.wait_for_message(device, timeout=0.0)
        if message is not None and wanted(message):
            return message
    raise AssertionError(f"nothing wanted came for {device}")


def points_of(cloud: PointCloud2) -> np.ndarray:
    """Return positions of a cloud, shape (n, 3) [mm]."""
    return 1e3 * np.frombuffer(cloud.data, np.float32).reshape(-1, 6)[:, :3]


def test_the_organ_comes_in_millimetres(cell: Any, probe: Any, slicer: Any, organ: Any) -> None:
    wait_for_model(cell, probe)
    for device in (messages.ORGAN, messages.DEFORMED):
        surface = heard(slicer, probe, device)
        np.testing.assert_allclose(surface.points, 1e3 * organ.surface_vertices, atol=1e-3)
        triangles = surface.polygons.reshape(-1, 4)
        assert (triangles[:, 0] == 3).all()
        np.testing.assert_array_equal(triangles[:, 1:], organ.surface_faces)


def test_a_tool_that_is_moved_there_presses_here(
    cell: Any, probe: Any, slicer: Any, organ: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    """The answer is seen there: the deformed organ, the force, the tool."""
    wait_for_model(cell, probe)
    tip, normal = touch
    rest = 1e3 * organ.surface_vertices
    for way in np.linspace(20e-3, 0.0, 21):  # as a hand would
        slicer.send_message(messages.pose(messages.TARGET, tip + way * normal, UPRIGHT))
        probe.spin(0.03)
    probe.spin(1.0)  # it arrives a pose late
    at = 1e3 * tip
    heard(slicer, probe, messages.TOOL, lambda m: np.abs(m.matrix[:3, 3] - at).max() < 0.1)
    state = probe.next(
        ContactState,
        "contact_state",
        qos.state(1),
        lambda s: s.status == ContactState.STATUS_OK and len(s.contacts) > 0,
        SECONDS,
    )
    force = np.linalg.norm(
        np.sum([(c.force.x, c.force.y, c.force.z) for c in state.contacts], axis=0)
    )
    assert force > 0.1
    # a busy machine shows fewer modes from one period to the next: it equals one of the last clouds
    clouds: deque[np.ndarray] = deque(maxlen=500)
    listener = probe.node.create_subscription(
        PointCloud2, "deformation", lambda cloud: clouds.append(points_of(cloud)), qos.NEWEST
    )
    moved = heard(
        slicer,
        probe,
        messages.DEFORMED,
        lambda m: any(np.allclose(m.points, points, rtol=0.0, atol=0.02) for points in clouds),
    )
    probe.node.destroy_subscription(listener)
    assert np.abs(moved.points - rest).max() > 1.0
    said = heard(slicer, probe, messages.CONTACT, lambda m: " N" in m.string)
    assert float(said.string.split()[0]) == pytest.approx(force, abs=0.01)
    slicer.stop()
    left = lambda s: s.status != ContactState.STATUS_OK  # noqa: E731
    probe.next(ContactState, "contact_state", qos.state(1), left, SECONDS)


def test_one_tool_of_several_is_told(own_domain: dict[str, str], probe: Any) -> None:
    """All tools share the topic of states, and the others' may come last."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    publisher = probe.node.create_publisher(ContactState, "contact_state", qos.state(2))
    said = {"left": ContactState.STATUS_LEAP, "right": ContactState.STATUS_NOT_HOMED}

    def tell() -> None:
        for tool, status in said.items():
            publisher.publish(ContactState(tool=tool, status=status))

    with running("slicer_bridge", own_domain, f"port:={port}", "tool:=left"):
        client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
        timer = probe.node.create_timer(2e-3, tell)
        found = [heard(client, probe, messages.CONTACT).string]
        for _ in range(60):
            probe.spin(0.05)
            message = client.wait_for_message(messages.CONTACT, timeout=0.0)
            found += [] if message is None else [message.string]
        client.stop()
        probe.node.destroy_timer(timer)
    probe.node.destroy_publisher(publisher)
    assert len(found) > 10 and all("jumped" in text for text in found)  # of 30


def build(probe: Any, slicer: Any, line: str, is_heard: Callable[[], bool]) -> None:
    """Send a line until it has an effect: an early one is lost."""
    passed = Deadline(SECONDS)
    while not is_heard() and not passed:
        slicer.send_message(messages.text(messages.BUILD, line))
        probe.spin(1.0)


def test_a_patient_is_built_by_a_line(probe: Any, slicer: Any) -> None:
    """The line names file and fidelity; stages and outcome come back."""
    goals: list[Any] = []

    def built(handle: Any) -> Any:
        goals.append(handle.request)
        handle.publish_feedback(BuildPatient.Feedback(stage="mesh", fraction=0.5, error=0.1))
        time.sleep(0.5)
        handle.abort()
        return BuildPatient.Result(success=False, message="no such surface; choose another")

    server = ActionServer(probe.node, BuildPatient, "build_patient", built)
    try:
        build(probe, slicer, "new liver.stl reduced", lambda: bool(goals))
        assert (goals[0].surface, goals[0].fidelity) == ("new liver.stl", "reduced")
        said = heard(slicer, probe, messages.BUILD, lambda m: "choose another" in m.string)
        assert said.string == "no such surface; choose another"
    finally:
        server.destroy()


def test_a_patient_that_was_built_is_loaded(own_domain: dict[str, str]) -> None:
    """The bridge asks the loader for the file of the result, and goes on."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    loaded: list[str] = []

    def built(handle: Any) -> Any:
        handle.succeed()
        return BuildPatient.Result(success=True, file="new liver.h5", seconds=2.0)

    def load(request: Any, response: Any) -> Any:
        loaded.append(request.name)
        response.message = "refused by the library"
        return response

    with closing(Probe()) as other:
        # in a namespace, where no other loader answers
        server = ActionServer(other.node, BuildPatient, "/own/build_patient", built)
        other.node.create_service(LoadVademecum, "/own/load_vademecum", load)
        words = ["-r", "__ns:=/own"]
        with running("slicer_bridge", own_domain, f"port:={port}", words=words) as bridge:
            client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
            build(other, client, "new liver.stl", lambda: bool(loaded or bridge.poll()))
            assert bridge.poll() is None and loaded, bridge.said()
            said = heard(client, other, messages.BUILD, lambda m: "library" in m.string)
            assert said.string == "refused by the library"
            client.stop()
        server.destroy()
    assert set(loaded) == {"new liver.h5"}


def test_a_second_bridge_says_that_the_port_is_taken(
    bridge: Module, own_domain: dict[str, str], port: int
) -> None:
    second = Module("slicer_bridge", ["--ros-args", "-p", f"port:={port}"], own_domain)
    assert end_of(second, SECONDS) == 1
    assert "choose another port" in second.said()


def test_page_and_file_hold_every_parameter_at_its_default() -> None:
    defaults = {p.name: p.default for p in SLICER_BRIDGE}
    assert set(parameter_rows("slicer_bridge")) == set(defaults)
    assert yaml_parameters("slicer_bridge") == defaults


# --- The connection -------------------------------------------------------------------------------


class Ear:
    """Link on a free port, with its received messages and reports."""

    def __init__(self) -> None:
        self.heard: list[Any] = []
        self.said: list[str] = []
        self.link = Link("127.0.0.1", 0, self.heard.append, self.said.append)

    def connect(self) -> socket.socket:
        before = self.link.n_clients
        client = socket.create_connection(("127.0.0.1", self.link.port))
        self.until(lambda: self.link.n_clients > before)
        return client

    def until(self, done: Any) -> None:
        wait_until(done, SECONDS, f"{self.said} and no more")


@pytest.fixture
def ear() -> Iterator[Ear]:
    ear = Ear()
    yield ear
    ear.link.close()


def header(kind: bytes, size: int) -> bytes:
    return struct.pack(">H12s20sIIQQ", 1, kind, b"ToolTarget", 0, 0, size, 0)


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (header(b"TRANSFORM", MAX_BODY + 1), "at most"),
        (header(b"STRING", 2**63), "at most"),
        (header(b"TRANSFORM", 5) + b"short", "cannot be read"),
        (header(b"\xff\xfe", 0), "does not speak OpenIGTLink"),
        (b"POST /avatar HTTP/1.1\r\nHost: 127.0.0.1:18944\r\n".ljust(58), "not speak OpenIGTLink"),
    ],
    ids=["large", "endless", "short", "no text", "website"],
)
def test_a_program_that_lies_is_dropped_and_the_next_one_served(
    ear: Ear, sent: bytes, reason: str
) -> None:
    client = ear.connect()
    client.sendall(sent)
    ear.until(lambda: any(reason in line for line in ear.said))
    assert client.recv(1) == b""
    assert not ear.heard
    with ear.connect() as other:
        other.sendall(messages.pose("ToolTarget", np.zeros(3), UPRIGHT).pack())
        ear.until(lambda: ear.heard)


def test_what_is_not_understood_is_skipped(ear: Ear) -> None:
    with ear.connect() as client:
        client.sendall(header(b"GET_STATUS", 0) + header(b"IMAGE", 100_000) + bytes(100_000))
        client.sendall(messages.text("BuildPatient", "liver.stl").pack())
        ear.until(lambda: ear.heard)
        assert ear.heard[0].string == "liver.stl"


def test_who_does_not_read_gets_the_newest_afterwards(ear: Ear) -> None:
    """Nothing piles up, and the sender never waits."""
    points, faces = np.zeros((20_000, 3)), messages.polygons_of(np.zeros((2, 3), int))
    with ear.connect() as client:
        with within(20.0):
            for k in range(200):
                points[0, 0] = k
                ear.link.send(messages.surface("Organ", points, faces))
        client.settimeout(SECONDS)
        last, received = -1.0, 0
        while last < 199e3:
            (size,) = struct.unpack(">Q", _exactly(client, 58)[42:50])
            last = struct.unpack(">f", _exactly(client, size)[40:44])[0]
            received += 1
        assert received < 200


def _exactly(client: socket.socket, size: int) -> bytes:
    got = b""
    while len(got) < size:
        got += client.recv(size - len(got))
    return got


def test_poses_survive_the_way_there_and_back() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        position, quaternion = rng.normal(size=3), rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        found = messages.pose_of(messages.pose("Tool", position, quaternion))
        assert found is not None
        np.testing.assert_allclose(found[0], position, atol=1e-6)
        assert abs(found[1] @ quaternion) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("spoilt", ["mirrored", "scaled", "not a number"])
def test_a_transform_that_is_no_rigid_motion_is_no_pose(spoilt: str) -> None:
    message = messages.pose("ToolTarget", np.zeros(3), UPRIGHT)
    message.matrix = message.matrix @ np.diag(
        {"mirrored": [-1, 1, 1, 1], "scaled": [2, 2, 2, 1], "not a number": [np.nan, 1, 1, 1]}[
            spoilt
        ]
    )
    assert messages.pose_of(message) is None


def test_a_tool_follows_seldom_poses_evenly() -> None:
    """It arrives when the next pose comes, a pose late, and never moves faster than the hand."""
    follower, period, speed = Follower(), 0.03, 0.1
    places = []
    for k in range(60):
        now = period * k
        follower.follow(np.array([speed * now, 0.0, 0.0]), UPRIGHT, now)
        places += [follower.at(now + part * period)[0][0] for part in (0.0, 0.25, 0.5, 0.75)]
    steps = np.diff(places[8:])
    np.testing.assert_allclose(steps, 0.25 * period * speed, rtol=1e-6)
    rest = follower.at(now + 1.0)
    np.testing.assert_allclose(rest[0], [speed * now, 0.0, 0.0], atol=1e-12)
    follower.follow(np.zeros(3), UPRIGHT, now + 10.0)  # after a pause
    halfway = follower.at(now + 10.0 + 0.5 * LONGEST)[0][0]
    assert halfway == pytest.approx(0.5 * speed * now, rel=1e-6)
