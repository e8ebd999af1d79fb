"""The contact node: poses of tools in; force on each tool and deformation of the organ out.

Three threads of control, each in its place:

- the loop (``ContactLoop``, a thread): waits for a pose, steps, publishes; nothing else.
- the node (``ContactNode``, the main thread): parameters, transitions, statistics.
- the handover (a process, and a thread that maps what it sends): brings a vademecum in, and
  prepares it anew for another scene or material.

They share two references, which are exchanged whole: the model in use and the record of times.

A model that replaces another is faded in over ``BLEND`` seconds, during which the loop steps both:
what is published changes per period by its share of the difference, beside what motion does.
"""

from __future__ import annotations

import gc
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import PointCloud2

from avatar_core import contact
from avatar_core.errors import SceneError
from avatar_ros import parameters, qos, realtime, scenes
from avatar_ros.conversions import (
    NO_STAMP,
    CloudTemplate,
    PoseReader,
    StateTemplate,
    WrenchTemplate,
    small_turn,
    stamp_nanoseconds,
)
from avatar_ros.handover import OVERTAKEN, Change, Handover, Order, Prepared
from avatar_ros.managed_node import ManagedNode, run
from avatar_ros.msg import ContactState, LoopStatistics
from avatar_ros.parameters import ContactSettings
from avatar_ros.srv import LoadScene

OK = int(ContactState.STATUS_OK)
NO_MODEL = int(ContactState.STATUS_NO_MODEL)
NO_POSE = int(ContactState.STATUS_NO_POSE)
STALE_POSE = int(ContactState.STATUS_STALE_POSE)

BLEND = 0.1  # [s]
LATE = 1.5  # a period this many times the nominal one counts as missed
_PATIENCE = 1.3  # periods the loop waits for a pose that is due, so as not to miss its own
_SHORTEST = 0.5  # periods between two answers to poses, however fast they come
_FAR_AWAY = 1e3  # where a tool without a pose is, for the step [m]
_STATISTICS_PERIOD = 1.0  # [s]
_GRACE = 0.1  # a replaced model is kept for so long after the last step that uses it [s]


# --- What the loop works with ----------------------------------------------------------------


