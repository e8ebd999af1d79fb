"""A node of a cell ends in any way and is started again: the earlier state returns."""

from __future__ import annotations

import json
import resource
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped

from avatar_interfaces.msg import ContactState, LoopStatistics, VademecumInfo
from avatar_interfaces.srv import InterpolatePatient, LoadScene, LoadVademecum
from avatar_ros.framework import qos
from avatar_ros.framework.parameters import ParameterError
from avatar_ros.framework.saved_state import SavedState
from tests.helpers.slowness import end_of, wait_until
from tests.ros.conftest import START_TIMEOUT, Probe
from tests.ros.helpers.fault_cell import FaultCell
from tests.ros.helpers.hand import force_of, stamp_of
from tests.ros.helpers.parameters import parameter_values, set_parameters

CHOSEN = {"material.young_modulus": 0.25e6, "safety.max_force": 4.0}
SCENE = "{name: blunt, tools: [{name: tool, tip: {shape: sphere, radius: 4e-3}}]}"
HOW = {"kill -9": signal.SIGKILL, "SIGINT": signal.SIGINT}


class State:
    """State of a cell as others see it."""

    def __init__(self, probe: Any) -> None:
        self._probe = probe

    def choose(self, name: str) -> str:
        """Choose another vademecum, material, limit and scene; return the vademecum's id."""
        ask = self._probe.call
        info = ask(LoadVademecum, "load_vademecum", LoadVademecum.Request(name=name)).info
        self.force(info.id)
        scene = ask(LoadScene, "load_scene", LoadScene.Request(yaml=SCENE))
        assert scene.success, scene.message
        soft = np.linalg.norm(self.force(info.id))
        self.set(CHOSEN)
        stiffer = lambda: np.linalg.norm(self.force(info.id)) >= 1.1 * soft  # noqa: E731
        wait_until(stiffer, START_TIMEOUT)  # in use after some tenths of a second
        return str(info.id)

    def set(self, values: dict[str, float]) -> None:
        assert all(set_parameters(self._probe, "contact", values))

    def shows_fewer_modes(self, rank: int) -> None:
        """Check that a budget is in force: fewer modes than the rank are shown."""
        topic = qos.STATISTICS
        wanted = lambda window: 0 < window.modes < rank  # noqa: E731
        self._probe.next(LoopStatistics, "statistics", topic, wanted, 2 * START_TIMEOUT)

    def force(self, identity: str) -> np.ndarray:
        """Return the force on a still tool, once it is complete and nothing fades."""
        wrenches: dict[tuple[int, int], np.ndarray] = {}
        listener = self._probe.node.create_subscription(
            WrenchStamped,
            "tool/servo_cf",
            lambda w: wrenches.update({stamp_of(w): force_of(w)}),
            qos.COMMAND,
        )
        last: list[np.ndarray] = []

        def still(state: ContactState) -> bool:
            sound = state.vademecum_id == identity and state.status == ContactState.STATUS_OK
            if not (sound and state.contacts and state.force_share == 1.0):
                last.clear()
            elif stamp_of(state) in wrenches:
                last.append(wrenches[stamp_of(state)])
            return len(last) > 20 and bool(np.ptp(last[-20:], axis=0).max() < 1e-9)

        self._probe.next(ContactState, "contact_state", qos.state(1), still)
        self._probe.node.destroy_subscription(listener)
        return last[-1]

    def parameters(self) -> dict[str, Any]:
        return parameter_values(self._probe, "contact", CHOSEN)


@pytest.fixture(scope="module")
def state_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("state")


@pytest.fixture(scope="module")
def cell(
    own_domain: dict[str, str],
    library: Path,
    folder: Path,
    touch: tuple[np.ndarray, np.ndarray],
    state_dir: Path,
) -> Iterator[FaultCell]:
    patient = ("pose_timeout:=0.5",)
    cell = FaultCell(library, folder, touch, own_domain, state_dir, 0.0, patient)
    cell.start("tool", 200.0)
    yield cell
    cell.close()


@pytest.fixture(scope="module")
def state(cell: FaultCell, own_domain: dict[str, str]) -> Iterator[tuple[State, str]]:
    probe = Probe()
    state = State(probe)
    probe.next(ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id)
    yield state, state.choose("twin.h5")
    probe.close()


