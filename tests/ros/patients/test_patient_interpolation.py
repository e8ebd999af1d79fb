"""A patient's vademecum by service and by action: built, refused, cancelled, killed half-way."""

from __future__ import annotations

import math
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import DescribeParameters
from rclpy.action import ActionClient, get_action_server_names_and_types_by_node
from shape_msgs.msg import Mesh

from avatar_core.atlas.anatomy import WholeAnatomy
from avatar_core.atlas.storage import load_atlas, save_anatomy, save_frame
from avatar_core.common.child import computed_by
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.vademecum.storage import load_vademecum
from avatar_interfaces.action import BuildPatient
from avatar_interfaces.msg import ContactState
from avatar_interfaces.srv import InterpolatePatient, LoadVademecum
from avatar_ros.bench.cell import Module
from avatar_ros.bench.footprint import children
from avatar_ros.framework import qos
from avatar_ros.framework.conversions import surface_mesh
from tests.helpers.processes import has_ended
from tests.helpers.slowness import end_of, within
from tests.ros.conftest import newcomer
from tests.ros.helpers.answers import took
from tests.ros.helpers.doc_pages import index, offered, parameter_rows, yaml_parameters
from tests.ros.helpers.parameters import parameter_names, parameter_values
from tests.ros.helpers.refusals import refusal

pytestmark = pytest.mark.long  # it builds an atlas and starts nodes

NODE = "patient_interpolation"
# a member of the atlas that does not count: registered already, meshed and combined anew
PATIENT: dict[str, Any] = {"surface": "liver0.obj", "leave_out": ["liver0"]}
TIMEOUT = 60.0  # for one patient, on a busy machine [s]
INTERPOLATED = 30.0  # processor time from file to file, as the README says [s]


def _values(folder: Path, *more: str) -> list[str]:
    return [f"atlas:={folder / 'atlas'}", f"library_dir:={folder}", "vertices:=350", *more]


def _start(environment: dict[str, str], folder: Path, *more: str, remap: str = "") -> Module:
    options = [word for value in _values(folder, *more) for word in ("-p", value)]
    options += ["-r", remap] if remap else []
    return Module(NODE, ["--ros-args", *options], environment)


@pytest.fixture(scope="module")
def node(own_domain: dict[str, str], folder: Path) -> Iterator[Module]:
    process = _start(own_domain, folder, "max_megabytes:=1", "certify:=4")
    yield process
    assert process.finish() == 0


@pytest.fixture(scope="module")
def probe(lasting_probe: Any) -> Any:
    return lasting_probe


@pytest.fixture
def files(folder: Path) -> Callable[[], set[str]]:
    """Return a function that lists the library, hidden files too."""
    return lambda: set(os.listdir(folder))


def _ask(probe: Any, **fields: Any) -> InterpolatePatient.Response:
    request = InterpolatePatient.Request(**fields)
    return probe.call(InterpolatePatient, "interpolate_patient", request)


class Pursuit:
    """Goal on its way: its feedback, cancellation and result."""

    def __init__(self, probe: Any, **fields: Any) -> None:
        self._probe = probe
        self._client = ActionClient(probe.node, BuildPatient, "build_patient")
        probe.until(self._client.server_is_ready, TIMEOUT)
        self.told: list[BuildPatient.Feedback] = []
        accepted = self._client.send_goal_async(
            BuildPatient.Goal(**fields), lambda message: self.told.append(message.feedback)
        )
        probe.until(accepted.done, TIMEOUT)
        self._goal = accepted.result()
        assert self._goal.accepted
        self._answer = self._goal.get_result_async()

    def until(self, stage: str) -> None:
        self._probe.until(lambda: any(told.stage.startswith(stage) for told in self.told), TIMEOUT)
        assert not self._answer.done()

    def cancel(self) -> None:
        answer = self._goal.cancel_goal_async()
        self._probe.until(answer.done, TIMEOUT)
        assert answer.result().goals_canceling

    def result(self) -> tuple[int, BuildPatient.Result]:
        self._probe.until(self._answer.done, TIMEOUT)
        answer = self._answer.result()
        self._client.destroy()
        return answer.status, answer.result


# --- results ----------------------------------------------------------------------------------