class OwnThread(CallbackGroup):
    """For subscriptions that the loop takes from itself: no executor ever touches them."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


class Tool:
    """One tool's subscription, publisher and last pose.

    status : OK with a usable pose, otherwise why not
    stamp : of the last valid pose, eight bytes; zero before the first
    """

    def __init__(self, subscription: Any, publisher: Any, frame_id: str) -> None:
        self.subscription = subscription
        self.publisher = publisher
        self.wrench = WrenchTemplate(frame_id)
        self.status = NO_POSE
        self.stamp = NO_STAMP
        self._reader = PoseReader(frame_id)
        self._received = 0  # [ns]
        self._orientation: tuple[float, float, float, float] | None = None  # of the last valid pose

    def take(self, now: int, timeout: int, tip: np.ndarray, turn: np.ndarray) -> bool:
        """Take the newest pose, if any, and place ``tip``; true if a valid one came.

        ``turn`` is what it turned since the last valid one [rad]; zero after a gap.
        """
        turn[:] = 0.0
        taken = self.subscription.handle.take_message(PoseStamped, True)
        if taken is None:
            if self.status == OK and now - self._received > timeout:
                self.status = STALE_POSE
                self._orientation = None
                tip[:] = _FAR_AWAY
            return False
        self.status = self._reader.read(taken[0])
        if self.status != OK:
            self._orientation = None
            tip[:] = _FAR_AWAY
            return False
        tip[:] = self._reader.position
        if self._orientation is not None:
            turn[:] = small_turn(self._orientation, self._reader.orientation)
        self._orientation = self._reader.orientation
        self.stamp = self._reader.stamp
        self._received = now
        return True


class Online:
    """A contact model and the messages that have its size: exchanged as one.

    effects : that are in it, by name
    """

    def __init__(
        self,
        vademecum_id: str,
        model: Any,
        settings: ContactSettings,
        effects: tuple[str, ...] = (),
    ) -> None:
        self.id = vademecum_id
        self.model = model
        self.effects = effects
        self.cloud: CloudTemplate | None = None
        if model is not None and len(model.out.cloud) > 0:
            self.cloud = CloudTemplate(settings.frame_id, len(model.out.cloud))
        capacity = 1 if model is None else len(model.out.contact_tool)
        self.states = [
            StateTemplate(settings.frame_id, tool, vademecum_id, capacity)
            for tool in settings.tools
        ]


class Record:
    """Times of the steps since the record was begun [ns]; writing allocates nothing."""

    CAPACITY = 4096

    def __init__(self, begin: int) -> None:
        self.begin = begin
        self.n_periods = 0
        self.n_steps = 0
        self.n_ages = 0
        self.periods = np.zeros(self.CAPACITY, np.int64)
        self.computes = np.zeros(self.CAPACITY, np.int64)
        self.ages = np.zeros(self.CAPACITY, np.int64)

    def note_period(self, period: int) -> None:
        if self.n_periods < self.CAPACITY:
            self.periods[self.n_periods] = period
            self.n_periods += 1

    def note_step(self, compute: int) -> None:
        if self.n_steps < self.CAPACITY:
            self.computes[self.n_steps] = compute
            self.n_steps += 1

    def note_age(self, age: int) -> None:
        if self.n_ages < self.CAPACITY:
            self.ages[self.n_ages] = age
            self.n_ages += 1


@dataclass
class Outlets:
    """Publishers of what concerns all tools."""

    state: Any
    deformation: Any
    statistics: Any


# --- The loop --------------------------------------------------------------------------------


class ContactLoop:
    """Answers every pose at once, and keeps its period when none comes.

    online : what is simulated; exchange it when ``is_changing`` is false, for a smooth change
    record : where times go; exchange it at any time
    failure : what ended the loop before ``stop``, else empty
    """

    def __init__(
        self,
        settings: ContactSettings,
        tools: list[Tool],
        outlets: Outlets,
        context: Any,
    ) -> None:
        self.settings = settings
        self.online = Online("", None, settings)
        self.record = Record(time.monotonic_ns())
        self.failure = ""
        self._tools = tools
        self._outlets = outlets
        self._tips = np.full((len(tools), 3), _FAR_AWAY)
        self._turns = np.zeros((len(tools), 3))
        self._used = self.online  # of the last step
        self._leaving: Any = None  # the model that it replaces, while both are stepped
        self._part = 1.0  # of the model in use, in what is published
        self._part_per_step = 1.0 / max(1, round(BLEND * settings.rate))
        self._wait_set = _rclpy.WaitSet(len(tools), 0, 0, 0, 0, 0, context.handle)
        self._period = round(1e9 / settings.rate)
        self._running = False
        self._thread: threading.Thread | None = None
        self._step_start = 0  # of the last step [ns]
        self._due = 0  # the next step, if no pose comes before [ns]
        self._answered = 0  # start of the last step that had a new pose [ns]
        self._cycle = 0

    @property
    def is_changing(self) -> bool:
        """Whether the loop still steps a model that was replaced, or is yet to see the new one."""
        changing = self._leaving is not None or self._used is not self.online
        return self._running and not self.failure and changing

    def start(self, cpu: int = -1) -> None:
        self._running = True
        self._used, self._leaving = self.online, None
        self._thread = threading.Thread(target=self._run, args=(cpu,), name="contact loop")
        self._thread.start()

    def stop(self) -> None:
        """Returns when the last step is over, within two periods."""
        self._running = False
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self, cpu: int) -> None:
        try:
            with ExitStack() as in_use:
                for port in self._ports():
                    in_use.enter_context(port.handle)  # not destroyed under the loop
                in_use.enter_context(self._wait_set)
                realtime.bind_thread(cpu)
                self._step_start = self._due = time.monotonic_ns()
                while self._running:
                    self._wait()
                    self._step()
        except Exception as error:
            self.failure = f"the contact loop ended: {type(error).__name__}: {error}"

    def _ports(self) -> list[Any]:
        of_tools = [port for tool in self._tools for port in (tool.subscription, tool.publisher)]
        return [*of_tools, self._outlets.state, self._outlets.deformation]

    def _wait(self) -> None:
        """Until a pose came, or until this period must not wait any longer."""
        realtime.sleep_until(self._answered + round(_SHORTEST * self._period))
        wait_set = self._wait_set
        wait_set.clear_entities()
        for tool in self._tools:
            wait_set.add_subscription(tool.subscription.handle)
        wait_set.wait(max(0, self._due - time.monotonic_ns()))

    def _step(self) -> None:
        start = time.monotonic_ns()
        settings, online, record = self.settings, self.online, self.record
        timeout = round(settings.pose_timeout * 1e9)
        if online is not self._used:
            self._begin_change(online)
        fresh = False
        for tool, tip, turn in zip(self._tools, self._tips, self._turns, strict=True):
            fresh |= tool.take(start, timeout, tip, turn)
        record.note_period(start - self._step_start)
        self._step_start = start
        self._due = self._next_due(start, fresh)
        if fresh:
            self._answered = start
            record.note_age(time.time_ns() - stamp_nanoseconds(self._tools[0].stamp))
        model, leaving = online.model, self._leaving
        if model is not None:
            self._solve(model)
        if leaving is not None:
            self._solve(leaving)
            self._part = min(1.0, self._part + self._part_per_step)
            _fade_in(model.out.force, leaving.out.force, self._part)
            _fade_in(model.out.torque, leaving.out.torque, self._part)
        for i, tool in enumerate(self._tools):
            self._publish_wrench(i, tool, model)
        record.note_step(time.monotonic_ns() - start)
        for i, tool in enumerate(self._tools):
            self._publish_state(i, tool, online)
        self._cycle += 1
        if online.cloud is not None and self._cycle % settings.cloud_divisor == 0:
            contact.deform(model)
            if leaving is not None and len(leaving.out.cloud) == len(model.out.cloud):
                contact.deform(leaving)
                _fade_in(model.out.cloud, leaving.out.cloud, self._part)
            online.cloud.points[:] = model.out.cloud
            stamp = self._tools[0].stamp
            self._outlets.deformation.handle.publish_raw(online.cloud.serialise(stamp))
        if self._part == 1.0:
            self._leaving = None  # whoever exchanged the model frees it, outside the loop

    def _begin_change(self, online: Online) -> None:
        """Go on with another model; the one before fades out, on the same organ in its contacts."""
        leaving = self._used.model
        if leaving is not None:
            self._part = 0.0
            if online.id == self._used.id:
                online.model.resume(leaving)
        self._leaving, self._used = leaving, online

    def _solve(self, model: Any) -> None:
        if model.effects.friction is not None:
            model.effects.friction.spin[:] = self._turns
        contact.solve(model, self._tips)

    def _next_due(self, start: int, fresh: bool) -> int:
        """When to step even without a pose: later if one is expected, else in a fixed rhythm."""
        if fresh:
            return start + round(_PATIENCE * self._period)
        due = self._due + self._period
        return due if due > start else start + self._period

    def _publish_wrench(self, i: int, tool: Tool, model: Any) -> None:
        wrench = tool.wrench
        if model is None or tool.status != OK:
            wrench.force[:] = 0.0
            wrench.torque[:] = 0.0
        else:
            wrench.force[:] = model.out.force[i]
            wrench.torque[:] = model.out.torque[i]
        tool.publisher.handle.publish_raw(wrench.serialise(tool.stamp))

    def _publish_state(self, i: int, tool: Tool, online: Online) -> None:
        template = online.states[i]
        status = tool.status
        if online.model is None:
            status = NO_MODEL
        elif status == OK:
            status = int(online.model.out.status[i])
        n = 0 if online.model is None else _write_contacts(template, online.model.out, i)
        self._outlets.state.handle.publish_raw(template.serialise(tool.stamp, status, n))


def _fade_in(new: np.ndarray, old: np.ndarray, part: float) -> None:
    """``new`` becomes part of itself and the rest of ``old``, which is used up: no array is made.

    Both are written anew by the next step.
    """
    new *= part
    old *= 1.0 - part
    new += old


def _write_contacts(template: StateTemplate, out: Any, tool: int) -> int:
    """Copy a tool's contacts into its message; returns their number."""
    total = int(out.n_contacts[0])
    if total == 0:
        return 0
    mine = np.flatnonzero(out.contact_tool[:total] == tool)
    rows = template.contacts[: len(mine)]
    rows[:, 0:3] = out.contact_position[mine]
    rows[:, 3:6] = out.contact_normal[mine]
    rows[:, 6:9] = out.contact_force[mine]
    rows[:, 9] = out.contact_penetration[mine]
    return len(mine)


