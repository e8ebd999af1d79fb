"""Start, transitions and end of the nodes' processes, alone, installed and as `avatar cell`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

from avatar_core.cli.cell import cell
from avatar_interfaces.msg import ContactState, LoopStatistics, VademecumFile, VademecumInfo
from avatar_interfaces.srv import LoadVademecum
from avatar_ros.bench.cell import Module
from avatar_ros.bench.footprint import children
from avatar_ros.framework import qos
from avatar_ros.framework.conversions import vademecum_file
from avatar_ros.nodes.cell import node_arguments, wait_after
from tests.helpers.slowness import end_of, wait_until
from tests.ros.conftest import START_TIMEOUT
from tests.ros.helpers.doc_pages import ROOT
from tests.ros.helpers.refusals import refusal
from tests.ros.helpers.running import EXECUTABLES, running


def _state(probe: Any, node: str) -> str:
    return str(probe.ask(GetState, f"{node}/get_state", GetState.Request()).current_state.label)


def _change(probe: Any, node: str, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(probe.call(ChangeState, f"{node}/change_state", request).success)


def _is_silent(probe: Any, kind: type, topic: str, seconds: float = 0.5) -> bool:
    heard: list[Any] = []
    subscription = probe.node.create_subscription(kind, topic, heard.append, qos.COMMAND)
    probe.spin(seconds)
    probe.node.destroy_subscription(subscription)
    return not heard


def test_without_vademecum_the_wrench_is_zero_and_a_broken_one_changes_nothing(
    own_domain: dict[str, str], probe: Any
) -> None:
    with running("contact", own_domain) as process:
        state = probe.next(ContactState, "contact_state", qos.state(1))
        assert state.status == ContactState.STATUS_NO_MODEL
        assert (state.vademecum_id, list(state.contacts)) == ("", [])
        wrench = probe.next(WrenchStamped, "tool/servo_cf", qos.COMMAND)
        assert wrench == WrenchStamped(header=wrench.header)
        assert wrench.header.frame_id == "organ"
        assert (wrench.header.stamp.sec, wrench.header.stamp.nanosec) == (0, 0)
        window = probe.next(LoopStatistics, "statistics", 1)
        assert 0.0 < window.rate < 250.0  # there is no force that could be late
        publisher = probe.node.create_publisher(VademecumFile, "vademecum", qos.LATCHED)
        publisher.publish(vademecum_file("0" * 64, "forged", b"x" * 1000))
        probe.until(lambda: "'forged' refused" in process.said(), 30.0)
        state = probe.next(ContactState, "contact_state", qos.state(1))
        assert state.status == ContactState.STATUS_NO_MODEL


def test_it_reports_in_simulated_time_without_a_clock(
    own_domain: dict[str, str], probe: Any
) -> None:
    with running("contact", own_domain, "use_sim_time:=true"):
        probe.next(LoopStatistics, "statistics", qos.STATISTICS, timeout=20.0)
        probe.next(DiagnosticArray, "/diagnostics", qos.STATISTICS, timeout=20.0)


def test_two_tools_have_topics_of_their_own(own_domain: dict[str, str], probe: Any) -> None:
    values = ["tools:=[left,right]", "tip.radius:=[0.004,0.008]"]
    values += ["tip.shape:=[sphere,cone]", "tip.half_angle:=[0.0,60.0]"]
    with running("contact", own_domain, *values):
        for tool in ("left", "right"):
            probe.next(WrenchStamped, f"{tool}/servo_cf", qos.COMMAND)
            probe.next(ContactState, "contact_state", qos.state(2), lambda s, t=tool: s.tool == t)


def test_the_contact_node_is_managed(own_domain: dict[str, str], probe: Any) -> None:
    topic = "tool/servo_cf"
    with running("contact", own_domain, "autostart:=false"):
        assert _state(probe, "contact") == "unconfigured"
        for _ in range(2):  # once more after cleaning up
            assert _change(probe, "contact", Transition.TRANSITION_CONFIGURE)
            assert _change(probe, "contact", Transition.TRANSITION_ACTIVATE)
            probe.next(WrenchStamped, topic, qos.COMMAND)
            assert _change(probe, "contact", Transition.TRANSITION_DEACTIVATE)
            assert _is_silent(probe, WrenchStamped, topic)
            assert _change(probe, "contact", Transition.TRANSITION_CLEANUP)
            assert _state(probe, "contact") == "unconfigured"
            probe.until(lambda: probe.node.count_publishers(topic) == 0, 5.0)


@pytest.mark.long  # it builds an organ
def test_an_inactive_loader_keeps_the_organ_that_was_loaded(
    own_domain: dict[str, str], library: Path, probe: Any
) -> None:
    """Inactive, it keeps the organ of a request; cleaned up, it begins with that of its start."""

    def announced() -> str:
        """Return the name that a late listener hears."""
        return str(probe.next(VademecumInfo, "vademecum_info", qos.LATCHED).name)

    values = [f"library_dir:={library}", "vademecum:=liver.h5"]
    with running("vademecum_loader", own_domain, *values):
        first = announced()
        request = LoadVademecum.Request(name="twin.h5")
        assert probe.call(LoadVademecum, "load_vademecum", request).success
        assert (announced(), first) == ("twin", "phantom")
        heard: list[str] = []
        listener = probe.node.create_subscription(
            VademecumInfo, "vademecum_info", lambda info: heard.append(info.name), qos.LATCHED
        )
        assert _change(probe, "vademecum_loader", Transition.TRANSITION_DEACTIVATE)
        assert announced() == "twin"
        assert not probe.call(LoadVademecum, "load_vademecum", request).success
        assert _change(probe, "vademecum_loader", Transition.TRANSITION_ACTIVATE)
        assert announced() == "twin"
        assert set(heard) == {"twin"}
        assert probe.call(LoadVademecum, "load_vademecum", request).success
        probe.node.destroy_subscription(listener)
        for transition in (
            Transition.TRANSITION_DEACTIVATE,
            Transition.TRANSITION_CLEANUP,
            Transition.TRANSITION_CONFIGURE,
            Transition.TRANSITION_ACTIVATE,
        ):
            assert _change(probe, "vademecum_loader", transition)
        assert announced() == first


WRONG = [
    ("contact", ["rate:=5.0"], "from 100 to 2000"),
    ("contact", ["rate:=fast"], "rate"),
    ("contact", ["tools:=[a b]"], "topic's name"),
    ("contact", ["cloud:=fog"], "surface, volume, off"),
    ("contact", ["frame_id:=''"], "frame_id"),
    ("contact", ["scene:=nowhere"], "come with avatar: breathing"),
    ("contact", ["scene:=/nowhere.yaml"], "No such file"),
    ("contact", ["scene:=two_tools"], "set the parameter tools"),
    ("vademecum_loader", ["library_dir:=/nowhere"], "not a directory"),
    ("vademecum_loader", ["vademecum:=missing.h5"], "No such file"),
    ("vademecum_loader", ["max_megabytes:=0"], "from 1 to 65536"),
    ("contact", ["tip.radius:=0.5"], "tip.*: tip: radius is 0.5; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=0.0"], "radius is 0.0; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=.nan"], "radius is nan; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=true"], "radius is True; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=wide"], "radius is wide; it must lie in 0.001 to 0.02 m"),
    ("contact", ["tip.radius:=[0.005,0.005]"], "tip.radius: there are 2 values; give one"),
    ("contact", ["tip.shape:=ball"], "shape 'ball' is unknown; choose sphere, flat, cone"),
    ("contact", ["tip.shape:=3"], "shape '3' is unknown; choose sphere, flat, cone"),
    ("contact", ["tip.shape:=cone"], "cone needs half_angle; give one"),
    ("contact", ["tip.shape:=cone", "tip.half_angle:=90.0"], "must lie in 10 to 85 deg"),
    ("contact", ["tip.shape:=cone", "tip.half_angle:=.nan"], "must lie in 10 to 85 deg"),
    ("contact", ["tip.shape:=flat", "tip.half_angle:=60.0"], "does not use half_angle; leave it"),
    ("contact", ["tip.rounding:=0.001"], "sphere does not use rounding; leave it out"),
]


@pytest.mark.parametrize(("node", "arguments", "reason"), WRONG)
def test_a_wrong_parameter_is_refused(
    own_domain: dict[str, str], node: str, arguments: list[str], reason: str
) -> None:
    said = refusal(node, *arguments)
    assert reason in said and "\n" not in said


# refused when it is declared, and when the node is configured
@pytest.mark.long
@pytest.mark.parametrize(("node", "arguments", "reason"), [WRONG[0], WRONG[5], WRONG[9]])
def test_a_wrong_parameter_ends_the_node(
    own_domain: dict[str, str], node: str, arguments: list[str], reason: str
) -> None:
    options = [word for argument in arguments for word in ("-p", argument)]
    process = Module(node, ["--ros-args", *options], own_domain)
    assert end_of(process, 60.0) == 1
    assert reason in process.last_line()


# --- The executables of the installation, as `ros2 run` finds them --------------------------------
# The prefix is that of the Python that runs the tests; CI makes it afresh, as the README says.

END = 2.0  # from a signal to the end [s]
PREFIX = Path(sys.prefix)
# without an atlas, which takes minutes to make, that node waits to be configured
ARGUMENTS = {"patient_interpolation": ["--ros-args", "-p", "autostart:=false"]}
STATES = {"patient_interpolation": "unconfigured"}


@pytest.fixture
def shell(own_domain: dict[str, str]) -> dict[str, str]:
    """Return the environment of a user's shell after the README's export, in the tests' domain."""
    kept = ("HOME", "LANG", "NUMBA_CACHE_DIR", "TMPDIR")
    environment = {name: os.environ[name] for name in kept if name in os.environ}
    environment |= {name: value for name, value in own_domain.items() if name.startswith("ROS_")}
    return environment | {
        "AMENT_PREFIX_PATH": str(PREFIX),
        "PATH": f"{PREFIX / 'bin'}:/usr/bin:/bin",
    }