def test_the_service_writes_what_loader_and_contact_take(
    node: Module, own_domain: dict[str, str], probe: Any, folder: Path
) -> None:
    assert not _ask(probe, surface="missing.obj").success  # the atlas is loaded
    (worker,) = children(node.pid)
    before = computed_by(worker)
    answer = _ask(probe, **PATIENT, name="first")
    assert computed_by(worker) - before < INTERPOLATED
    assert (answer.success, answer.file) == (True, "first.h5"), answer.message
    assert took(answer.message, "written") == pytest.approx(answer.seconds, abs=0.01)
    assert set(answer.neighbors) == {"liver1", "liver2"}
    assert sum(answer.weights) == pytest.approx(1.0, abs=1e-9)
    assert answer.weight_abs_sum == pytest.approx(np.abs(answer.weights).sum())
    assert answer.hull_distance > 0.0
    assert 0.0 <= answer.volume_error < 0.5
    assert 0.0 < answer.displacement_error < 1.0  # the certificate's
    assert answer.seconds > 0.0
    vademecum = load_vademecum(folder / answer.file)
    assert (vademecum.id, vademecum.name) == (answer.vademecum_id, "liver0")

    loader = Module("vademecum_loader", ["--ros-args", "-p", f"library_dir:={folder}"], own_domain)
    contact = Module("contact", [], own_domain)
    try:
        loaded = probe.call(
            LoadVademecum, "load_vademecum", LoadVademecum.Request(name=answer.file)
        )
        assert (loaded.success, loaded.info.id) == (True, answer.vademecum_id)
        probe.next(
            ContactState,
            "contact_state",
            qos.state(1),
            lambda state: state.vademecum_id == answer.vademecum_id,
        )
    finally:
        assert (loader.finish(), contact.finish()) == (0, 0)


@pytest.mark.long
def test_a_member_is_recognised_and_keeps_its_volume(node: Module, probe: Any) -> None:
    answer = _ask(probe, surface="liver1.obj", unit="mm", axes="RAS")
    assert answer.success, answer.message
    assert answer.file == "liver1-interpolated.h5"
    assert (answer.neighbors[0], answer.weights[0]) == ("liver1", 1.0)
    assert answer.volume_error == 0.0
    assert any("the patient is liver1" in notice for notice in answer.notices)


@pytest.mark.long
def test_a_mesh_in_the_request_is_built_by_the_action(
    node: Module, probe: Any, folder: Path, livers: list[SurfaceMesh]
) -> None:
    mesh = surface_mesh(livers[-1].vertices, livers[-1].faces)
    pursuit = Pursuit(probe, mesh=mesh, neighbors=2, fidelity="reduced", tolerance=0.2)
    status, result = pursuit.result()
    assert (status, result.success) == (GoalStatus.STATUS_SUCCEEDED, True), result.message
    assert took(result.message, "written") == pytest.approx(result.seconds, abs=0.01)
    assert result.file == "mesh-reduced.h5"
    assert len(result.neighbors) == 2
    assert load_vademecum(folder / result.file).id == result.vademecum_id
    stages = [told.stage.split(":")[0] for told in pursuit.told]
    stages = list(dict.fromkeys(stages))
    order = ["loading", "surface", "registration", "mesh", "response", "certify", "save"]
    # messages before discovery are lost
    assert stages == order[order.index(stages[0]) :]
    assert "mesh" in stages
    assert all(0.0 <= told.fraction <= 1.0 for told in pursuit.told)
    assert any(told.error > 0.0 for told in pursuit.told)  # the estimate of the reduced space


@pytest.mark.long
def test_springs_are_previewed_and_hold_what_is_built(
    node: Module, probe: Any, folder: Path
) -> None:
    springs = ["cava_groove=1e7", "right_triangular=clamped", "bare_area"]
    asked = PATIENT | {"fidelity": "reduced", "tolerance": 0.2, "supports": springs}
    status, shown = Pursuit(probe, **asked, preview=True).result()
    assert (status, shown.success) == (GoalStatus.STATUS_SUCCEEDED, True), shown.message
    regions = np.array(shown.regions)
    # 1 clamped, 2 accessible, from 3 on the springs by their place in the request
    assert set(regions) == {0, 1, 2, 3, 5}
    status, built = Pursuit(probe, **asked, name="sprung").result()
    assert built.success, built.message
    vademecum = load_vademecum(folder / "sprung.h5")
    stiffness = {spring.name: spring.stiffness for spring in vademecum.supports}
    assert stiffness == {"cava_groove": 1e7, "bare_area": 1e6}
    held = {spring.name: spring.faces for spring in vademecum.supports}
    np.testing.assert_array_equal(held["bare_area"], regions == 5)
    np.testing.assert_array_equal(vademecum.regions.clamped, regions == 1)


