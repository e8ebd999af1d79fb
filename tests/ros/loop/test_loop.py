"""The loop period by period: exchange of models, and effect of a turn."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2

from avatar_core.contact.effects import Friction, Viscoelasticity
from avatar_core.geometry.tip import Tip
from avatar_ros.framework.templates import WrenchTemplate, stamp_bytes
from avatar_ros.loop.contact_loop import BLEND, ActiveModel, ContactLoop
from avatar_ros.loop.settings import LoopSettings
from avatar_ros.loop.statistics import TimingRecord
from avatar_ros.loop.tool_channel import OK
from tests.helpers.contact import prepare
from tests.helpers.slowness import slowness
from tests.ros.helpers.unlimited_guard import UnlimitedGuard

RATE = 1000.0  # [Hz]
N_BLEND = round(BLEND * RATE)
SETTINGS = LoopSettings(
    tools=("tool",),
    tips=(Tip(),),
    scene="",
    rate=RATE,
    cloud="surface",
    cloud_divisor=1,
    modes=None,
    frame_id="organ",
    pose_timeout=0.02,
    material={},
    budget=None,
    priority=0,
    cpu=-1,
    lock_memory=False,
)


class Outlet:
    """Outlet that keeps published messages."""

    def __init__(self) -> None:
        self.handle = self
        self.sent: list[bytes] = []

    def publish_raw(self, message: bytes) -> None:
        self.sent.append(message)


class HeldTool:
    """Tool with a pose in every period."""

    def __init__(self, tip: np.ndarray) -> None:
        self.tip, self.orientation = tip.copy(), np.array([0.0, 0.0, 0.0, 1.0])
        self.publisher = Outlet()
        self.wrench = WrenchTemplate("organ")
        self.status, self.stamp = OK, stamp_bytes(1)
        self.connected = True

    @property
    def fault(self) -> int:
        """Return that its device takes every force."""
        return self.status

    def take(
        self, now: int, timeout: int, tip: np.ndarray, turned: np.ndarray, leap: float
    ) -> bool:
        tip[:], turned[:] = self.tip, self.orientation
        return True

    def answer(self) -> None:
        self.publisher.publish_raw(self.wrench.serialise(self.stamp))

    def note_solved(self, status: int) -> None:
        pass


class Bench:
    """Loop that is stepped by hand."""

    def __init__(self, organ: Any, tip: np.ndarray, context: Any) -> None:
        self.organ = organ
        self.tool = HeldTool(tip)
        self.cloud = Outlet()
        outlets = SimpleNamespace(state=Outlet(), deformation=self.cloud, statistics=Outlet())
        self.loop = ContactLoop(SETTINGS, [self.tool], outlets, context)
        self.loop.guards = [UnlimitedGuard()]

    def use(self, *effects: Any, identity: str = "a", cloud: Any = "surface") -> None:
        data = prepare(self.organ, effects=effects, cloud=cloud, period=1.0 / RATE)
        self.loop.active = ActiveModel(identity, data, SETTINGS)

    def step(self, n: int = 1) -> np.ndarray:
        """Return force and torque of the last periods, shape (n, 6)."""
        for _ in range(n):
            self.loop._step()
        wrenches = [
            deserialize_message(raw, WrenchStamped) for raw in self.tool.publisher.sent[-n:]
        ]
        return np.array([_numbers(w.wrench.force) + _numbers(w.wrench.torque) for w in wrenches])

    def drag(self, along: np.ndarray) -> None:
        """Move the tool by 1 mm in 20 periods."""
        for _ in range(20):
            self.tool.tip += 5e-5 * along
            self.step()
        self.step(5)

    def clouds(self, n: int) -> np.ndarray:
        """Return points of the last clouds, shape (n, n_points, 6)."""
        messages = [deserialize_message(raw, PointCloud2) for raw in self.cloud.sent[-n:]]
        return np.array([np.frombuffer(m.data, np.float32).reshape(-1, 6) for m in messages])


def _numbers(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


@pytest.fixture
def bench(organ: Any, touch: tuple[np.ndarray, np.ndarray]) -> Iterator[Bench]:
    context = rclpy.Context()
    context.init()
    yield Bench(organ, touch[0], context)
    context.try_shutdown()


@pytest.fixture
def across(touch: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return a unit vector along the surface."""
    across = np.cross(touch[1], [0.0, 0.0, 1.0])
    return across / np.linalg.norm(across)


FRICTION = Friction(static=1.0, kinetic=1.0)
RELAXING = Viscoelasticity(g=(0.5,), tau=(0.2,))


@pytest.mark.parametrize(("timeout", "periods"), [(0.02, 5), (0.004, 1)])
def test_without_a_model_the_loop_steps_seldom_but_sees_every_stream(
    bench: Bench, timeout: float, periods: int
) -> None:
    """A pose that waits for the next step must not look late."""
    loop = bench.loop
    loop.settings = replace(SETTINGS, pose_timeout=timeout)
    loop._step()
    assert loop._due - loop._step_start == pytest.approx(1e6 * periods, rel=0.5)
    bench.use()
    loop._step()
    assert loop._due - loop._step_start < 1.5e6
    assert loop.record.nominal == 1e6 * (1 + periods)