def _run(shell: dict[str, str], code: str) -> str:
    command = [str(PREFIX / "bin" / "python"), "-c", code]
    return subprocess.run(
        command, env=shell, cwd="/", check=True, capture_output=True, text=True
    ).stdout.strip()


@pytest.mark.long
def test_the_prefix_is_found_by_ament(shell: dict[str, str]) -> None:
    code = "from ament_index_python.packages import get_package_prefix as p; print(p('avatar_ros'))"
    assert Path(_run(shell, code)).resolve() == PREFIX.resolve()
    for wanted in (
        "avatar_ros/package.xml",
        "avatar_ros/launch/planning_cell.launch.py",
        "avatar_params/planning_cell.yaml",
    ):
        assert (PREFIX / "share" / wanted).is_file()


@pytest.mark.long
def test_the_executables_are_those_that_are_documented() -> None:
    assert {path.name for path in (PREFIX / "lib" / "avatar_ros").iterdir()} == EXECUTABLES


def executable(name: str) -> list[str]:
    """Return the command that `ros2 run` starts."""
    return [str(PREFIX / "lib" / "avatar_ros" / name)]


def module(name: str) -> list[str]:
    """Return the README's command in its place without `ros2`."""
    return [str(PREFIX / "bin" / "python"), "-m", f"avatar_ros.nodes.{name}"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "number"),
    [(executable, signal.SIGINT), (executable, signal.SIGTERM), (module, signal.SIGINT)],
    ids=["executable-SIGINT", "executable-SIGTERM", "module-SIGINT"],
)
@pytest.mark.parametrize("name", sorted(EXECUTABLES))
def test_a_node_starts_without_ros2_and_ends_cleanly(
    shell: dict[str, str],
    lasting_probe: Any,
    name: str,
    command: Callable[[str], list[str]],
    number: signal.Signals,
) -> None:
    if name == "planning_ui":
        pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
    begin = time.monotonic()
    process = subprocess.Popen(
        [*command(name), *ARGUMENTS.get(name, [])],
        env=shell,
        cwd="/",
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        state = lasting_probe.ask(GetState, f"{name}/get_state", GetState.Request())
        started = time.monotonic() - begin
        assert state.current_state.label == STATES.get(name, "active")
        begin = time.monotonic()
        process.send_signal(number)
        assert end_of(process, END) == 0
        ended = time.monotonic() - begin
    finally:
        process.kill()
        _, said = process.communicate()
    print(f"{name}, {number.name}: answers after {started:.2f} s, ended after {ended:.2f} s")
    assert "Traceback" not in said
    assert "rror" not in said


# --- All nodes from one file, which end together --------------------------------------------------


@contextmanager
def started(arguments: list[str], domain: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    command = [
        sys.executable,
        "-c",
        "from avatar_core.cli.main import main; raise SystemExit(main())",
    ]
    process = subprocess.Popen(
        [*command, "cell", *arguments], cwd="/", env=domain, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_one_file_of_parameters_starts_a_cell_that_a_signal_ends(
    own_domain: dict[str, str], library: Path, tmp_path: Path, probe: Any, number: int
) -> None:
    file = tmp_path / "cell.yaml"
    text = (ROOT / "params" / "planning_cell.yaml").read_text()
    text = text.replace("library_dir: . # nothing", f"library_dir: {library} # nothing")
    text = text.replace('vademecum: "" # file', "vademecum: liver.h5 # file")
    file.write_text(text)
    with started(["--params", str(file)], own_domain) as process:
        probe.next(
            ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id, START_TIMEOUT
        )
        begin = time.monotonic()
        process.send_signal(number)
        assert end_of(process, 15.0) == 0
        print(f"ended in {time.monotonic() - begin:.1f} s")


def child(process: subprocess.Popen[str], node: str) -> int | None:
    """Return the number of the cell's process of a node."""
    for number in children(process.pid):
        if f"avatar_ros.nodes.{node}".encode() in Path(f"/proc/{number}/cmdline").read_bytes():
            return number
    return None


@pytest.mark.long
def test_a_node_that_dies_is_started_again_and_named(
    own_domain: dict[str, str], library: Path, probe: Any
) -> None:
    def model() -> None:
        """Wait for a step of the contact node with the model."""
        probe.next(
            ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id, START_TIMEOUT
        )

    arguments = ["--library-dir", str(library), "--vademecum", "liver.h5"]
    with started(arguments, own_domain) as process:
        model()
        killed = child(process, "contact")
        assert killed is not None
        os.kill(killed, signal.SIGKILL)
        wait_until(lambda: not Path(f"/proc/{killed}").exists(), 10.0, "the cell did not notice")
        model()
        assert child(process, "contact") not in (None, killed)
        process.send_signal(signal.SIGINT)
        assert end_of(process, 15.0) == 0
        assert process.stderr is not None
        said = process.stderr.read()
    assert "contact died of SIGKILL; starting it again" in said
    assert "vademecum_loader" not in said.replace("[vademecum_loader]", "")


def test_a_node_that_dies_again_and_again_is_given_time() -> None:
    assert [wait_after(deaths) for deaths in range(1, 9)] == [0, 1, 2, 4, 8, 16, 30, 30]


@pytest.mark.long
def test_a_node_that_refuses_to_start_ends_the_cell_and_is_named(
    own_domain: dict[str, str], tmp_path: Path
) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("contact:\n  ros__parameters: {rate: 5.0}\n")
    with started(["--params", str(file)], own_domain) as process:
        assert end_of(process, START_TIMEOUT) == 1
        assert process.stderr is not None
        said = process.stderr.read()
    assert "contact ended with code 1; ending the cell" in said
    assert "parameter rate" in said


def test_page_and_patients_run_only_if_asked_for() -> None:
    always = {"vademecum_loader", "contact"}
    assert set(node_arguments(None, {})) == always
    assert set(node_arguments(None, {"atlas": "atlas.h5"})) == {*always, "patient_interpolation"}
    kept = node_arguments(None, {"state_dir": "/kept"})
    assert all(kept[node][-1] == "state_dir:=/kept" for node in always)
    both = node_arguments(None, {"tools": "left,right"})
    assert both["contact"][-1] == "tools:=[left,right]" and both["vademecum_loader"] == []
    page = node_arguments(None, {"ui": "yes", "port": "8081"})
    assert set(page) == {*always, "planning_ui"}
    assert page["planning_ui"][-1] == "port:=8081"


def test_paths_are_those_of_where_it_was_called(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nodes start in another folder."""
    (tmp_path / "drag.yaml").write_text("")
    ran: list[list[str]] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "execv", lambda _, command: ran.append(command))
    cell(scene="drag.yaml")
    os.chdir(tmp_path)
    cell(scene="palpation", params=tmp_path / "p.yaml", tools="left,right")
    by_file, by_name = (" ".join(command[3:]) for command in ran)
    assert by_file == f"--library_dir {tmp_path} --scene {tmp_path / 'drag.yaml'}"
    assert by_name == f"--params {tmp_path / 'p.yaml'} --tools left,right --scene palpation"