def test_an_interpolated_patient_is_there_first(node: Module, probe: Any, folder: Path) -> None:
    """It can be loaded while the better one is solved, which then has its name."""
    asked = PATIENT | {"fidelity": "reduced", "tolerance": 0.2, "name": "first"}
    pursuit = Pursuit(probe, **asked, interpolated_first=True)
    probe.until(lambda: any(told.file for told in pursuit.told), TIMEOUT)
    first = load_vademecum(folder / "first.h5")
    assert {told.file for told in pursuit.told} == {"", "first.h5"}
    status, built = pursuit.result()
    assert (status, built.file) == (GoalStatus.STATUS_SUCCEEDED, "first.h5"), built.message
    better = load_vademecum(folder / "first.h5")
    assert better.certificate.l2_mean < first.certificate.l2_mean
    assert len(first.mesh.vertices) != len(better.mesh.vertices)  # the template's mesh
    registered = [told.stage for told in pursuit.told if told.file].count("registration")
    assert registered <= 1  # begun, but known: the template is registered once
    held = {"interpolated_first": True, "supports": ["bare_area"], "fidelity": "reduced"}
    status, refused = Pursuit(probe, **PATIENT, **held).result()
    assert status == GoalStatus.STATUS_ABORTED and "interpolated_first" in refused.message


def test_a_preview_shows_what_the_template_does_not_reach(
    node: Module, probe: Any, folder: Path
) -> None:
    """A thin tip of 2 cm."""
    lines = (folder / "liver0.obj").read_text().splitlines()
    points = np.array([line.split()[1:] for line in lines if line.startswith("v")], float)
    tip = int(np.argmax(points[:, 0]))
    x, y, z = points[tip] + [20.0, 0.0, 0.0]
    lines[tip] = f"v {x} {y} {z}"
    (folder / "pointed.obj").write_text("\n".join(lines))
    asked = {"surface": "pointed.obj", "fidelity": "interpolated", "preview": True}
    _, found = Pursuit(probe, **asked).result()
    assert found.success, found.message
    shown = np.array([[point.x, point.y, point.z] for point in found.missed.vertices])
    assert len(found.missed.triangles) > 2
    assert np.linalg.norm(shown - 1e-3 * np.array([x, y, z]), axis=1).min() < 1e-6
    assert any("off the surface" in line for line in found.notices)


# --- pages ------------------------------------------------------------------------------------


def test_services_and_actions_are_those_of_the_pages(node: Module) -> None:
    rows = [row for row in index() if row["node"] == NODE]
    named = {row["interface"]: row["type"] for row in rows if row["kind"] == "srv"}
    documented = {f"/{name}": kind for name, kind in named.items()}
    actions = [(f"/{row['interface']}", [row["type"]]) for row in rows if row["kind"] == "action"]
    assert documented and len(actions) == 1

    def seen(graph: Any) -> tuple[dict[str, str], list[Any]]:
        """Return an action's topics; they may be discovered after the services."""
        found = {name: kind for name, kind, _ in offered(graph, NODE) if "_action" not in name}
        if not found:  # nor the node itself
            return {}, []
        return found, get_action_server_names_and_types_by_node(graph, NODE, "/")

    with newcomer(lambda graph: seen(graph) == (documented, actions)) as one:
        assert seen(one.node) == (documented, actions)


def test_parameters_are_those_of_page_and_yaml_file(node: Module, probe: Any) -> None:
    declared = parameter_names(probe, NODE)
    assert declared == set(parameter_rows(NODE))
    request = DescribeParameters.Request(names=sorted(declared))
    described = probe.ask(DescribeParameters, f"/{NODE}/describe_parameters", request)
    assert all(one.description and one.read_only for one in described.descriptors)
    values = yaml_parameters(NODE)
    assert set(values) == declared
    given = {"atlas", "library_dir", "max_megabytes", "vertices", "certify"}  # by this test
    names = declared - given
    assert parameter_values(probe, NODE, names) == {name: values[name] for name in names}


