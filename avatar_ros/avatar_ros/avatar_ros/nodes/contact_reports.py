"""Reports of the contact node once a second: statistics, diagnostics, and lines in the log.

The loop waits for Python's global lock while a report is made. Between two parts of a report the
lock is left to the loop, so that none of its periods waits for both.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.timer import Timer

from avatar_interfaces.msg import LoopStatistics
from avatar_ros.framework.ports import ONE_CELL, Ports, publishers, rivals
from avatar_ros.loop import diagnostics
from avatar_ros.loop.contact_loop import ContactLoop, Publishers
from avatar_ros.loop.device import ToolDevice
from avatar_ros.loop.settings import THRESHOLDS
from avatar_ros.loop.shown_modes import ShownModesReport
from avatar_ros.loop.statistics import TimingRecord, statistics
from avatar_ros.loop.tool_channel import ToolChannel

REPORT_PERIOD = 1.0  # [s]
# time between counts of publishers and subscribers [s]; without any, each report counts
_COUNT_PERIOD = 0.1
_MINUTE = 60.0  # [s]
_PAUSE = 0.005  # pause between two parts of a report [s]
_COLLECTED = 10  # reports from one garbage collection to the next


class ContactReports:
    """Summarises the loop's last window, chooses the modes of the next, and publishes both.

    Parameters
    ----------
    devices : sequence of ToolDevice
        Devices whose operating states are read; empty if not asked.
    ports : Ports
        Ports of the node, whose mismatches are reported.
    """

    def __init__(
        self,
        node: Node,
        loop: ContactLoop,
        tools: Sequence[ToolChannel],
        devices: Sequence[ToolDevice],
        publishers: Publishers,
        ports: Ports,
    ) -> None:
        self._node, self._loop, self._tools = node, loop, tools
        self._devices, self._publishers, self._ports = devices, publishers, ports
        self._faults = diagnostics.FaultCounter(tools)
        # topics that only one cell may publish
        self._owned = [node.resolve_topic_name("vademecum")]
        self._owned += [tool.publisher.topic_name for tool in tools]
        self._logged: dict[str, str] = {}  # last logged fault, by tool
        self._logged_rivals: list[str] = []
        self._shown_modes_log = ShownModesLog(node)
        self._timers: list[Timer] = []  # timers of the reports, and of the counts between them
        self._n_reports = 0

    def start(self) -> None:
        """Report and count until :meth:`stop`."""
        self._timers = [
            self._node.create_timer(REPORT_PERIOD, self._report),
            self._node.create_timer(_COUNT_PERIOD, self._count),
        ]

    def stop(self) -> None:
        """End reports and counts."""
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers = []

    def _report(self) -> None:
        self.publish()
        self.count_ends()
        if not self._is_alone():
            self._timers[1].reset()

    def _count(self) -> None:
        self.count_ends()
        if self._is_alone():
            self._timers[1].cancel()

    def _is_alone(self) -> bool:
        """Return whether there is no vademecum and no tool or device to watch."""
        connected = self._devices or any(tool.connected for tool in self._tools)
        return self._loop.active.data is None and not connected

    def publish(self) -> None:
        """Publish statistics and diagnostics of the window that ends now."""
        loop, end = self._loop, time.monotonic_ns()
        record, loop.record = loop.record, TimingRecord(end)
        window = statistics(record, end)
        window.header.stamp = self._node.get_clock().now().to_msg()
        shown_modes = loop.active.shown_modes
        report = shown_modes.update(window, self._is_watched()) if shown_modes is not None else None
        self._publishers.statistics.publish(window)
        time.sleep(_PAUSE)
        self._publish_diagnostics(window, record.nominal_rate, report)
        self._n_reports += 1
        if self._n_reports % _COLLECTED == 0:
            time.sleep(_PAUSE)
            gc.collect()  # the loop's process collects nowhere else

    def _is_watched(self) -> bool:
        """Return whether a tool touches the organ, or somebody receives the cloud."""
        data = self._loop.active.data
        touched = data is not None and data.out.n_contacts[0] > 0
        return touched or self._publishers.deformation.get_subscription_count() > 0

    def _publish_diagnostics(
        self, window: LoopStatistics, nominal: float, report: ShownModesReport | None
    ) -> None:
        node, loop, active = self._node, self._loop, self._loop.active
        name = node.get_fully_qualified_name()
        limits = {p.name: node.get_parameter(p.name).value for p in THRESHOLDS}
        accuracy = active.shown_modes.accuracy if active.shown_modes is not None else ""
        mismatches = self._ports.mismatches()
        others = [line for topic in self._owned if (line := rivals(node, topic))]
        self._log_rivals(others)
        time.sleep(_PAUSE)
        statuses = [
            diagnostics.loop_status(name, window, nominal, limits),
            diagnostics.vademecum_status(name, active.id, accuracy),
            diagnostics.qos_status(name, mismatches),
            diagnostics.cells_status(name, others),
        ]
        if report is not None:
            self._shown_modes_log.note(report)
            statuses.append(diagnostics.accuracy_status(name, report.text, report.shedding, window))
        for i, faults in enumerate(self._faults.window()):
            tool_name = loop.settings.tools[i]
            self._log_fault(tool_name, faults.text)
            statuses.append(
                diagnostics.tool_status(
                    name, tool_name, self._tools[i], loop.guards[i], faults, loop.energies, i
                )
            )
        message = DiagnosticArray(status=statuses)
        message.header.stamp = node.get_clock().now().to_msg()
        self._publishers.diagnostics.publish(message)

    def _log_rivals(self, lines: list[str]) -> None:
        """Log other cells when they appear or change."""
        for line in (line for line in lines if line not in self._logged_rivals):
            self._node.get_logger().error(f"{line}: {ONE_CELL}")
        self._logged_rivals = lines

    def _log_fault(self, tool: str, text: str) -> None:
        """Log a tool's fault when it differs from the last window's."""
        if text != self._logged.get(tool, ""):
            self._logged[tool] = text
            if text:
                self._node.get_logger().warning(f"{tool}: {text}")
            else:
                self._node.get_logger().info(f"{tool}: the fault is over")

    def count_ends(self) -> None:
        """Count publishers and subscribers of each tool, and check which devices are there."""
        for tool in self._tools:
            was_connected = tool.connected
            now = time.monotonic_ns()
            tool.note_senders(self._senders(tool), now)
            tool.listeners = tool.publisher.get_subscription_count()
            tool.band_listeners = sum(p.get_subscription_count() for p in tool.band_publishers)
            if tool.connected and not was_connected:
                self._loop.wake()
        for device in self._devices:
            device.attend()

    def _senders(self, tool: ToolChannel) -> dict[str, str]:
        """Return the publishers of a tool's poses, for :meth:`ToolChannel.note_senders`.

        They are looked up only if their number changed or matters, because the loop waits
        meanwhile.
        """
        topic = tool.subscription.topic_name
        n, known = self._node.count_publishers(topic), tool.senders
        return known if n == len(known) <= 1 else publishers(self._node, topic)


class ShownModesLog:
    """Log of left-out modes, once a minute at most, and of their return."""

    def __init__(self, node: Node, clock: Callable[[], float] = time.monotonic) -> None:
        self._node, self._clock = node, clock
        self._warned = -_MINUTE  # time of the last warning [s]
        self._left_out = False  # state according to the log

    def note(self, report: ShownModesReport) -> None:
        """Log the report of a window if it is news."""
        if report.shedding and report.changed and self._clock() - self._warned >= _MINUTE:
            self._warned, self._left_out = self._clock(), True
            self._node.get_logger().warning(report.text)
        elif self._left_out and not report.shedding:
            # on a line of its own: rclpy takes one severity for each line of code
            self._left_out = False
            self._node.get_logger().info(report.text)
