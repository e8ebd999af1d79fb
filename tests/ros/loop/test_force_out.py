"""The sent force, fault by fault, through the loop and without any other process.

The loop is stepped by hand on a clock that the test sets, 1 ms a period.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from crtk_msgs.msg import OperatingState
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message

from avatar_core.geometry.tip import Tip
from avatar_core.haptics.force_guard import ENGAGEMENT, SETTLING, ForceGuard, ForceLimits
from avatar_interfaces.msg import ContactState
from avatar_ros.loop.contact_loop import ActiveModel
from avatar_ros.loop.device import ToolDevice
from avatar_ros.loop.safety import Safety
from avatar_ros.loop.tool_channel import OK, ToolChannel
from tests.helpers.contact import prepare
from tests.ros.helpers.stepped_loop import SteppedLoop, pose

ENGAGING, BARRED = ContactState.STATUS_ENGAGING, ContactState.STATUS_OUT_OF_RANGE
SOON = round(1e3 * SETTLING)  # periods
AGAIN = round(1e3 * (SETTLING + ENGAGEMENT)) + 2
SAFETY = Safety(leap=0.02)
READY = OperatingState(state="ENABLED", is_homed=True)
Fault = Callable[[Any, np.ndarray], Any]


class Cell:
    """Bench whose force goes through a guard; the tool is held 3 mm deep, engaged."""

    def __init__(self, bench: SteppedLoop, touch: Any, safety: Safety = SAFETY) -> None:
        self.bench, self.loop, self.tool = bench, bench.loop, bench.tools[0]
        self.normal, self.tip = touch[1], bench.press(touch, -1e-3)
        self.loop.guards = [ForceGuard(safety.limits)]
        self.loop.energies = safety.observer(1, 1e-3)
        self.loop.settings = replace(bench.settings, safety=safety)
        self.hold(AGAIN)
        status, self.force = bench.step(pose(self.tip))
        assert status == OK and np.linalg.norm(self.force) > 1.0

    def hold(self, n: int, message: Callable[[], bytes | None] | None = None) -> np.ndarray:
        """Return status and force of some periods with the same pose, shape (n, 4)."""
        found = [
            self.bench.step(pose(self.tip) if message is None else message()) for _ in range(n)
        ]
        return np.array([[status, *force] for status, force in found])

    def counts(self, *publishers: str) -> None:
        """Count these publishers, by their identifiers, as the node does."""
        named = {publisher: f"/{publisher}" for publisher in publishers}
        self.tool.note_senders(named, round(1e9 * self.bench.now) + 1)

    def refuses(self) -> bool:
        """Return whether poses of some periods are refused as those of several publishers."""
        several = self.hold(5)[:, 0] == ContactState.STATUS_SEVERAL_PUBLISHERS
        assert several.all() or not several.any()
        return bool(several[0])


@pytest.fixture
def cell(bench: Any, touch: tuple[np.ndarray, np.ndarray]) -> Iterator[Cell]:
    yield Cell(bench(20e-3), touch)


def silence(cell: Cell) -> tuple[int, np.ndarray]:
    """Stop the poses; return the force that is sent from the timeout on."""
    before = cell.hold(20, lambda: None)
    np.testing.assert_allclose(before[:, 1:], np.tile(cell.force, (20, 1)), rtol=1e-9)
    return ContactState.STATUS_STALE_POSE, cell.hold(12, lambda: None)


def broken(cell: Cell) -> tuple[int, np.ndarray]:
    first = cell.hold(1, lambda: pose(cell.tip * math.nan))
    return ContactState.STATUS_INVALID_POSE, np.vstack([first, cell.hold(11)])


def foreign(cell: Cell) -> tuple[int, np.ndarray]:
    first = cell.hold(1, lambda: pose(cell.tip, frame="world"))
    return ContactState.STATUS_UNKNOWN_FRAME, np.vstack([first, cell.hold(11)])


def leap(cell: Cell) -> tuple[int, np.ndarray]:
    first = cell.hold(1, lambda: pose(cell.tip + np.array([0.0, 0.025, 0.0])))
    back = cell.hold(1)  # the return is also a leap
    assert back[0, 0] == ContactState.STATUS_LEAP
    return ContactState.STATUS_LEAP, np.vstack([first, back, cell.hold(10)])


def second_publisher(cell: Cell) -> tuple[int, np.ndarray]:
    """Add a second publisher with its own count, which then leaves."""
    cell.bench.poses[0].number -= 1000
    first = cell.hold(1)
    cell.bench.poses[0].number += 1000
    found = np.vstack([first, cell.hold(11)])
    cell.counts("driver")
    return ContactState.STATUS_SEVERAL_PUBLISHERS, found


def standstill(cell: Cell) -> tuple[int, np.ndarray]:
    """Stop the whole process for 2 s, until a new pose."""
    status, force = cell.bench.step(pose(cell.tip), after=2.0)
    return ContactState.STATUS_STALE_POSE, np.vstack([[status, *force], cell.hold(11)])


def lost(cell: Cell) -> tuple[int, np.ndarray]:
    cell.tool.publishers = 0
    cell.hold(20, lambda: None)
    found = cell.hold(12, lambda: None)
    cell.tool.publishers = 1
    return ContactState.STATUS_LOST_TOOL, found


def heard(cell: Cell) -> ToolDevice:
    """Return the device of the cell's tool, which reported that it is ready."""
    device = ToolDevice(cell.tool, (), Time)
    device.hear(READY)
    return device


