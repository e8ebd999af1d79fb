"""Loader and contact node as real processes: force on a tool, and refusals."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh

from avatar_core.vademecum.storage import parse_vademecum
from avatar_interfaces.msg import ContactState, LoopStatistics, VademecumFile, VademecumInfo
from avatar_interfaces.srv import LoadVademecum
from avatar_ros.bench import bare_loop
from avatar_ros.framework import qos
from avatar_ros.framework.conversions import vademecum_file
from avatar_ros.loop.statuses import EXPLANATIONS
from tests.helpers.slowness import Deadline
from tests.ros.conftest import START_TIMEOUT, Probe
from tests.ros.helpers.answers import ROUNDING, took
from tests.ros.helpers.hand import Hand, felt, force_of, stamp_of, wait_for_model

OK, INVALID = ContactState.STATUS_OK, ContactState.STATUS_INVALID_POSE


@pytest.fixture(scope="module")
def probe(lasting_probe: Any) -> Any:
    return lasting_probe


def _status(probe: Any, status: int, hand: Hand) -> ContactState:
    """Return the first such state that answers a pose of this hand, not an earlier one."""

    def wanted(state: ContactState) -> bool:
        return state.status == status and stamp_of(state) in hand.stamps

    return probe.next(ContactState, "contact_state", qos.state(1), wanted, 10.0, hand)


def test_a_touch_is_felt(cell: Any, probe: Any, touch: tuple[np.ndarray, np.ndarray]) -> None:
    wait_for_model(cell, probe)
    tip, normal = touch
    hand = Hand(probe, tip)
    wrench = probe.next(
        WrenchStamped,
        "tool/servo_cf",
        qos.COMMAND,
        lambda w: np.linalg.norm(force_of(w)) > 0.1,
        10.0,
        hand,
    )
    assert wrench.header.frame_id == "organ"
    assert stamp_of(wrench) in hand.stamps
    force = force_of(wrench)
    # The organ pushes the tool out: along the normal, up to the tilt of its curved surface.
    assert force @ normal > 0.8 * np.linalg.norm(force)


def test_contacts_add_up_to_the_force(
    cell: Any, probe: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    wait_for_model(cell, probe)
    hand = Hand(probe, touch[0])
    state, wrench = felt(probe, hand)
    assert (state.status, state.tool, state.header.frame_id) == (OK, "tool", "organ")
    total = sum(np.array([c.force.x, c.force.y, c.force.z]) for c in state.contacts)
    np.testing.assert_allclose(total, wrench, rtol=1e-9)


def test_the_cloud_is_the_deformed_surface(
    cell: Any, probe: Any, organ: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    wait_for_model(cell, probe)
    hand = Hand(probe, touch[0])

    def deformed(cloud: PointCloud2) -> bool:
        """Return whether this hand deforms it: an earlier push may still be on its way."""
        of_hand = stamp_of(cloud) in hand.stamps
        return of_hand and bool(np.abs(_points(cloud)[:, 3:]).max() > 1e-3)

    cloud = probe.next(PointCloud2, "deformation", qos.NEWEST, deformed, 10.0, hand)
    assert cloud.header.frame_id == "organ"
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "dx", "dy", "dz"]
    points = _points(cloud)
    # float32 positions of 0.1 m are exact to 1e-8 m; two roundings
    np.testing.assert_allclose(points[:, :3] - points[:, 3:], organ.surface_vertices, atol=5e-8)


def _points(cloud: PointCloud2) -> np.ndarray:
    return np.frombuffer(bytes(cloud.data), np.float32).reshape(-1, 6)


def test_the_rest_surface_is_announced(cell: Any, probe: Any, organ: Any) -> None:
    mesh = probe.next(Mesh, "rest_surface", qos.LATCHED)
    vertices = np.array([[v.x, v.y, v.z] for v in mesh.vertices])
    np.testing.assert_array_equal(vertices, organ.surface_vertices)
    faces = np.array([t.vertex_indices for t in mesh.triangles])
    np.testing.assert_array_equal(faces, organ.surface_faces)


@pytest.mark.parametrize(
    ("field", "value", "status"),
    [
        ("position.x", math.nan, ContactState.STATUS_INVALID_POSE),
        ("orientation.w", 0.5, ContactState.STATUS_INVALID_POSE),
        ("frame_id", "world", ContactState.STATUS_UNKNOWN_FRAME),
    ],
)
def test_a_bad_pose_gives_no_force(
    cell: Any, probe: Any, touch: tuple[np.ndarray, np.ndarray], field: str, value: Any, status: int
) -> None:
    wait_for_model(cell, probe)
    hand = Hand(probe, touch[0])
    _status(probe, OK, hand)
    if field == "frame_id":
        hand.pose.header.frame_id = value
    else:
        part, name = field.split(".")
        setattr(getattr(hand.pose.pose, part), name, value)
    assert not _status(probe, status, hand).contacts
    gone = lambda wrench: not force_of(wrench).any()  # noqa: E731
    probe.next(WrenchStamped, "tool/servo_cf", qos.COMMAND, gone, 10.0, hand)


@pytest.mark.parametrize("hertz", [1, 10, 300])
def test_a_second_publisher_of_poses_ends_the_force(
    cell: Any, probe: Any, touch: tuple[np.ndarray, np.ndarray], hertz: int
) -> None:
    """The force ends for any rate of the second, and while the first pauses.

    The second's poses are 6 mm deeper; none is answered.
    """
    wait_for_model(cell, probe)
    hand = Hand(probe, touch[0])
    _, force = felt(probe, hand)
    sizes: list[float] = []
    listener = probe.node.create_subscription(
        WrenchStamped,
        "tool/servo_cf",
        lambda wrench: sizes.append(float(np.linalg.norm(force_of(wrench)))),
        qos.COMMAND,
    )
    with closing(Probe()) as second:
        other = Hand(second, touch[0] - 6e-3 * touch[1])
        due = [time.monotonic() + 1.0 / hertz]

        def both() -> bool:
            hand()
            if time.monotonic() >= due[-1]:
                other()
                due.append(due[-1] + 1.0 / hertz)
            return len(due) > 0.5 * hertz + 2

        probe.until(both, START_TIMEOUT)
        assert max(sizes) < 1.1 * np.linalg.norm(force)
        assert not _status(probe, ContactState.STATUS_SEVERAL_PUBLISHERS, hand).contacts
        probe.until(lambda: hand() or False, 0.2, fail=False)  # it has faded
        sizes.clear()
        del due[:-1]
        probe.until(both, START_TIMEOUT)
    probe.node.destroy_subscription(listener)
    assert sizes and not any(sizes)
    felt(probe, hand)  # the second left: it comes back


def test_another_cell_in_the_domain_is_an_error_and_its_organ_is_not_taken(
    cell: Any, probe: Any, library: Path
) -> None:
    wait_for_model(cell, probe)

    rivals = (
        "/vademecum is published by /probe and /vademecum_loader",
        "/tool/servo_cf is published by /contact and /probe",
        "end all but one",
    )

    def until_diagnosed(level: bytes, texts: Sequence[str] = ()) -> None:
        """Wait for diagnostics about other cells; names of new nodes come a bit later."""

        def is_said(array: DiagnosticArray) -> bool:
            found = [s for s in array.status if s.name == "/contact: other cells"]
            return found[0].level == level and all(text in found[0].message for text in texts)

        probe.next(DiagnosticArray, "/diagnostics", qos.STATISTICS, is_said, 20.0)

    until_diagnosed(DiagnosticStatus.OK)
    before = probe.next(ContactState, "contact_state", qos.state(1)).vademecum_id
    with closing(Probe()) as second:
        second.node.create_publisher(WrenchStamped, "tool/servo_cf", qos.COMMAND)
        loader = second.node.create_publisher(VademecumFile, "vademecum", qos.LATCHED)
        twin = (library / "twin.h5").read_bytes()
        loader.publish(vademecum_file(parse_vademecum(twin, "twin").id, "twin", twin))
        probe.until(
            lambda: "'twin' refused: /vademecum is published" in cell["contact"].said(), 20.0
        )
        until_diagnosed(DiagnosticStatus.ERROR, rivals)
        probe.until(lambda: all(text in cell["contact"].said() for text in rivals), 20.0)
    until_diagnosed(DiagnosticStatus.OK)
    state = probe.next(ContactState, "contact_state", qos.state(1))
    assert state.vademecum_id == before


def test_a_fault_and_its_end_are_logged(
    cell: Any, probe: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    wait_for_model(cell, probe)
    hand = Hand(probe, touch[0])
    for w, said in ((0.5, f"no force: {EXPLANATIONS[INVALID][0]}"), (1.0, "the fault is over")):
        hand.pose.pose.orientation.w = w
        before = cell["contact"].said().count(f"tool: {said}")
        logged = lambda text=f"tool: {said}", n=before: cell["contact"].said().count(text) > n  # noqa: E731
        probe.until(lambda logged=logged: hand() or logged(), 30.0)


def test_a_pose_that_stops_coming_is_stale(
    cell: Any, probe: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    wait_for_model(cell, probe)
    hand = Hand(probe, touch[0])
    _status(probe, OK, hand)
    stale = probe.next(
        ContactState,
        "contact_state",
        qos.state(1),
        lambda s: s.status == ContactState.STATUS_STALE_POSE,
        5.0,
    )
    gone = lambda wrench: not force_of(wrench).any()  # noqa: E731
    wrench = probe.next(WrenchStamped, "tool/servo_cf", qos.COMMAND, gone, 5.0)
    assert not stale.contacts
    assert stamp_of(wrench) in hand.stamps  # the last pose's stamp, not a clock's time


def processor_time(pid: int) -> float:
    """Return the processor time of a process until now [s]."""
    said = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(said[11]) + int(said[12])) / os.sysconf("SC_CLK_TCK")


def test_the_loop_keeps_its_rate_without_poses(cell: Any, probe: Any) -> None:
    windows: list[LoopStatistics] = []  # windows of 1 s
    listener = probe.node.create_subscription(
        LoopStatistics, "statistics", windows.append, qos.STATISTICS
    )
    passed, least = Deadline(10.0), math.inf
    while not windows or windows[-1].rate < least:
        assert not passed, f"{windows[-1].rate:.0f} Hz, {least:.0f} Hz at least"
        probe.until(lambda: bool(windows), START_TIMEOUT)
        windows.clear()
        began, used = time.monotonic(), processor_time(cell["contact"].pid)
        probe.until(lambda: bool(windows), START_TIMEOUT)
        used = processor_time(cell["contact"].pid) - used
        work = used / ((time.monotonic() - began) * windows[-1].rate)
        windows.clear()
        slept = bare_loop.periods(1.2, work)  # a loop with as much work, meanwhile
        # The design rate is 1000 Hz; the bound only tells a working loop from a broken one, since
        # these tests share their cores with whatever else runs: of the time that the machine left
        # to the bare loop. `avatar bench cell` measures it.
        least = 700.0 * np.minimum(slept, 1.5e-3).sum() / slept.sum()
        probe.until(lambda: bool(windows), START_TIMEOUT)
        assert windows[-1].rate < 1100.0
    probe.node.destroy_subscription(listener)
    assert math.isnan(windows[-1].pose_age_p50)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("", "no file name"),
        ("missing.h5", "No such file"),
        ("../outside/liver.h5", "inside library_dir"),
        ("/etc/passwd", "inside library_dir"),
        ("link.h5", "link out of library_dir"),
        ("folder.h5", "not a file"),
        ("short.h5", "build"),
        ("flipped.h5", "build"),
        ("text.h5", "build"),
    ],
)
def test_a_bad_file_is_refused(cell: Any, probe: Any, name: str, reason: str) -> None:
    before = probe.next(VademecumInfo, "vademecum_info", qos.LATCHED)
    answer = probe.call(LoadVademecum, "load_vademecum", LoadVademecum.Request(name=name))
    assert not answer.success
    assert reason in answer.message
    assert "\n" not in answer.message
    after = probe.next(VademecumInfo, "vademecum_info", qos.LATCHED)
    assert (after.id, stamp_of(after)) == (before.id, stamp_of(before))


def test_a_good_file_is_loaded(cell: Any, probe: Any, organ: Any, library: Path) -> None:
    from avatar_core.vademecum.storage import load_vademecum

    asked = time.monotonic()
    answer = probe.call(LoadVademecum, "load_vademecum", LoadVademecum.Request(name="liver.h5"))
    assert answer.success, answer.message
    assert 0.0 < took(answer.message, "announced") <= time.monotonic() - asked + ROUNDING
    expected = load_vademecum(library / "liver.h5").info()
    assert answer.info.id == expected.id
    assert answer.info.n_modes == expected.n_modes
    assert answer.info.contact_worst == expected.contact_worst
    assert answer.info.header.frame_id == "organ"


def test_an_inactive_loader_says_so(cell: Any, probe: Any) -> None:
    """Its service exists as long as the node; the announced vademecum is kept."""
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    def change(transition: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        assert probe.call(ChangeState, "vademecum_loader/change_state", request).success

    change(Transition.TRANSITION_DEACTIVATE)
    request = LoadVademecum.Request(name="liver.h5")
    answer = probe.call(LoadVademecum, "load_vademecum", request)
    assert not answer.success and "inactive; activate it" in answer.message
    change(Transition.TRANSITION_ACTIVATE)
    assert probe.call(LoadVademecum, "load_vademecum", request).success


@pytest.mark.parametrize("n_swaps", [2, pytest.param(6, marks=pytest.mark.long)])
def test_another_vademecum_is_felt_soon(
    cell: Any, probe: Any, touch: tuple[np.ndarray, np.ndarray], n_swaps: int
) -> None:
    wait_for_model(cell, probe)
    hand = Hand(probe, touch[0])
    seconds = []
    for k in range(n_swaps):
        request = LoadVademecum.Request(name=("twin.h5", "liver.h5")[k % 2])
        wanted = probe.call(LoadVademecum, "load_vademecum", request).info.id
        asked = time.monotonic()
        probe.next(
            ContactState,
            "contact_state",
            qos.state(1),
            lambda s, wanted=wanted: s.vademecum_id == wanted and s.contacts,
            60.0,
            hand,
        )
        seconds.append(time.monotonic() - asked)
    print(
        f"\nfrom the answer of load_vademecum to the first force of the new one: median "
        f"{np.median(seconds):.2f} s, worst {max(seconds):.2f} s of {n_swaps}"
    )
