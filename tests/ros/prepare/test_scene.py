"""Scenes in the contact node: loaded while a tool presses, refused with a reason, faded in."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion, WrenchStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from avatar_core.errors import AvatarError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import read_scene, shipped_scene
from avatar_core.scene.yaml_lines import MAX_BYTES
from avatar_interfaces.msg import ContactState
from avatar_interfaces.srv import LoadScene
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.prepare.requests import PreparationRequest
from avatar_ros.prepare.scenes import model_spec
from tests.helpers.paths import PARAMS
from tests.helpers.slowness import Deadline
from tests.ros.conftest import START_TIMEOUT, free_domain
from tests.ros.helpers.answers import ROUNDING, took
from tests.ros.helpers.hand import Hand, force_of
from tests.ros.helpers.parameters import parameter_values
from tests.ros.prepare.test_material import _set

pytestmark = [pytest.mark.ros, pytest.mark.long]

SCENES = sorted((PARAMS / "scenes").glob("*.yaml"))
YOUNG = 0.17e6  # [Pa] of the organ
BARE = "name: bare"
FRICTION = "effects: {friction: {static: 1.0, kinetic: 1.0}}"
RELAXING = "effects: {viscoelasticity: {g: [0.5], tau: [0.2]}}"
ORDER = PreparationRequest("", "", "", (asdict(Tip()),), None, "surface", 1e-3)


class Palpation:
    """A tool on the organ, and the force on it."""

    def __init__(self, probe: Any, tip: np.ndarray, normal: np.ndarray) -> None:
        self.probe, self.tip, self.normal = probe, tip, normal
        self.across = np.cross(normal, [0.0, 0.0, 1.0])
        self.across /= np.linalg.norm(self.across)
        self.hand = Hand(probe, tip)
        self.felt: list[np.ndarray] = []
        every = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
        self._listener = probe.node.create_subscription(
            WrenchStamped, "tool/servo_cf", lambda w: self.felt.append(force_of(w)), every
        )
        self._timer = probe.node.create_timer(1e-3, self.hand)

    def close(self) -> None:
        self.probe.node.destroy_timer(self._timer)
        self.probe.node.destroy_subscription(self._listener)

    def go(self, offset: np.ndarray, seconds: float = 0.3) -> np.ndarray:
        """Move there in small steps, stay, and return the force."""
        p = self.hand.pose.pose.position
        start, end = np.array([p.x, p.y, p.z]), self.tip + offset
        for part in np.linspace(0.0, 1.0, 50):
            p.x, p.y, p.z = (1.0 - part) * start + part * end
            self.probe.spin(0.004)
        return self.hold(seconds)

    def hold(self, seconds: float = 0.3) -> np.ndarray:
        """Stay; return the last force."""
        self.felt.clear()
        self.probe.spin(seconds)
        self.probe.until(lambda: bool(self.felt), 10.0)
        return self.felt[-1]

    def settle(self, size: float) -> None:
        """Stay until the force has a size: a parameter is answered before its model is in use."""
        self.probe.until(
            lambda: np.linalg.norm(self.hold(0.05)) == pytest.approx(size, rel=1e-3), START_TIMEOUT
        )

    def feel(self, least: float) -> None:
        """Stay until the organ pushes back: a busy machine may lose some poses on the way."""
        self.probe.until(lambda: self.hold(0.05) @ self.normal > least, START_TIMEOUT)

    def load(self, yaml: str = "", name: str = "") -> LoadScene.Response:
        request = LoadScene.Request(yaml=yaml, name=name)
        return self.probe.call(LoadScene, "load_scene", request)

    def across_force(self, force: np.ndarray) -> float:
        return float(force @ self.across)


@pytest.fixture(scope="module")
def lasting_palpation(
    cell: Any, lasting_probe: Any, touch: tuple[np.ndarray, np.ndarray]
) -> Iterator[Palpation]:
    lasting_probe.next(
        ContactState, "contact_state", qos.state(1), lambda state: state.vademecum_id
    )
    tip, normal = touch
    palpation = Palpation(lasting_probe, tip + 2e-3 * normal, normal)
    yield palpation
    palpation.close()


@pytest.fixture
def palpation(lasting_palpation: Palpation) -> Palpation:
    """Press a bare organ by 2 mm, without traces of earlier tests."""
    assert lasting_palpation.load(BARE).success
    lasting_palpation.hand.pose.pose.orientation = Quaternion(w=1.0)
    lasting_palpation.go(np.zeros(3), 0.05)
    return lasting_palpation


def _refusal(path: Path, organ: Any) -> str:
    """Return why the organ of the tests cannot serve a scene; empty if it can."""
    try:
        what = model_spec(organ, ORDER, read_scene(path))
        what.layout(what.finest, ORDER.period)
    except AvatarError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_shipped_scene_loads_or_says_why_not(
    palpation: Palpation, organ: Any, path: Path
) -> None:
    assert shipped_scene(path.stem).read_text() == path.read_text()
    refusal = _refusal(path, organ)
    asked = time.monotonic()
    answer = palpation.load(name=path.stem)
    assert answer.success == (not refusal)
    if refusal:
        assert answer.message == refusal
    else:  # faded in meanwhile
        seconds = took(answer.message, "in use")
        assert 0.0 < seconds <= time.monotonic() - asked + ROUNDING
    expected = [] if refusal else [effect.name for effect in read_scene(path).effects]
    assert answer.effects == expected
    if not refusal:  # press it by 2 mm with the scene's tip
        offset = read_scene(path).tools[0].tip.offset
        palpation.go((offset - Tip().offset) * palpation.normal)
        palpation.feel(0.1)


def test_most_shipped_scenes_load_here(organ: Any) -> None:
    served = {path.stem for path in SCENES if not _refusal(path, organ)}
    assert served >= {"breathing", "needle_probe", "palpation", "relaxation"}


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({}, "both are empty"),
        ({"yaml": BARE, "name": "palpation"}, "not both"),
        ({"name": "nothing"}, "come with avatar: breathing, "),
        ({"name": "../contact"}, "come with avatar: "),
        ({"name": "/etc/passwd"}, "come with avatar: "),
        ({"yaml": "effects: [fricton]"}, "yaml:1: effects.fricton is unknown; did you mean"),
        ({"yaml": "effects: [large_deformation]"}, "--material"),
        ({"yaml": "effects: {viscoelasticity: {file: prony.csv}}"}, "this scene is no file"),
        ({"yaml": "outputs: {modes: 5000}"}, "5000 modes"),
        ({"yaml": "tools: [{name: a}, {name: b}]\neffects: [several_tools]"}, "parameter tools"),
        ({"yaml": "\0"}, "both are empty"),  # a string ends there in transport
        ({"yaml": "#" * (MAX_BYTES + 1)}, f"at most {MAX_BYTES}"),
        ({"yaml": "\U0001f600" * MAX_BYTES}, "with less"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_bad_scene_is_refused_and_the_node_goes_on(
    palpation: Palpation, asked: dict[str, str], reason: str
) -> None:
    before = palpation.hold()
    answer = palpation.load(**asked)
    assert not answer.success
    assert reason in answer.message
    assert "\n" not in answer.message
    assert answer.effects == []  # as before
    np.testing.assert_allclose(palpation.hold(), before, rtol=1e-3)


def test_with_friction_a_turning_tool_drags_the_tissue(palpation: Palpation) -> None:
    assert palpation.load(FRICTION).success
    before = palpation.across_force(palpation.hold())

    def is_dragged() -> bool:
        """Return whether the turn drags it: a busy machine may lose its poses."""
        # the tip's lowest point moves along `across`: turn x (-n) = across
        _turn_by(palpation, 0.2 * np.cross(palpation.across, palpation.normal))
        force = palpation.hold()
        return palpation.across_force(force) < before - 0.1 * abs(force @ palpation.normal)

    palpation.probe.until(is_dragged, START_TIMEOUT)


def test_without_friction_a_turning_tool_feels_the_same(palpation: Palpation) -> None:
    before = palpation.hold()
    _turn_by(palpation, 0.2 * palpation.across)
    np.testing.assert_allclose(palpation.hold(), before, rtol=1e-6)


def _turn_by(palpation: Palpation, vector: np.ndarray) -> None:
    q = palpation.hand.pose.pose.orientation
    angle = np.linalg.norm(vector)
    for part in np.linspace(0.0, angle, 50):
        q.x, q.y, q.z = np.sin(part / 2) * vector / angle
        q.w = np.cos(part / 2)
        palpation.probe.spin(0.004)


def test_a_scene_brings_its_material_and_a_parameter_goes_before_it(palpation: Palpation) -> None:
    probe = palpation.probe
    before = np.linalg.norm(palpation.hold())
    assert palpation.load(f"material: {{young_modulus: {2 * YOUNG}}}").success
    assert np.linalg.norm(palpation.hold()) == pytest.approx(2 * before, rel=1e-3)
    assert _set(probe, young_modulus=3 * YOUNG).successful
    palpation.settle(3 * before)
    assert palpation.load(BARE).success  # the parameter stays
    assert np.linalg.norm(palpation.hold()) == pytest.approx(3 * before, rel=1e-3)
    assert _set(probe, young_modulus=0.0).successful
    palpation.settle(before)


def test_a_scene_brings_its_cloud(palpation: Palpation, organ: Any) -> None:
    probe = palpation.probe
    answer = palpation.load("outputs: {cloud: volume, cloud_divisor: 20}")
    assert answer.success
    n_vertices = len(organ.mesh.vertices)
    probe.next(PointCloud2, "deformation", qos.NEWEST, lambda c: c.width == n_vertices, 10.0)
    kept = parameter_values(probe, "contact", ["cloud_divisor"])
    assert kept == {"cloud_divisor": 20}
    assert palpation.load(BARE).success
    n_surface = len(organ.surface_vertices)
    probe.next(PointCloud2, "deformation", qos.NEWEST, lambda c: c.width == n_surface, 10.0)


@pytest.mark.parametrize(("before", "after"), [(FRICTION, BARE), (RELAXING, BARE)])
def test_the_force_does_not_jump_when_effects_change(
    palpation: Palpation, before: str, after: str
) -> None:
    """A jump would be there each time; wrenches that do not arrive only look like one."""
    for _ in range(5):
        assert palpation.load(before).success
        palpation.go(np.zeros(3), 0.05)
        old = palpation.go(1.5e-3 * palpation.across, 1.0)
        palpation.felt.clear()
        assert palpation.load(after).success
        palpation.probe.spin(0.3)
        felt = np.array(palpation.felt)
        apart = np.linalg.norm(felt[-1] - old)
        largest = np.linalg.norm(np.diff(felt, axis=0), axis=1).max()
        print(f"\n{len(felt)} wrenches, {apart:.4f} N apart, largest change {largest:.5f} N")
        assert apart > 0.02
        if largest < 0.1 * apart:  # 1/100 for each period
            break
    assert largest < 0.1 * apart


def test_a_preparing_process_that_ends_is_said_and_replaced(
    cell: dict[str, Module], palpation: Palpation
) -> None:
    probe, before = palpation.probe, palpation.hold()
    (child,) = _children(cell["contact"].pid)
    os.kill(child, signal.SIGSTOP)
    request = LoadScene.Request(yaml=FRICTION)
    answer = probe.client(LoadScene, "load_scene").call_async(request)
    probe.spin(0.5)
    os.kill(child, signal.SIGKILL)
    probe.until(answer.done, 20.0)
    assert "ended; ask again" in answer.result().message
    np.testing.assert_allclose(palpation.hold(), before, rtol=1e-3)
    probe.until(lambda: palpation.load(FRICTION).success, 60.0)  # at first without vademecum


def _children(pid: int) -> list[int]:
    lists = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return [int(child) for text in lists for child in text.split()]


def test_the_scene_may_be_a_parameter(own_domain: dict[str, str], library: Path) -> None:
    files = ["-p", f"library_dir:={library}", "-p", "vademecum:=liver.h5"]
    with free_domain() as number:
        domain = own_domain | {"ROS_DOMAIN_ID": str(number)}
        loader = Module("vademecum_loader", ["--ros-args", *files], domain)
        contact = Module("contact", ["--ros-args", "-p", "scene:=relaxation"], domain)
        try:
            passed = Deadline(START_TIMEOUT)
            while "with viscoelasticity" not in contact.said():
                assert not passed, contact.said()
                time.sleep(0.2)
        finally:
            codes = [process.finish() for process in (contact, loader)]
    assert codes == [0, 0]