def paused(cell: Cell) -> tuple[int, np.ndarray]:
    device = heard(cell)
    device.hear(OperatingState(state="PAUSED", is_homed=True))
    found = cell.hold(12)
    device.hear(READY)
    return ContactState.STATUS_NOT_ENABLED, found


def unhomed(cell: Cell) -> tuple[int, np.ndarray]:
    device = heard(cell)
    device.hear(OperatingState(state="ENABLED"))
    found = cell.hold(12)
    device.hear(READY)
    return ContactState.STATUS_NOT_HOMED, found


def unheard(cell: Cell) -> tuple[int, np.ndarray]:
    """Remove its driver, but not its poses."""
    device = heard(cell)
    device.subscription = SimpleNamespace(get_publisher_count=lambda: 0)
    device.attend()
    found = cell.hold(12)
    device.hear(READY)
    return ContactState.STATUS_NO_OPERATING_STATE, found


@pytest.mark.parametrize(
    "fault",
    [silence, broken, foreign, leap, second_publisher, standstill, lost, paused, unhomed, unheard],
)
def test_a_fault_ends_the_force_within_10_ms_and_it_comes_back_softly(
    cell: Cell, fault: Callable[[Cell], tuple[int, np.ndarray]]
) -> None:
    """After the fault the tool leaves the organ, comes in anew, and is held again."""
    before = cell.tool.faults.copy()
    status, found = fault(cell)
    sizes = np.linalg.norm(found[:, 1:], axis=1)
    held = np.linalg.norm(cell.force[None], axis=1)  # by the same sums, with equal rounding
    assert found[0, 0] == status
    assert (np.diff(sizes) <= 1e-12).all() and sizes[0] <= held[0]
    assert not sizes[10:].any()
    directions = found[sizes > 0, 1:] / sizes[sizes > 0, None]
    np.testing.assert_allclose(directions @ cell.force, np.linalg.norm(cell.force), rtol=1e-9)
    assert cell.tool.faults[status] - before[status] >= 1
    out = cell.hold(SOON + 1, lambda: pose(cell.tip + 12e-3 * cell.normal))
    assert not out[:, 1:].any()
    grown = np.linalg.norm(cell.hold(AGAIN)[:, 1:], axis=1)
    assert grown[-1] == pytest.approx(np.linalg.norm(cell.force), rel=1e-6)
    assert np.diff(grown).max() < 0.06 * grown[-1]