# --- refusals ---------------------------------------------------------------------------------


def _box(side: float) -> Mesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return surface_mesh(side * corners, np.array(faces))


def _without(mesh: Mesh, what: str) -> Mesh:
    """Return the mesh, damaged."""
    if what == "lid":
        mesh.triangles = mesh.triangles[2:]
    elif what == "number":
        mesh.vertices[0].x = math.nan
    elif what == "vertex":
        mesh.vertices = mesh.vertices[:-1]
    elif what == "faces":
        mesh.triangles = []
    return mesh


BAD_REQUESTS: list[tuple[dict[str, Any], str]] = [
    ({}, "both are empty"),
    ({"surface": "liver0.obj", "mesh": _box(0.2)}, "not both"),
    ({"surface": "../liver0.obj"}, "inside library_dir"),
    ({"surface": "/etc/hostname"}, "inside library_dir"),
    ({"surface": "link.obj"}, "link out of library_dir"),
    ({"surface": "missing.obj"}, "No such file"),
    ({"surface": "large.obj"}, "raise max_megabytes"),
    ({"surface": "text.obj"}, "text.obj"),
    ({"surface": "foreign.h5"}, "foreign.h5"),
    ({**PATIENT, "neighbors": -1}, "neighbors is -1"),
    ({**PATIENT, "tolerance": math.nan}, "tolerance is nan"),
    ({**PATIENT, "fidelity": "exact"}, "unknown fidelity 'exact'"),
    ({**PATIENT, "unit": "m"}, "expected 0.05 to 0.5 m"),
    ({**PATIENT, "leave_out": ["nobody"]}, "no anatomy 'nobody'"),
    ({**PATIENT, "leave_out": ["liver0", "liver1", "liver2"]}, "no anatomy is left"),
    ({**PATIENT, "supports": ["bare_area"]}, "choose reduced or solved"),
    ({**PATIENT, "fidelity": "reduced", "supports": ["bare_area=1e5:1e9"]}, "one stiffness each"),
    ({**PATIENT, "fidelity": "reduced", "supports": ["nowhere"]}, "NAME alone for one of"),
    ({**PATIENT, "name": "../escaped"}, "plain file name"),
    ({**PATIENT, "name": "x" * 300}, "shorter"),
    ({**PATIENT, "name": "foreign.h5"}, "is no vademecum; choose another name"),
    ({"mesh": _box(0.2), "unit": "mm"}, "given in m and RAS"),
    ({"mesh": _without(_box(0.2), "lid")}, "open"),
    ({"mesh": _without(_box(0.2), "number")}, "mesh-interpolated"),
    ({"mesh": _without(_box(0.2), "vertex")}, "vertex 8 of 7"),
    ({"mesh": _without(_box(0.2), "faces")}, "no triangles"),
]


@pytest.mark.parametrize(("fields", "reason"), BAD_REQUESTS, ids=[r for _, r in BAD_REQUESTS])
def test_a_bad_request_is_answered_in_one_line(
    node: Module, probe: Any, files: Any, fields: dict[str, Any], reason: str
) -> None:
    before = files()
    answer = _ask(probe, **fields)
    assert not answer.success
    assert reason in answer.message
    assert "\n" not in answer.message
    assert (answer.file, answer.vademecum_id) == ("", "")
    assert files() == before


def test_a_bad_goal_is_aborted_with_the_reason(node: Module, probe: Any) -> None:
    status, result = Pursuit(probe, surface="missing.obj").result()
    assert status == GoalStatus.STATUS_ABORTED
    assert not result.success
    assert "No such file" in result.message