@pytest.mark.parametrize("reason", ["a model", "a tool", "the end"])
def test_alone_it_sleeps_until_it_is_woken(bench: Bench, reason: str) -> None:
    """It may sleep long; the shortened period is neither late nor early."""
    loop, tool = bench.loop, bench.tool
    tool.connected = False
    loop._step()
    assert loop._due - loop._step_start >= 0.09e9
    loop._step_start -= 10 * 10**9  # as if it had slept for that long
    loop._due = loop._step_start + 3600 * 10**9
    loop.record = TimingRecord(loop._step_start)
    sleeper = threading.Thread(target=lambda: (loop._wait(), loop._step()), daemon=True)
    sleeper.start()
    if reason == "a model":
        bench.use()
    if reason == "the end":
        loop.stop()
    else:
        tool.connected = reason == "a tool"
        loop.wake()
    sleeper.join(60.0 * slowness())
    assert not sleeper.is_alive()
    assert 10e9 <= loop.record.nominal <= loop.record.periods[0]
    assert loop.record.n_missed == 0


def test_the_force_moves_linearly_from_one_selection_of_effects_to_the_next(
    bench: Bench, across: np.ndarray
) -> None:
    bench.use(FRICTION)
    bench.step(5)
    bench.drag(across)  # it sticks
    old = bench.step()[-1]
    bench.use()
    felt = np.vstack([old, bench.step(N_BLEND + 20)])
    new = felt[-1]
    apart = np.linalg.norm((new - old)[:3])
    assert apart > 0.05
    changes = np.linalg.norm(np.diff(felt[:, :3], axis=0), axis=1)
    print(f"\nfriction to bare: {apart:.4f} N apart, largest change a period {changes.max():.6f} N")
    # nothing moves and nothing relaxes: exactly linear, except for rounding
    np.testing.assert_allclose(changes[:N_BLEND], apart / N_BLEND, rtol=1e-6)
    np.testing.assert_allclose(changes[N_BLEND:], 0.0, atol=1e-12)
    part = np.linspace(0.0, 1.0, N_BLEND + 1)[:, None]
    np.testing.assert_allclose(felt[: N_BLEND + 1], old + part * (new - old), atol=1e-9)


def test_bare_to_viscoelastic_and_back_changes_no_faster_than_it_relaxes(bench: Bench) -> None:
    bench.use()
    bench.step(5)
    for effects in ((RELAXING,), ()):
        old = bench.step()[-1]
        bench.use(*effects)
        felt = np.vstack([old, bench.step(3 * N_BLEND)])[:, :3]
        changes = np.linalg.norm(np.diff(felt, axis=0), axis=1)
        span = np.linalg.norm(felt.max(axis=0) - felt.min(axis=0))
        print(f"\nto {effects}: {span:.4f} N, largest change a period {changes.max():.6f} N")
        # g/tau of the force a second while it relaxes; the models are at most `span` apart
        relaxing = np.linalg.norm(felt, axis=1).max() * 0.5 / 0.2 / RATE
        assert changes.max() < span / N_BLEND + relaxing
        assert changes[-1] < relaxing


def test_the_cloud_moves_linearly_too(bench: Bench, across: np.ndarray) -> None:
    bench.use(FRICTION)
    bench.step(5)
    bench.drag(across)
    old = bench.clouds(1)[0]
    bench.use()
    bench.step(N_BLEND + 2)
    clouds = np.concatenate([[old], bench.clouds(N_BLEND + 2)])
    new = clouds[-1]
    assert np.abs(new - old).max() > 1e-4
    part = np.linspace(0.0, 1.0, N_BLEND + 1)[:, None, None]
    # single precision of numbers up to 0.3 m, rounded three times
    np.testing.assert_allclose(clouds[: N_BLEND + 1], old + part * (new - old), atol=1e-7)


def test_a_cloud_of_another_size_comes_at_once(bench: Bench) -> None:
    bench.use()
    bench.step(5)
    bench.use(cloud="volume")
    bench.step(3)
    assert len(bench.clouds(1)[0]) == len(bench.organ.mesh.vertices)
    bench.use(cloud="off")
    n_sent = len(bench.cloud.sent)
    bench.step(3)
    assert len(bench.cloud.sent) == n_sent


def test_a_tip_deep_in_the_organ_stays_in_contact(bench: Bench, touch: Any) -> None:
    bench.use()
    for depth in np.linspace(0.0, 10e-3, 60):  # a new contact may begin 5 mm deep at most
        bench.tool.tip[:] = touch[0] - depth * touch[1]
        bench.step()
    before = bench.step()[-1]
    assert before.any()
    bench.use(FRICTION)
    after = bench.step(N_BLEND + 5)[-1]
    assert np.linalg.norm(after[:3]) > 0.5 * np.linalg.norm(before[:3])


def test_a_replaced_model_is_let_go(bench: Bench) -> None:
    bench.use()
    bench.step(3)
    bench.use(FRICTION)
    bench.loop._running = True
    assert bench.loop.is_changing
    bench.step(N_BLEND - 1)
    assert bench.loop.is_changing
    bench.step()
    assert not bench.loop.is_changing


def test_the_first_model_is_there_at_once(bench: Bench) -> None:
    assert not bench.step().any()
    bench.use()
    assert bench.step()[-1].any()


def test_a_turn_drags_tissue_only_with_friction(
    bench: Bench, across: np.ndarray, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    drag = {}
    for effects in ((), (FRICTION,)):
        bench.use(*effects)
        before = bench.step(N_BLEND + 5)[-1]
        # about such an axis the lowest point of the tip, at -n, moves along `across`
        for _ in range(20):
            turn = Rotation.from_rotvec(5e-3 * np.cross(across, touch[1]))
            bench.tool.orientation = (turn * Rotation.from_quat(bench.tool.orientation)).as_quat()
            after = bench.step(1)[-1]
        held = bench.step(5)[-1]
        np.testing.assert_allclose(held, after, atol=1e-6)  # a turn is used once
        drag[len(effects)] = float((after - before)[:3] @ across)
    assert abs(drag[0]) < 1e-9
    assert drag[1] < -0.02  # the tissue holds it back