def test_a_tool_whose_device_is_not_ready_leaves_the_organ_alone(cell: Cell) -> None:
    heard(cell).hear(OperatingState(state="FAULT", is_homed=True))
    found = cell.hold(30)
    assert (found[:, 0] == ContactState.STATUS_NOT_ENABLED).all() and not found[10:, 1:].any()
    assert not cell.loop.active.data.out.force.any()


def test_what_the_poses_lack_is_said_before_what_the_device_does(cell: Cell) -> None:
    heard(cell).hear(OperatingState(state="DISABLED"))
    assert cell.hold(1, lambda: pose(cell.tip, frame="world"))[0, 0] == (
        ContactState.STATUS_UNKNOWN_FRAME
    )


def test_a_tool_that_starts_again_is_one_publisher(cell: Cell) -> None:
    """At once after a silence, even if it is known from before; otherwise once it was counted."""
    for silent, known in ((30, ("driver",)), (30, ("driver", "again")), (0, ("again",))):
        cell.counts("driver")
        cell.hold(silent, lambda: None)
        cell.bench.poses[0].number = 0
        assert cell.refuses() == (silent == 0)
        cell.counts(*known)
        assert not cell.refuses()


def test_a_tool_that_starts_again_while_another_joins_is_not_taken_for_it(cell: Cell) -> None:
    cell.counts("driver")
    cell.hold(30, lambda: None)
    cell.bench.poses[0].number = 0
    assert not cell.refuses()
    cell.counts("again", "forgotten")
    assert cell.refuses()


@pytest.mark.parametrize("sends", [False, True])
def test_another_publisher_is_found_by_its_identifier(cell: Cell, sends: bool) -> None:
    """However rarely it sends; a killed one counts again when it sends again."""
    cell.counts("driver")
    cell.counts("driver", "forgotten")
    assert cell.refuses()
    cell.counts("driver")
    assert not cell.refuses()
    cell.hold(30, lambda: None)
    cell.counts("driver", "again")
    cell.bench.poses[0].number = 0
    assert not cell.refuses()
    cell.counts("driver", "again")
    assert not cell.refuses()
    if sends:
        cell.bench.poses[0].number -= 5
    assert cell.refuses() == sends
    cell.counts("driver", "again")
    assert cell.refuses() == sends


def test_while_it_comes_back_the_status_says_so(cell: Cell) -> None:
    broken(cell)
    cell.hold(SOON)
    coming = cell.hold(round(1e3 * ENGAGEMENT) - 15)
    assert (coming[:, 0] == ENGAGING).all()
    assert 0.0 < cell.loop.guards[0].sent_fraction < 1.0
    assert cell.hold(40)[-1, 0] == OK


def test_to_stop_is_a_fault(cell: Cell) -> None:
    cell.loop._stopping = True
    found = cell.hold(10)
    assert (found[:, 0] == ContactState.STATUS_INACTIVE).all()
    assert not found[9, 1:].any() and cell.loop.guards[0].silent