def test_a_wrong_parameter_ends_the_node(own_domain: dict[str, str], folder: Path) -> None:
    process = _start(own_domain, folder, "atlas:=/nowhere.h5")
    assert end_of(process, TIMEOUT) == 1
    assert "no atlas at /nowhere.h5" in process.last_line()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["atlas:=''"], "parameter atlas"),
        (["atlas:=/nowhere"], "no atlas at /nowhere"),
        (["atlas:=SHAPES"], "no anatomy of the atlas has a response"),
        (["library_dir:=/nowhere"], "is no directory"),
        (["weighting:=nearest"], "kriging"),
        (["max_megabytes:=2000"], "from 1 to 1999"),
    ],
    ids=["none", "missing", "shapes", "library", "weighting", "megabytes"],
)
def test_a_wrong_parameter_is_refused(
    own_domain: dict[str, str], folder: Path, tmp_path: Path, arguments: list[str], reason: str
) -> None:
    if "atlas:=SHAPES" in arguments:
        atlas, shapes = load_atlas(folder / "atlas"), tmp_path / "shapes"
        shapes.mkdir()
        save_frame(shapes, atlas.frame, "")
        for shape, distances in zip(atlas.anatomies, atlas.vectors, strict=True):
            save_anatomy(shapes, WholeAnatomy(shape, distances))
        arguments = [f"atlas:={shapes}"]
    assert reason in refusal(NODE, *_values(folder, *arguments))


# --- during a build ---------------------------------------------------------------------------


@pytest.mark.parametrize("stage", ["", "mesh", pytest.param("response", marks=pytest.mark.long)])
def test_a_goal_can_be_cancelled_in_every_stage(
    node: Module, probe: Any, files: Any, stage: str
) -> None:
    before = files()
    pursuit = Pursuit(probe, **PATIENT, fidelity="solved", name="cancelled")
    pursuit.until(stage)
    busy = _ask(probe, **PATIENT)
    assert not busy.success
    assert busy.message.startswith("busy with cancelled.h5")
    with within(3.0):
        pursuit.cancel()
        status, result = pursuit.result()
    assert status == GoalStatus.STATUS_CANCELED
    assert (result.success, result.message) == (False, "cancelled; no file was written")
    assert files() == before


def test_deactivating_cancels_and_activating_serves_again(
    node: Module, probe: Any, files: Any
) -> None:
    def change(transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(probe.call(ChangeState, f"{NODE}/change_state", request).success)

    before = files()
    client = probe.client(InterpolatePatient, "interpolate_patient")
    client.call_async(InterpolatePatient.Request(**PATIENT, fidelity="solved", name="ended"))
    probe.spin(1.0)
    assert change(Transition.TRANSITION_DEACTIVATE)
    assert files() == before
    assert "inactive" in _ask(probe, surface="missing.obj").message
    assert change(Transition.TRANSITION_ACTIVATE)
    assert "missing.obj" in _ask(probe, surface="missing.obj").message
    assert node.poll() is None


@pytest.mark.long
def test_the_end_of_the_building_process_is_said_and_survived(
    node: Module, probe: Any, files: Any
) -> None:
    before = files()
    pursuit = Pursuit(probe, **PATIENT, name="lost")
    pursuit.until("mesh")
    (helper,) = children(node.pid)
    os.kill(helper, signal.SIGKILL)
    status, result = pursuit.result()
    assert status == GoalStatus.STATUS_ABORTED
    assert "Killed" in result.message
    assert files() == before
    assert _ask(probe, surface="liver1.obj").success


@pytest.mark.parametrize(
    "number", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.long)]
)
def test_ending_the_node_half_way_leaves_nothing_behind(
    own_domain: dict[str, str], probe: Any, files: Any, folder: Path, library: Path, number: int
) -> None:
    loadable = Path(shutil.copy(library / "liver.h5", folder / "there-before.h5"))
    process = _start(own_domain, folder, remap="__ns:=/other")
    loader = Module("vademecum_loader", ["--ros-args", "-p", f"library_dir:={folder}"], own_domain)
    try:
        before = files()
        client = probe.client(InterpolatePatient, "other/interpolate_patient")
        probe.until(lambda: any(children(process.pid)), TIMEOUT)
        probe.spin(3.0)  # until it has the atlas
        client.call_async(InterpolatePatient.Request(**PATIENT, name="killed"))
        probe.spin(1.0)
        (helper,) = children(process.pid)
        process.send_signal(number)
        assert end_of(process, 3.0) == (0 if number == signal.SIGINT else -number)
        probe.until(lambda: has_ended(helper), 5.0)
        assert files() == before
        request = LoadVademecum.Request(name=loadable.name)
        assert probe.call(LoadVademecum, "load_vademecum", request).success
    finally:
        loadable.unlink()
        process.finish()
        assert loader.finish() == 0
