"""The contact node: poses of tools in; force on each tool and deformation of the organ out.

Three threads of control:

- the loop (:mod:`avatar_ros.loop.contact_loop`, a thread) waits for a pose, steps, publishes.
- the node (``ContactNode``, the main thread) handles parameters, transitions and statistics.
- the supplier (:mod:`avatar_ros.prepare.supplier`, a thread with a worker process) prepares the
  model of a vademecum, and prepares it again for another scene, material or uncertainty.
"""

from __future__ import annotations

import threading
import time
from dataclasses import asdict, replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage

from avatar_core.common.array_table import gathered
from avatar_core.common.jit import load_compiler
from avatar_core.common.supports import SUPPORT
from avatar_core.contact import model as contact
from avatar_core.contact.force_band import ForceBand
from avatar_core.contact.layout import MODEL
from avatar_core.errors import AccuracyError, CoordinateError, SceneError, one_line
from avatar_core.haptics import passivity
from avatar_core.reduction.coordinates import RESECTION, option_of
from avatar_core.uncertainty.distributions import Distribution, mappings
from avatar_core.uncertainty.known import Held
from avatar_core.vademecum.accuracy import AccuracyCurve
from avatar_interfaces.msg import ContactState, LoopStatistics
from avatar_interfaces.srv import LoadScene
from avatar_ros.framework import qos, realtime
from avatar_ros.framework.managed_node import ManagedNode, run
from avatar_ros.framework.parameters import ParameterError
from avatar_ros.framework.saved_state import SavedState
from avatar_ros.loop.contact_loop import BLEND, ActiveModel, ContactLoop, Publishers
from avatar_ros.loop.device import ToolDevice, devices
from avatar_ros.loop.jaw import JAW, chosen_jaw
from avatar_ros.loop.safety import SAFETY, chosen_safety
from avatar_ros.loop.settings import (
    CHANGEABLE,
    CONTACT,
    MATERIAL,
    UNSET,
    LoopSettings,
    chosen_budget,
    chosen_known,
)
from avatar_ros.loop.shown_modes import ShownModes
from avatar_ros.loop.statistics import TimingRecord
from avatar_ros.loop.tool_channel import ToolChannel, tool_channels
from avatar_ros.nodes import contact_frames
from avatar_ros.nodes.contact_parameters import read_contact
from avatar_ros.nodes.contact_reports import REPORT_PERIOD, ContactReports
from avatar_ros.prepare import scenes
from avatar_ros.prepare.requests import Change, PreparationRequest, PreparedModel
from avatar_ros.prepare.supplier import SUPERSEDED, ModelSupplier

_BUDGET = ("accuracy.tolerance", "accuracy.quantity", "accuracy.deadline")
_GRACE = 0.1  # time for which a replaced model is kept after the last step that uses it [s]
_LEAST_YOUNG = 1.0  # [Pa], as in a scene