def test_large_forces_are_limited_and_the_state_says_how_much(
    bench: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    cell = Cell(bench(20e-3), touch, replace(SAFETY, limits=ForceLimits(1.5, 200.0)))
    assert np.linalg.norm(cell.force) == pytest.approx(1.5)
    whole = np.linalg.norm(cell.loop.active.data.out.force[0])
    assert cell.loop.guards[0].sent_fraction == pytest.approx(1.5 / whole)
    away = cell.hold(30, lambda: pose(cell.tip + 15e-3 * cell.normal))
    change = np.linalg.norm(np.diff(np.vstack([cell.force, away[:, 1:]]), axis=0), axis=1)
    assert change.max() < 200.0 * 1.001e-3
    assert not away[-1, 1:].any()


def test_a_swap_goes_from_old_to_new_within_the_slew(cell: Cell, organ: Any) -> None:
    """From an organ to half the modes under another organ's name, with the tool held deep."""
    limits = ForceLimits(20.0, 30.0)
    cell.loop.settings = replace(cell.loop.settings, safety=replace(SAFETY, limits=limits))
    data = prepare(organ, (Tip("sphere", 5e-3),), modes=3, cloud="off")
    cell.loop.active = ActiveModel("b", data, cell.loop.settings)
    found = np.vstack([cell.force, cell.hold(500)[:, 1:]])
    assert np.linalg.norm(np.diff(found, axis=0), axis=1).max() <= 30e-3 * (1 + 1e-9)


def test_poses_in_a_frame_of_the_tool_give_forces_in_it(
    cell: Cell, bench: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    """The device stands turned by 90 degrees about x, 0.3 m aside."""
    half = math.sqrt(0.5)
    transform = (0.3, -0.1, 0.2, half, 0.0, 0.0, half)
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    own = replace(SAFETY, frame="device", transform=transform)
    other = bench(20e-3)
    queue = other.poses[0]
    other.tools[0] = ToolChannel(queue, queue, "organ", own)
    other.loop._tools = other.tools
    expected = cell.loop.active.data.out.force[0].copy()
    found = None
    for d in [*np.arange(-6e-3, -1e-3, 1e-3), *[-1e-3] * 5]:
        tip = rotation.T @ (touch[0] - d * touch[1] - transform[:3])
        status, found = other.step(pose(tip, frame="device"))
        assert status == OK
    np.testing.assert_allclose(rotation @ found, expected, rtol=1e-6)


def test_a_loop_that_breaks_lets_go(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks(data: Any) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(cell.loop, "_solve", breaks)
    monkeypatch.setattr(cell.loop, "_ports", list)
    monkeypatch.setattr(cell.loop, "_wait", lambda: None)
    cell.loop._stopping = False
    cell.bench.poses[0].sent.clear()
    cell.loop._run(-1)
    assert "broken" in cell.loop.failure
    last = deserialize_message(cell.bench.poses[0].sent[-1], WrenchStamped).wrench.force
    assert (last.x, last.y, last.z) == (0.0, 0.0, 0.0)


@pytest.mark.long
@pytest.mark.parametrize("mode", ["observe", "control"])
def test_passivity_is_watched_or_kept(
    bench: Any, touch: tuple[np.ndarray, np.ndarray], mode: str
) -> None:
    """A tool goes in and out fast, its force a period late: control takes some of it."""

    def felt(one: Cell) -> np.ndarray:
        ways = 2e-3 * np.sin(2 * math.pi * 10 * np.arange(300) * 1e-3)
        return np.vstack([one.hold(1, lambda w=w: pose(one.tip - w * one.normal)) for w in ways])

    plain = felt(Cell(bench(20e-3), touch))[:, 1:]
    watched = Cell(bench(20e-3), touch, replace(SAFETY, passivity=mode))
    assert watched.loop.energies is not None
    sent = felt(watched)[:, 1:]
    created = float(watched.loop.energies.created[0])
    if mode == "observe":
        np.testing.assert_allclose(sent, plain, rtol=1e-9, atol=1e-12)
        assert created > 10 * watched.loop.energies.tolerance
    else:
        assert not np.allclose(sent, plain)
        shares = []
        for raw, wrench in zip(watched.bench.state.sent[-300:], sent[-300:], strict=True):
            state = deserialize_message(raw, ContactState)
            computed = sum(np.array([f.force.x, f.force.y, f.force.z]) for f in state.contacts)
            if np.linalg.norm(computed) > 1e-6:
                shares.append(np.linalg.norm(wrench) / np.linalg.norm(computed))
                assert state.force_share == pytest.approx(min(shares[-1], 1.0), abs=1e-6)
        assert min(shares) < 0.9
        assert created < 2 * watched.loop.energies.tolerance