@pytest.mark.long
@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("name", ["loader", "contact", "patients"])
def test_what_is_started_again_goes_on_as_before(
    cell: FaultCell, state: tuple[State, str], probe: Probe, name: str, how: str
) -> None:
    seen, identity = state
    before = seen.force(identity)
    assert np.linalg.norm(before) > 0.1
    cell.processes[name].send_signal(HOW[how])
    end_of(cell.processes.pop(name), START_TIMEOUT)
    cell.start(name)
    if name == "patients":
        wrong = InterpolatePatient.Request(surface="nowhere.obj")
        answer = probe.call(InterpolatePatient, "interpolate_patient", wrong)
        assert not answer.success and "nowhere.obj" in answer.message
    if name == "loader":  # sent to late listeners, too
        info = probe.next(VademecumInfo, "vademecum_info", qos.LATCHED)
        assert info.id == identity
    after = seen.force(identity)
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-9)
    assert seen.parameters() == CHOSEN
    print(
        f"\n{how} of {name}: |F| {np.linalg.norm(before):.6f} N, then {np.linalg.norm(after):.6f}"
    )


def wait_until_kept(file: Path, name: str) -> None:
    """Wait until a changed parameter is written, which happens after it is in force."""
    kept = lambda: name in json.loads(file.read_text())["changed"]  # noqa: E731
    wait_until(kept, START_TIMEOUT, f"{name} was not kept in {file}")


@pytest.mark.long
def test_a_budget_is_in_force_again(
    cell: FaultCell, state: tuple[State, str], organ: Any, state_dir: Path
) -> None:
    seen, identity = state
    seen.set({"accuracy.tolerance": 1.0})
    seen.shows_fewer_modes(organ.n_modes)
    wait_until_kept(state_dir / "contact.json", "accuracy.tolerance")
    before = seen.force(identity)
    cell.end("contact")
    cell.start("contact")
    seen.force(identity)
    seen.shows_fewer_modes(organ.n_modes)
    np.testing.assert_allclose(seen.force(identity), before, rtol=1e-6, atol=1e-9)


# --- The file ------------------------------------------------------------------------------------


class Started:
    """Stand-in for a node with a directory for its state."""

    def __init__(self, folder: Path) -> None:
        self.said: list[str] = []
        self._folder = folder

    def get_logger(self) -> Any:
        return type("Logger", (), {"error": self.said.append})

    def get_parameter(self, name: str) -> Any:
        assert name == "state_dir"
        return type("Value", (), {"value": str(self._folder)})

    def get_fully_qualified_name(self) -> str:
        return "/left/contact"


def test_a_change_comes_back_at_the_same_start_alone(tmp_path: Path) -> None:
    node: Any = Started(tmp_path)
    started = {"stiffness": 1.0, "scene": ""}
    SavedState(node, started).save({"stiffness": 2.0, "scene": ""})
    assert SavedState(node, started).load() == {"stiffness": 2.0}
    assert SavedState(node, started | {"scene": "palpation"}).load() == {}
    assert [file.name for file in tmp_path.iterdir()] == ["left.contact.json"]


def test_a_broken_file_is_named_and_not_used(tmp_path: Path) -> None:
    node: Any = Started(tmp_path)
    for text in ("", "[]", '{"started": {"a": 1}}', '{"started"'):
        (tmp_path / "left.contact.json").write_text(text)
        assert SavedState(node, {"a": 1}).load() == {}
        assert "left.contact.json not used" in node.said.pop()


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    node: Any = Started(tmp_path)
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, most))
    try:
        SavedState(node, {"a": 1}).save({"a": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    assert "left.contact.json" in node.said.pop()
    assert not list(tmp_path.iterdir())


def test_a_directory_is_made_and_a_file_is_refused(tmp_path: Path) -> None:
    node: Any = Started(tmp_path / "new" / "state")
    SavedState(node, {"a": 1}).save({"a": 2})
    assert list((tmp_path / "new" / "state").iterdir())
    (tmp_path / "file").touch()
    taken: Any = Started(tmp_path / "file")
    with pytest.raises(ParameterError, match="no directory"):
        SavedState(taken, {})
