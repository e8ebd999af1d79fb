"""Requests of the planning page to the other nodes.

Every method returns at once; it reports the outcome in one line of text, also when the node does
not run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from avatar_interfaces.action import BuildPatient
from avatar_interfaces.srv import LoadScene, LoadVademecum
from avatar_ros.loop.settings import MATERIAL

# how to start a node that does not run
START = {
    "contact": "the contact node is not running, so there is no force: "
    "start it with `ros2 run avatar_ros contact`",
    "vademecum_loader": "the loader is not running, so no organ can be chosen: "
    "start it with `ros2 run avatar_ros vademecum_loader`",
    "patient_interpolation": "the node that builds patients is not running: "
    "start it with an atlas, `avatar cell --atlas FOLDER`",
}
# parameters of the contact node, by coordinate
_PARAMETERS = {name: key for key, name in MATERIAL.items()}

Report = Callable[[str], None]
Progress = Callable[[str, float, float], None]


class Wanted(NamedTuple):
    """A patient to build, as in the goal of avatar_interfaces/action/BuildPatient.

    surface : file of the library; unit, axes : of its coordinates; empty: mm, and as it states
    tolerance : mean relative error of the displacement
    label, inside : labels of a label map for the organ and structures in it; empty: the only one
    groups : file of the library with clamp, access and springs; empty for those of the template
    supports : springs instead of the clamp, as on the command line; empty for the clamp
    preview : show the regions that would be held, and build nothing
    interpolated_first : first write an interpolated vademecum to the file
    """

    surface: str
    unit: str = ""
    axes: str = ""
    fidelity: str = ""
    tolerance: float = 0.0
    label: str = ""
    inside: tuple[str, ...] = ()
    groups: str = ""
    supports: tuple[str, ...] = ()
    preview: bool = False
    interpolated_first: bool = False


@dataclass
class _Build:
    """Callbacks of a build: text, and result; has_first: an interpolated vademecum is written."""

    report: Report
    then: Callable[[BuildPatient.Result | None], None]
    has_first: bool = False


class Requests:
    """Clients of the cell's services and of its action.

    The page calls from separate threads. Unlike a service's request, rclpy notes a goal only after
    sending it. An answer that the executor takes before is lost, and so is the build's end. So
    goals are sent in the executor's thread.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._load_vademecum = node.create_client(LoadVademecum, "load_vademecum")
        self._load_scene = node.create_client(LoadScene, "load_scene")
        self._set = node.create_client(SetParameters, "contact/set_parameters")
        self._get = node.create_client(GetParameters, "contact/get_parameters")
        self._build = ActionClient(node, BuildPatient, "build_patient")
        self._pending: _Build | None = None  # the running build
        self._goal: Any = None
        self._waiting: dict[str, float] = {}  # values of the material not sent yet
        self._setting = False
        self._switch: tuple[str, float] | None = None  # scene that was requested last, and when [s]

    def close(self) -> None:
        """Release the middleware's part of the action."""
        self._build.destroy()

    def contact_started(self) -> None:
        """Drop requests to a previous contact node, which nobody will answer."""
        self._waiting, self._setting, self._switch = {}, False, None

    @property
    def switching(self) -> tuple[str, float] | None:
        """Return the scene that is being prepared, and for how long [s]; None if none is."""
        if self._switch is None or not self._load_scene.service_is_ready():
            return None
        return self._switch[0], time.monotonic() - self._switch[1]

    @property
    def is_setting(self) -> bool:
        """Return whether values of the material are still on their way to the contact node."""
        return self._setting

    @property
    def missing(self) -> tuple[str, ...]:
        """Name the nodes whose services are not available."""
        ready = {
            "vademecum_loader": self._load_vademecum.service_is_ready(),
            "contact": self._load_scene.service_is_ready(),
            "patient_interpolation": self._build.server_is_ready(),
        }
        return tuple(name for name, is_ready in ready.items() if not is_ready)

    def load_vademecum(self, name: str, report: Report) -> None:
        """Make the loader announce a file of its library; the page shows it when announced."""
        if not self._load_vademecum.service_is_ready():
            report(START["vademecum_loader"])
            return
        report(f"loading {name} ...")

        def answered(done: Any) -> None:
            # the organ may come before the answer, and says more than "loaded"
            if failure := _outcome(done, ""):
                report(failure)

        request = LoadVademecum.Request(name=name)
        self._load_vademecum.call_async(request).add_done_callback(answered)

    def load_scene(
        self,
        name: str,
        report: Report,
        yaml: str = "",
        then: Callable[[bool], None] = lambda _: None,
    ) -> None:
        """Switch the scene, by name or by its text; call ``then`` with the success."""
        if not self._load_scene.service_is_ready():
            report(START["contact"])
            then(False)
            return
        report(f"preparing scene {name} ...")
        self._switch = switch = name, time.monotonic()
        request = LoadScene.Request(yaml=yaml) if yaml else LoadScene.Request(name=name)

        def answered(done: Any) -> None:
            if self._switch is switch:
                self._switch = None
            answer = done.result()
            effects = f" ({', '.join(answer.effects)})" if answer and answer.effects else ""
            report(_outcome(done, f"scene in use: {name}{effects}"))
            then(answer is not None and answer.success)

        self._load_scene.call_async(request).add_done_callback(answered)

    def set_material(
        self, values: dict[str, float], report: Report, refused: Callable[[], None] = lambda: None
    ) -> None:
        """Set values by coordinate; while a request is pending, only the newest are kept.

        refused : called if some were
        """
        self._waiting |= values
        if self._setting or not self._waiting:
            return
        if not self._set.service_is_ready():
            report(START["contact"])
            return
        chosen, self._waiting, self._setting = self._waiting, {}, True
        parameters = [_double(_PARAMETERS[name], value) for name, value in chosen.items()]

        def answered(done: Any) -> None:
            self._setting = False
            results = done.result().results if done.result() is not None else []
            refusals = [result.reason for result in results if not result.successful]
            report("; ".join(refusals) if refusals else "")
            if refusals:
                refused()
            self.set_material({}, report, refused)

        request = SetParameters.Request(parameters=parameters)
        self._set.call_async(request).add_done_callback(answered)

    def parameters_of_contact(
        self, names: Sequence[str], then: Callable[[dict[str, Any]], None]
    ) -> None:
        """Call ``then`` with parameters of the contact node, if it runs."""
        if not self._get.service_is_ready():
            return

        def answered(done: Any) -> None:
            if done.result() is not None:
                values = [parameter_value_to_python(value) for value in done.result().values]
                then(dict(zip(names, values, strict=False)))

        self._get.call_async(GetParameters.Request(names=list(names))).add_done_callback(answered)

    def build_patient(
        self,
        wanted: Wanted,
        progress: Progress,
        report: Report,
        then: Callable[[BuildPatient.Result | None], None],
        first: Callable[[str], None] = lambda file: None,
    ) -> None:
        """Build or preview a patient; call ``then`` with the result, None if there is none.

        first : called once with the interpolated file, if it was requested

        Only one build runs at a time; further requests are refused.
        """
        if self._pending is not None:
            report("a patient is being built already; cancel it first")
            return
        if not self._build.server_is_ready():
            report(START["patient_interpolation"])
            then(None)
            return
        goal = BuildPatient.Goal(**wanted._asdict())
        self._pending = pending = _Build(report, then)

        def note(message: Any) -> None:
            stage = message.feedback
            progress(stage.stage, stage.fraction, stage.error)
            if stage.file and not pending.has_first:
                pending.has_first = True
                first(stage.file)

        def finished(done: Any) -> None:
            result = done.result().result
            what = "previewed" if wanted.preview else f"{result.file} built"
            done_in = "; ".join([f"{what} in {result.seconds:.0f} s", *result.notices])
            report(done_in if result.success else result.message)
            self._end_build(pending, result if result.success else None)

        def accepted(done: Any) -> None:
            if not done.result().accepted:
                report("the patients' node refuses it; try again")
                self._end_build(pending, None)
                return
            self._goal = done.result()
            self._goal.get_result_async().add_done_callback(finished)

        self._in_executor(
            lambda: self._build.send_goal_async(goal, note).add_done_callback(accepted)
        )

    def _end_build(self, build: _Build, result: Any) -> None:
        if self._pending is build:  # it was not cancelled
            self._goal = self._pending = None
            build.then(result)

    def builder_is_missing(self) -> None:
        """End the running build: the patients' node is gone."""
        if self._pending is not None:
            self._pending.report(f"the patients' node ended; {START['patient_interpolation']}")
            self._end_build(self._pending, None)

    def cancel_patient(self) -> None:
        """Cancel the running build, if any."""

        def cancel() -> None:
            if self._goal is not None:
                self._goal.cancel_goal_async()

        self._in_executor(cancel)

    def _in_executor(self, do: Callable[[], object]) -> None:
        """Call in the thread that takes the answers."""
        assert self._node.executor is not None  # the executor runs the node
        self._node.executor.create_task(do)


def _double(name: str, value: float) -> Parameter:
    held = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    return Parameter(name=name, value=held)


def _outcome(done: Any, good: str) -> str:
    answer = done.result()
    if answer is None:
        return "no answer; try again"
    return good if answer.success else answer.message