class ContactNode(ManagedNode):
    """Parameters, transitions and services; ``ContactLoop`` does the work."""

    def __init__(self) -> None:
        self._loop: ContactLoop | None = None
        self._supplier: ModelSupplier | None = None
        self._tools: list[ToolChannel] = []
        self._devices: list[ToolDevice] = []
        self._outputs: Publishers | None = None
        self._frames: Any = None  # publisher of the static transforms
        self._reports: ContactReports | None = None  # while the node is active
        # ranges of the material in the vademecum in use
        self._ranges: dict[str, tuple[float, float]] | None = None
        self._held: Held | None = None  # its parameters that may have distributions
        self._told: tuple[str, ...] = ()  # notices on values of the material that it does not hold
        self._n_awaited = 0
        self._changing = threading.RLock()
        super().__init__("contact", CONTACT)
        self._state = SavedState(self, self._values((*CHANGEABLE, "scene"), []))
        self._scene = self._restore(self._state.load())  # YAML, overrides the parameter
        # Exists as long as the node; reentrant, because an answer may take a minute.
        self.create_service(
            LoadScene, "load_scene", self._load_scene, callback_group=ReentrantCallbackGroup()
        )
        self.add_on_set_parameters_callback(self._change_parameters)
        self.add_post_set_parameters_callback(lambda changes: self._save_state())

    @property
    def failure(self) -> str:
        """Return why the loop ended; empty while it runs."""
        return "" if self._loop is None else self._loop.failure

    @property
    def has_pending_answers(self) -> bool:
        """Return whether scenes are still being loaded."""
        return self._n_awaited > 0

    def configure(self) -> None:
        """Make the loop, its topics and the supplier of models."""
        settings = self._settings()
        if settings.scene:
            self._set_cloud_divisor(settings.cloud_divisor)
        period = 1.0 / settings.rate
        self._tools = tool_channels(self.ports, settings)
        self._devices = devices(self, settings, self._tools)
        self._outputs = Publishers(
            self.ports.publisher(
                ContactState, "contact_state", qos.states(len(self._tools), period)
            ),
            self.ports.publisher(PointCloud2, "deformation", qos.clouds(period)),
            self.ports.publisher(LoopStatistics, "statistics", qos.reports(REPORT_PERIOD)),
            self.ports.publisher(DiagnosticArray, "/diagnostics", qos.reports(REPORT_PERIOD)),
        )
        self._frames = self.create_publisher(TFMessage, contact_frames.TOPIC, qos.LATCHED)
        self._loop = ContactLoop(settings, self._tools, self._outputs, self.context)
        request = PreparationRequest(
            topic=self.resolve_topic_name("vademecum"),
            node_name=f"_{self.get_name()}_handover",
            namespace=self.get_namespace(),
            tips=tuple(asdict(tip) for tip in settings.tips),
            modes=settings.modes,
            cloud=settings.cloud,
            period=period,
            material=settings.material,
            scene=settings.scene,
            uncertainty=mappings(settings.known),
        )
        self._supplier = ModelSupplier(request, self._take_model, self.get_logger().error)
        load_compiler()  # while the worker starts
        if settings.safety.passivity != "off":
            passivity.warm_up()
        self._save_state()

    def _settings(self) -> LoopSettings:
        """Read parameters and saved scene; drop the scene if it no longer fits."""
        try:
            return read_contact(self, self._scene)
        except ParameterError as error:
            if not self._scene:
                raise
            self.get_logger().error(f"the saved scene is not used: {error}")
            self._scene = ""
            return read_contact(self)

    def activate(self) -> None:
        """Start the loop, the reports and the commands to devices."""
        assert self._loop is not None and self._outputs is not None
        settings = self._loop.settings
        stamp = self.get_clock().now().to_msg()
        self._frames.publish(contact_frames.static_transforms(settings, stamp))
        granted = realtime.claim(settings.priority, settings.cpu, settings.lock_memory)
        for refusal in granted.refusals:
            self.get_logger().warning(refusal)
        realtime.tune_interpreter()
        self._loop.record = TimingRecord(time.monotonic_ns())
        self._loop.start(granted.cpu)
        for device in self._devices:
            device.begin()
        self._reports = ContactReports(
            self, self._loop, self._tools, self._devices, self._outputs, self.ports
        )
        self._reports.start()
        limits = settings.safety.limits
        self.get_logger().info(
            f"forces of at most {limits.force:g} N and {limits.slew:g} N/s "
            f"({self.get_parameter('safety.device').value}; safety.device, safety.max_*)"
        )

    def deactivate(self) -> None:
        """Stop the reports and the loop."""
        if self._reports is not None:
            self._reports.stop()
            self._reports = None
        if self._loop is not None:
            self._loop.stop()

    def clean_up(self) -> None:
        """Stop the supplier and remove all topics."""
        if self._supplier is not None:
            self._supplier.stop()
            self._supplier = None
            self._scene = ""
        self._loop = None
        jaws = [tool.jaw for tool in self._tools if tool.jaw is not None]
        ends: list[Any] = [*self._tools, *self._devices, *jaws]
        for end in ends:
            self.destroy_subscription(end.subscription)
            self.destroy_publisher(end.publisher)
        for publisher in (p for tool in self._tools for p in tool.band_publishers):
            self.destroy_publisher(publisher)
        for publisher in (*(vars(self._outputs).values() if self._outputs else ()), self._frames):
            self.destroy_publisher(publisher)
        self._tools, self._devices, self._outputs, self._frames = [], [], None, None

    def _take_model(self, prepared: PreparedModel) -> None:
        """Put a model into use between two steps; called in the supplier's thread.

        Returns once it has entirely replaced the one before.
        """
        loop = self._loop
        if loop is None:
            return
        data = contact.ContactModel(gathered(MODEL, prepared.arrays)).data()
        replaced = loop.active
        self._ranges, self._held = prepared.ranges, Held.of_plain(prepared.held)
        curve = AccuracyCurve.of_plain(prepared.curve) if prepared.curve else None
        shown_modes = ShownModes(data, curve)
        try:
            shown_modes.keep(loop.settings.budget)
        except AccuracyError as error:
            self.get_logger().error(f"accuracy.*: {error}; all modes are shown")
        band = ForceBand.of(data, prepared.arrays)
        loop.active = ActiveModel(
            prepared.id, data, loop.settings, prepared.effects, shown_modes, band
        )
        loop.wake()
        what = ", ".join(prepared.effects) or "no effects"
        self.get_logger().info(
            f"vademecum {prepared.name!r} ({prepared.id[:12]}) in use, with {what}; "
            f"{shown_modes.accuracy}"
        )
        self._tell(prepared.notices)
        while loop.is_changing:
            time.sleep(BLEND / 4)
        time.sleep(_GRACE)
        del replaced  # frees its memory here, not in the loop

    def _tell(self, notices: tuple[str, ...]) -> None:
        """Report once which values of the material do not apply to the vademecum in use."""
        for notice in notices:
            if notice not in self._told:
                self.get_logger().warning(f"{notice}; it stays as built")
        self._told = notices

    async def _load_scene(
        self, request: LoadScene.Request, response: LoadScene.Response
    ) -> LoadScene.Response:
        begin = time.monotonic()
        try:
            prepared = await self._in_use(scenes.change_of(request))
            if prepared.cloud_divisor is not None:
                self._set_cloud_divisor(prepared.cloud_divisor)
            self._scene = self._supplier.scene if self._supplier is not None else ""
            self._save_state()
            response.message = f"in use after {time.monotonic() - begin:.2f} s"
            response.success = True
        # a service always answers; the text decides which error is raised
        except Exception as error:
            response.message = one_line(error)
            self.get_logger().error(f"load_scene: {response.message}")
        if self._loop is not None:
            response.effects = list(self._loop.active.effects)
        return response

    def _restore(self, kept: dict[str, Any]) -> str:
        """Set the saved parameters; return the saved scene, or an empty string."""
        scene = str(kept.pop("scene", ""))
        try:
            chosen_known(str(kept.get("uncertainty", "")))
        except ParameterError as error:  # the file may be missing
            self.get_logger().error(f"a saved value is not used: {error}")
            del kept["uncertainty"]
        for result in self.set_parameters([Parameter(n, value=v) for n, v in kept.items()]):
            if not result.successful:
                self.get_logger().error(f"a saved value is not used: {result.reason}")
        if scene or kept:
            named = [*sorted(kept), *(["the scene"] if scene else [])]
            self.get_logger().info(f"continues with {', '.join(named)} of the last run (state_dir)")
        return scene

    def _save_state(self) -> None:
        """Save the values in use for the next start."""
        with self._changing:
            if self._supplier is None:
                return
            now = self._values(CHANGEABLE, [])
            now["scene"] = self._scene or self.get_parameter("scene").value
            self._state.save(now)

    def _set_cloud_divisor(self, divisor: int) -> None:
        """Set a scene's divisor as the parameter, which may change later."""
        self.set_parameters([Parameter("cloud_divisor", value=divisor)])

    async def _in_use(self, change: Change) -> PreparedModel:
        """Wait until a change of the model is in use, while the executor keeps running.

        Raises
        ------
        SceneError
            If the change was refused.
        """
        executor, supplier = self.executor, self._supplier
        assert executor is not None  # the executor runs this callback
        if supplier is None or self._reports is None:
            raise SceneError("the node is inactive; activate it first")
        done = Future(executor=executor)

        def answer(prepared: PreparedModel | None, refusal: str) -> None:
            if prepared is None:
                done.set_exception(SceneError(refusal))
            else:
                done.set_result(prepared)
            executor.wake()

        self._n_awaited += 1
        try:
            supplier.ask(change, answer)
            return await done
        finally:
            self._n_awaited -= 1

    def _change_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        """Apply changes whose type and range were checked, from the next step on.

        A change of the material takes some tenths of a second, in the worker process.
        """
        with self._changing:
            return self._change(changes)

    def _change(self, changes: list[Parameter]) -> SetParametersResult:
        loop = self._loop
        if loop is None:
            return SetParametersResult(successful=True)
        settings = loop.settings
        try:
            budget = chosen_budget(self._values(_BUDGET, changes))
            safety = chosen_safety(self._values(tuple(p.name for p in SAFETY), changes))
            jaw = chosen_jaw(self._values(tuple(p.name for p in JAW), changes))
            known = settings.known
            for change in changes:
                if change.name == "uncertainty":  # the file may have changed
                    known = chosen_known(change.value)
        except (AccuracyError, ParameterError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        refusal = self._refusal_of_known(known, settings.known)
        if refusal:
            return SetParametersResult(successful=False, reason=refusal)
        wanted = {MATERIAL[p.name]: p for p in changes if p.name in MATERIAL}
        given = {name: p.value for name, p in wanted.items() if p.value != UNSET[p.name]}
        material = {k: v for k, v in settings.material.items() if k not in wanted} | given
        for name, value in given.items():
            refusal = self._refusal_of(name, value, material)
            if refusal:
                return SetParametersResult(successful=False, reason=refusal)
        try:
            if budget != settings.budget and loop.active.shown_modes is not None:
                loop.active.shown_modes.keep(budget)
        except AccuracyError as error:
            return SetParametersResult(successful=False, reason=one_line(error))
        changed = {p.name: p.value for p in changes if hasattr(loop.settings, p.name)}
        if material != settings.material and self._supplier is not None:
            self._supplier.ask({"material": material}, self._log_refused_material)
        if known != settings.known and self._supplier is not None:
            self._supplier.ask({"uncertainty": mappings(known)}, self._log_refused_known)
        for tool in self._tools:
            if tool.jaw is not None:
                tool.jaw.thresholds = jaw
        loop.settings = replace(
            settings,
            **changed,
            material=material,
            budget=budget,
            known=known,
            safety=safety,
            jaw=jaw,
        )
        return SetParametersResult(successful=True)

    def _values(self, names: tuple[str, ...], changes: list[Parameter]) -> dict[str, Any]:
        """Return values of some parameters after changes."""
        value = {name: self.get_parameter(name).value for name in names}
        return value | {p.name: p.value for p in changes if p.name in value}

    def _log_refused_material(self, prepared: PreparedModel | None, refusal: str) -> None:
        if refusal and refusal != SUPERSEDED:
            self.get_logger().error(f"material refused: {refusal}")

    def _log_refused_known(self, prepared: PreparedModel | None, refusal: str) -> None:
        if refusal and refusal != SUPERSEDED:
            self.get_logger().error(f"uncertainty refused: {refusal}")

    def _refusal_of_known(
        self, known: dict[str, Distribution], before: dict[str, Distribution]
    ) -> str:
        """Return why the vademecum in use cannot use distributions; empty if it can.

        Unchanged distributions are not checked: they may belong to another organ.
        """
        if self._held is None or known == before:
            return ""
        try:
            self._held.known(known)
        except CoordinateError as error:
            return one_line(error)
        return ""

    def _refusal_of(self, name: str, value: float, material: dict[str, float]) -> str:
        """Return why the vademecum in use does not hold a value of the material; else empty.

        With supports, the ranges of stiffness and Young's modulus depend on each other. Where
        ``material``, as it will be, has both, the worker process decides.
        """
        if name == "young" and value < _LEAST_YOUNG:
            return f"young is {value:g} Pa; give {_LEAST_YOUNG:g} or more"
        if name == RESECTION and value < 0.0:
            return f"resection is {value:g}; give 0 to 1, or -1"
        if self._ranges is None or (name == "young" and name not in self._ranges):
            return ""
        if name not in self._ranges:
            return f"the vademecum has no coordinate {name}; build it with {option_of(name)}"
        others = {one for one in material if one != name}
        if (name == "young" and any(one.startswith(SUPPORT) for one in others)) or (
            name.startswith(SUPPORT) and "young" in others
        ):
            return ""
        low, high = self._ranges[name]
        if low <= value <= high:
            return ""
        return f"{name} is {value:g}; the vademecum holds {low:g} to {high:g}"


def main() -> int:
    """Run the contact node; return the exit code."""
    return run(ContactNode, keeps_time=True)


if __name__ == "__main__":
    raise SystemExit(main())
