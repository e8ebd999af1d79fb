"""A node with the topics of an idle contact node and nothing else: what rclpy takes by itself."""

from __future__ import annotations

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

from avatar_ros.framework import qos
from avatar_ros.framework.managed_node import spin_until
from avatar_ros.framework.stop_signal import StopSignal
from avatar_ros.msg import ContactState, LoopStatistics


def main() -> int:
    stop = StopSignal()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("bare")
    node.create_subscription(PoseStamped, "tool/measured_cp", lambda _: None, qos.NEWEST)
    for topic in ("servo_cf", "force_low", "force_high"):
        node.create_publisher(WrenchStamped, f"tool/{topic}", qos.COMMAND)
    node.create_publisher(ContactState, "contact_state", qos.state(1))
    node.create_publisher(PointCloud2, "deformation", qos.NEWEST)
    node.create_publisher(LoopStatistics, "statistics", qos.STATISTICS)
    node.create_publisher(DiagnosticArray, "diagnostics", qos.STATISTICS)
    spin_until(stop, node)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
