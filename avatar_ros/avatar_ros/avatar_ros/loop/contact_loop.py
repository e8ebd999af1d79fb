"""The loop of the contact node: a thread that waits for a pose, steps and publishes.

It waits for nothing but poses. Without a model it steps every fifth period and no pose wakes it:
no force could be late, and the wrench of zero keeps its deadline. While no tool is connected
either, it steps ten times a second, until the node wakes it. An exception ends it, with a last
wrench of zero. The node exchanges two references with it: the data of the model in use and the
record of times.

When a model replaces another, the loop steps both for ``BLEND`` seconds. It publishes their mean,
whose weight moves linearly from the old model to the new one.

A force's band belongs to the organ's force, before limits and fading.

Before the organ's force is sent to a tool, a guard
(:mod:`avatar_core.haptics.force_guard`) limits it, fades it out on a fault and lets it come
back gradually. Stopping the loop counts as a fault.
"""

from __future__ import annotations

import math
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from avatar_core.contact import model as contact
from avatar_core.contact.force_band import ForceBand
from avatar_core.contact.status import FAR_AWAY, Status
from avatar_core.haptics import passivity
from avatar_core.haptics.force_guard import ForceGuard
from avatar_ros.framework import realtime
from avatar_ros.framework.state_template import StateTemplate
from avatar_ros.framework.templates import NO_STAMP, CloudTemplate, stamp_nanoseconds
from avatar_ros.loop.settings import LoopSettings
from avatar_ros.loop.shown_modes import ShownModes
from avatar_ros.loop.statistics import TimingRecord
from avatar_ros.loop.tool_channel import OK, ToolChannel

NO_MODEL = int(Status.NO_MODEL)
ENGAGING = int(Status.ENGAGING)
INACTIVE = int(Status.INACTIVE)

BLEND = 0.1  # time in which a new model takes over [s]
# longest wait for a pose that is due [periods], so that none is missed by a little
_LONGEST_WAIT = 1.3
_SHORTEST_PERIOD = 0.5  # shortest time between two answers [periods], however fast poses come
_IDLE = 5  # time between steps without a model [periods]; the wrench has a deadline of ten
_ALONE = 100_000_000  # time between steps while no tool is connected either [ns]
_NO_ERROR = float("nan")  # error of a force that no model gave


class ActiveModel:
    """Data of a contact model with the message templates of its size; the loop exchanges both.

    Attributes
    ----------
    data : ContactData, optional
        Data of the model; None without a model.
    effects : tuple of str
        Names of the effects that the model simulates.
    shown_modes : ShownModes
        Modes that are shown, and their accuracy.
    band : ForceBand, optional
        Band of its forces; None without distributions of the material.
    """

    def __init__(
        self,
        vademecum_id: str,
        data: Any,
        settings: LoopSettings,
        effects: tuple[str, ...] = (),
        shown_modes: ShownModes | None = None,
        band: ForceBand | None = None,
    ) -> None:
        self.id = vademecum_id
        self.data = data
        self.effects = effects
        self.shown_modes = shown_modes
        self.band = band
        self.cloud: CloudTemplate | None = None
        if data is not None and len(data.out.cloud) > 0:
            self.cloud = CloudTemplate(settings.frame_id, len(data.out.cloud))
        capacity = 1 if data is None else len(data.out.contact_tool)
        self.states = [
            StateTemplate(settings.frame_id, tool, vademecum_id, capacity)
            for tool in settings.tools
        ]


@dataclass
class Publishers:
    """Publishers of the topics that all tools share."""

    state: Any
    deformation: Any
    statistics: Any
    diagnostics: Any