# --- The node --------------------------------------------------------------------------------


class ContactNode(ManagedNode):
    """Parameters, transitions, statistics; the work is done by ``ContactLoop``."""

    def __init__(self) -> None:
        self._loop: ContactLoop | None = None
        self._handover: Handover | None = None
        self._tools: list[Tool] = []
        self._outlets: Outlets | None = None
        self._timer: Any = None
        self._ranges: dict[str, tuple[float, float]] | None = None  # of the vademecum in use
        self._n_awaited = 0
        super().__init__("contact", parameters.CONTACT)
        # As long as the node, and beside everything else: an answer may take a minute.
        self.create_service(
            LoadScene, "load_scene", self._load_scene, callback_group=ReentrantCallbackGroup()
        )
        self.add_on_set_parameters_callback(self._change_parameters)

    @property
    def failure(self) -> str:
        return "" if self._loop is None else self._loop.failure

    @property
    def owes_answers(self) -> bool:
        return self._n_awaited > 0

    def configure(self) -> None:
        settings = parameters.read_contact(self)
        if settings.scene:
            self._say_divisor(settings.cloud_divisor)
        contact.warm_up(len(settings.tools))
        own = OwnThread()
        self._tools = [
            Tool(
                self.create_subscription(
                    PoseStamped,
                    f"{name}/measured_cp",
                    _never_called,
                    qos.NEWEST,
                    callback_group=own,
                    raw=True,
                ),
                self.create_publisher(WrenchStamped, f"{name}/spatial/servo_cf", qos.COMMAND),
                settings.frame_id,
            )
            for name in settings.tools
        ]
        self._outlets = Outlets(
            self.create_publisher(ContactState, "contact_state", qos.state(len(self._tools))),
            self.create_publisher(PointCloud2, "deformation", qos.NEWEST),
            self.create_publisher(LoopStatistics, "statistics", qos.STATISTICS),
        )
        self._loop = ContactLoop(settings, self._tools, self._outlets, self.context)
        order = Order(
            topic=self.resolve_topic_name("vademecum"),
            node_name=f"_{self.get_name()}_handover",
            namespace=self.get_namespace(),
            tip_radii=settings.tip_radii,
            modes=settings.modes,
            cloud=settings.cloud,
            period=1.0 / settings.rate,
            material=settings.material,
            scene=settings.scene,
        )
        self._handover = Handover(order, self._take_model, self.get_logger().error)

    def activate(self) -> None:
        assert self._loop is not None
        settings = self._loop.settings
        granted = realtime.claim(settings.priority, settings.cpu, settings.lock_memory)
        for refusal in granted.refusals:
            self.get_logger().warning(refusal)
        realtime.calm_interpreter()
        self._loop.record = Record(time.monotonic_ns())
        self._loop.start(granted.cpu)
        self._timer = self.create_timer(_STATISTICS_PERIOD, self._publish_statistics)

    def deactivate(self) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        if self._loop is not None:
            self._loop.stop()

    def clean_up(self) -> None:
        if self._handover is not None:
            self._handover.stop()
            self._handover = None
        self._loop = None
        for tool in self._tools:
            self.destroy_subscription(tool.subscription)
            self.destroy_publisher(tool.publisher)
        for publisher in vars(self._outlets).values() if self._outlets else ():
            self.destroy_publisher(publisher)
        self._tools, self._outlets = [], None

    def _take_model(self, prepared: Prepared) -> None:
        """In the handover's thread: put a model into use between two steps.

        Returns when it has replaced the one before entirely.
        """
        loop = self._loop
        if loop is None:
            return
        model = contact.make_model(contact.Layout.of(prepared.arrays), halves=True)
        replaced = loop.online
        self._ranges = prepared.ranges
        loop.online = Online(prepared.id, model, loop.settings, prepared.effects)
        what = ", ".join(prepared.effects) or "no effects"
        self.get_logger().info(
            f"vademecum {prepared.name!r} ({prepared.id[:12]}) in use, with {what}"
        )
        while loop.is_changing:
            time.sleep(BLEND / 4)
        time.sleep(_GRACE)
        del replaced  # frees its memory here, not in the loop

    async def _load_scene(
        self, request: LoadScene.Request, response: LoadScene.Response
    ) -> LoadScene.Response:
        try:
            prepared = await self._in_use(scenes.change_of(request))
            if prepared.cloud_divisor is not None:
                self._say_divisor(prepared.cloud_divisor)
            response.success = True
        except Exception as error:  # a service always answers; the text decides what is raised
            response.message = " ".join(str(error).split()) or type(error).__name__
            self.get_logger().error(f"load_scene: {response.message}")
        if self._loop is not None:
            response.effects = list(self._loop.online.effects)
        return response

    def _say_divisor(self, divisor: int) -> None:
        """A scene's own is in force from now on, and free to change."""
        self.set_parameters([Parameter("cloud_divisor", value=divisor)])

    async def _in_use(self, change: Change) -> Prepared:
        """Wait until a change of the model is in use, while the executor goes on.

        Raises
        ------
        SceneError : it was refused
        """
        executor, handover = self.executor, self._handover
        assert executor is not None  # which runs this
        if handover is None or self._timer is None:
            raise SceneError("the node is inactive; activate it first")
        done = Future(executor=executor)

        def answer(prepared: Prepared | None, refusal: str) -> None:
            if prepared is None:
                done.set_exception(SceneError(refusal))
            else:
                done.set_result(prepared)
            executor.wake()

        self._n_awaited += 1
        try:
            handover.ask(change, answer)
            return await done
        finally:
            self._n_awaited -= 1

    def _change_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        """Type and range were checked; those that may change take effect with the next step.

        A change of the material takes some tenths of a second, in the handover's process.
        """
        loop = self._loop
        if loop is None:
            return SetParametersResult(successful=True)
        material = dict(loop.settings.material)
        for change in changes:
            name = parameters.MATERIAL.get(change.name)
            if name is None:
                continue
            refusal = self._refusal_of(name, change.value)
            if refusal:
                return SetParametersResult(successful=False, reason=refusal)
            material.pop(name, None)
            if change.value != 0.0:
                material[name] = change.value
        changed = {p.name: p.value for p in changes if hasattr(loop.settings, p.name)}
        if material != loop.settings.material and self._handover is not None:
            self._handover.ask({"material": material}, self._note_material)
        loop.settings = replace(loop.settings, **changed, material=material)
        return SetParametersResult(successful=True)

    def _note_material(self, prepared: Prepared | None, refusal: str) -> None:
        if refusal and refusal != OVERTAKEN:
            self.get_logger().error(f"material refused: {refusal}")

    def _refusal_of(self, name: str, value: float) -> str:
        """Why the vademecum in use does not have a value of the material; empty if it has."""
        if value == 0.0 or name == "young" or self._ranges is None:
            return ""
        if name not in self._ranges:
            return f"the vademecum has no coordinate {name}; build it with --coordinate {name}=..."
        low, high = self._ranges[name]
        return "" if low <= value <= high else f"the vademecum holds {low:g} to {high:g}"

    def _publish_statistics(self) -> None:
        loop, outlets = self._loop, self._outlets
        if loop is None or outlets is None:
            return
        end = time.monotonic_ns()
        record, loop.record = loop.record, Record(end)
        message = statistics(record, end, loop.settings.rate)
        message.header.stamp = self.get_clock().now().to_msg()
        outlets.statistics.publish(message)
        gc.collect()