class ContactLoop:
    """Answers every pose at once, and keeps its period when none comes.

    Attributes
    ----------
    active : ActiveModel
        The model in use. Exchange it while ``is_changing`` is false, for a smooth change, and
        ``wake`` the loop.
    record : TimingRecord
        Times of the steps; exchange it at any time.
    failure : str
        The exception that ended the loop; empty otherwise.
    guards : list of ForceGuard
        Guard of the force on each tool.
    energies : Passivity, optional
        Energies of each tool; None unless ``safety.passivity`` asks for them.
    """

    def __init__(
        self, settings: LoopSettings, tools: list[ToolChannel], publishers: Publishers, context: Any
    ) -> None:
        self.settings = settings
        self.active = ActiveModel("", None, settings)
        self.record = TimingRecord(time.monotonic_ns())
        self.failure = ""
        period = 1.0 / settings.rate
        self.guards = [ForceGuard(settings.safety.limits) for _ in tools]
        self.energies = settings.safety.observer(len(tools), period)
        self._tools = tools
        self._forces = np.zeros((len(tools), 3))
        self._publishers = publishers
        self._tips = np.full((len(tools), 3), FAR_AWAY)
        self._orientations = np.zeros((len(tools), 4))
        self._jaws = np.zeros(len(tools), np.bool_)
        self._used = self.active  # model of the last step
        self._outgoing: Any = None  # replaced model, while both are stepped
        self._outgoing_band: ForceBand | None = None  # band of the replaced model
        self._blend = 1.0  # weight of the model in use in what is published
        self._part_per_step = 1.0 / max(1, round(BLEND * settings.rate))
        self._wait_set = _rclpy.WaitSet(len(tools), 0, 0, 0, 0, 0, context.handle)
        self._period = round(1e9 / settings.rate)
        self._running = False
        self._stopping = False
        self._awake = threading.Event()
        self._thread: threading.Thread | None = None
        self._step_start = 0  # start of the last step [ns]
        self._due = 0  # time of the next step, if no pose comes before [ns]
        self._nominal = self._period  # planned time from the last step to the next [ns]
        self._answered = 0  # start of the last step that had a new pose [ns]
        self._cycle = 0

    @property
    def is_changing(self) -> bool:
        """Return whether the loop still steps a replaced model, or has not seen the new one yet."""
        changing = self._outgoing is not None or self._used is not self.active
        return self._running and not self.failure and changing

    def start(self, cpu: int = -1) -> None:
        """Start the thread, bound to a core; -1: any."""
        self._running, self._stopping = True, False
        self._used, self._outgoing, self._outgoing_band = self.active, None, None
        self._thread = threading.Thread(target=self._run, args=(cpu,), name="contact loop")
        self._thread.start()

    def stop(self) -> None:
        """End the thread; return when all forces have faded out, within 20 ms."""
        self._stopping = True
        self.wake()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._running = False

    def wake(self) -> None:
        """Step now, if the loop waits because there was no model and no tool."""
        self._awake.set()

    def _run(self, cpu: int) -> None:
        try:
            with ExitStack() as in_use:
                for port in self._ports():
                    # keeps the handle from being destroyed under the loop
                    in_use.enter_context(port.handle)
                in_use.enter_context(self._wait_set)
                realtime.name_thread("contact loop")
                realtime.bind_thread(cpu)
                self._step_start = self._due = time.monotonic_ns()
                while not (self._stopping and all(guard.silent for guard in self.guards)):
                    self._wait()
                    self._step()
        except Exception as error:
            self.failure = f"the contact loop ended: {type(error).__name__}: {error}"
            with suppress(Exception):
                self._send_zero()

    def _ports(self) -> list[Any]:
        of_tools = [port for tool in self._tools for port in tool.ports]
        return [*of_tools, self._publishers.state, self._publishers.deformation]

    def _wait(self) -> None:
        """Wait for a pose, at most until the step is due. Real-time safe."""
        if self._nominal > self._period:
            self._wait_idle()
            return
        realtime.sleep_until(self._answered + round(_SHORTEST_PERIOD * self._period))
        wait_set = self._wait_set
        wait_set.clear_entities()
        for tool in self._tools:
            wait_set.add_subscription(tool.subscription.handle)
        wait_set.wait(max(0, self._due - time.monotonic_ns()))

    def _wait_idle(self) -> None:
        """Wait until the step is due or the loop is woken, which shortens its period."""
        if self._awake.wait(1e-9 * max(0, self._due - time.monotonic_ns())):
            self._nominal = max(self._period, time.monotonic_ns() - self._step_start)
        self._awake.clear()

    def _step(self) -> None:
        """Take poses, solve, and publish wrenches, states and the cloud. Real-time safe."""
        start = time.monotonic_ns()
        settings, active, record = self.settings, self.active, self.record
        timeout = round(settings.pose_timeout * 1e9)
        if active is not self._used:
            self._begin_change(active)
        fresh, answered = False, NO_STAMP
        for tool, tip, turned in zip(self._tools, self._tips, self._orientations, strict=True):
            if tool.take(start, timeout, tip, turned, settings.safety.leap):
                fresh, answered = True, tool.stamp
        record.note_period(start - self._step_start, self._nominal)
        self._step_start = start
        self._nominal = self._period if active.data is not None else self._idle_period(timeout)
        self._due = self._next_due(start, fresh)
        if fresh:
            self._answered = start
            record.note_age(time.time_ns() - stamp_nanoseconds(answered))
        data, outgoing = active.data, self._outgoing
        busy = 0
        if data is not None:
            if data.grasps:
                self._take_jaws()
            self._solve(data)
            busy = time.monotonic_ns() - start
        if outgoing is not None:
            self._solve(outgoing)
            self._blend = min(1.0, self._blend + self._part_per_step)
            self._blend_bands(active.band, self._outgoing_band)
            _fade_in(data.out.force, outgoing.out.force, self._blend)
            _fade_in(data.out.torque, outgoing.out.torque, self._blend)
        self._publish_wrenches(start * 1e-9, data)
        record.note_step(time.monotonic_ns() - start)
        if active.band is not None:
            self._publish_bands(active.band)
        if data is not None:
            contact.estimate_error(data.model, data)
        for i, tool in enumerate(self._tools):
            self._publish_state(i, tool, active)
        self._cycle += 1
        if active.cloud is not None and self._cycle % settings.cloud_divisor == 0:
            begin = time.monotonic_ns()
            contact.deform(data.model, data)
            record.note_model(busy + time.monotonic_ns() - begin)
            if outgoing is not None and len(outgoing.out.cloud) == len(data.out.cloud):
                contact.deform(outgoing.model, outgoing)
                _fade_in(data.out.cloud, outgoing.out.cloud, self._blend)
            active.cloud.points[:] = data.out.cloud
            stamp = self._tools[0].stamp
            self._publishers.deformation.handle.publish_raw(active.cloud.serialise(stamp))
        if self._blend == 1.0:
            # the thread that exchanged the model frees it, outside the loop
            self._outgoing = self._outgoing_band = None

    def _begin_change(self, active: ActiveModel) -> None:
        """Begin to fade in another model, from the same contacts if the organ is the same.

        Real-time safe.
        """
        outgoing = self._used.data
        if active.data is not None and active.data.grasps:  # a jaw that is closed already holds
            self._take_jaws()  # nothing of another organ
            active.data.note_shut(self._jaws)
        if outgoing is not None:
            self._blend = 0.0
            if active.id == self._used.id:
                active.data.resume(outgoing)
        self._outgoing_band = self._used.band
        self._outgoing, self._used = outgoing, active

    def _solve(self, data: Any) -> None:
        """Compute the forces at the present tips. Real-time safe."""
        contact.solve(data.model, data, self._tips, self._orientations, self._jaws)

    def _take_jaws(self) -> None:
        """Note which jaws are closed. Real-time safe."""
        for i, tool in enumerate(self._tools):
            if tool.jaw is not None:
                self._jaws[i] = tool.jaw.take()

    def _blend_bands(self, band: ForceBand | None, outgoing: ForceBand | None) -> None:
        """Fade in the band of a model, before its forces are faded in. Real-time safe."""
        if band is not None and outgoing is not None:
            band.update()
            outgoing.update()
            _fade_in(band.edges, outgoing.edges, self._blend)

    def _publish_bands(self, band: ForceBand) -> None:
        """Send both edges of each tool's band, after the force itself. Real-time safe."""
        if self._outgoing_band is None:
            band.update()
        for i, tool in enumerate(self._tools):
            tool.send_band(band.edges[:, i])

    def _idle_period(self, timeout: int) -> int:
        """Return the time between steps without a model: short, so that no pose seems late [ns]."""
        if not any(tool.connected for tool in self._tools):
            return max(self._period, _ALONE)
        return self._period * max(1, min(_IDLE, timeout // (4 * self._period)))

    def _next_due(self, start: int, fresh: bool) -> int:
        """Return when to step without a pose; later if one is expected. Real-time safe."""
        if fresh and self._nominal == self._period:
            return start + round(_LONGEST_WAIT * self._period)
        due = self._due + self._nominal
        return due if due > start else start + self._nominal

    def _publish_wrenches(self, now: float, data: Any) -> None:
        """Send the guarded forces; zero without a model or a pose. Real-time safe."""
        limits, energies = self.settings.safety.limits, self.energies
        self._forces[:] = 0.0 if data is None else data.out.force
        if energies is not None:
            passivity.limit(energies, self._tips, self._forces)
            if data is not None and self.settings.safety.passivity == "observe":
                self._forces[:] = data.out.force
        for i, (tool, guard) in enumerate(zip(self._tools, self.guards, strict=True)):
            wrench = tool.wrench
            wrench.force[:] = self._forces[i]
            wrench.torque[:] = 0.0 if data is None else data.out.torque[i]
            share = 1.0 if energies is None or data is None else self._share(i, data)
            wrench.torque *= share
            guard.limits = limits
            sound = tool.fault == OK and not self._stopping
            guard.update(now, sound, wrench.force, wrench.torque, share)
            if energies is not None:
                energies.held[i, -1] = wrench.force
            if data is not None or tool.connected:
                tool.answer()

    def _share(self, i: int, data: Any) -> float:
        """Return the part of a tool's force that passivity leaves, at most 1. Real-time safe."""
        computed = math.hypot(*data.out.force[i])
        return min(math.hypot(*self._forces[i]) / computed, 1.0) if computed > 0.0 else 1.0

    def _send_zero(self) -> None:
        """Send a last wrench of zero to every tool, after a failure."""
        for tool in self._tools:
            tool.wrench.force[:] = 0.0
            tool.wrench.torque[:] = 0.0
            tool.answer()

    def _publish_state(self, i: int, tool: ToolChannel, active: ActiveModel) -> None:
        """Send the status and the contacts of one tool. Real-time safe."""
        template = active.states[i]
        guard = self.guards[i]
        status = tool.fault
        if self._stopping:
            status = INACTIVE
        elif active.data is None:
            status = NO_MODEL
        elif status == OK:
            status = int(active.data.out.status[i])
            tool.note_solved(status)
            if status == OK and not guard.engaged:
                status = ENGAGING
        n, error, held = 0, _NO_ERROR, False
        if active.data is not None:
            held = active.data.holds(i)
            n, error = (
                _write_contacts(template, active.data.out, i),
                active.data.out.force_error[i],
            )
        self._publishers.state.handle.publish_raw(
            template.serialise(tool.stamp, status, n, error, guard.sent_fraction, held)
        )


def _fade_in(new: np.ndarray, old: np.ndarray, blend: float) -> None:
    """Replace ``new`` by ``blend * new + (1 - blend) * old``; overwrite ``old``. Real-time safe.

    The next step computes both again.
    """
    new *= blend
    old *= 1.0 - blend
    new += old


def _write_contacts(template: StateTemplate, out: Any, tool: int) -> int:
    """Copy a tool's contacts into its message; return their number. Real-time safe."""
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