def statistics(record: Record, end: int, rate: float) -> LoopStatistics:
    """Summary of a record that ended at ``end`` [ns] of a loop with a nominal rate [Hz]."""
    periods = record.periods[: record.n_periods] * 1e-9
    computes = record.computes[: record.n_steps] * 1e-9
    ages = record.ages[: record.n_ages] * 1e-9
    window = (end - record.begin) * 1e-9
    period_p50, period_p99, period_max = _percentiles(periods)
    compute_p50, compute_p99, compute_max = _percentiles(computes)
    age_p50, age_p99, _ = _percentiles(ages)
    return LoopStatistics(
        window=window,
        rate=len(periods) / window,
        periods=len(periods),
        missed=int(np.count_nonzero(periods > LATE / rate)),
        period_p50=period_p50,
        period_p99=period_p99,
        period_max=period_max,
        compute_p50=compute_p50,
        compute_p99=compute_p99,
        compute_max=compute_max,
        pose_age_p50=age_p50,
        pose_age_p99=age_p99,
    )


def _percentiles(values: np.ndarray) -> tuple[float, float, float]:
    """Median, 99th percentile and maximum; NaN of nothing."""
    if len(values) == 0:
        return (np.nan, np.nan, np.nan)
    p50, p99, largest = np.percentile(values, (50, 99, 100))
    return float(p50), float(p99), float(largest)


def _never_called(message: bytes) -> None:
    """The loop takes poses itself."""


def main() -> int:
    return run(ContactNode)


if __name__ == "__main__":
    raise SystemExit(main())
