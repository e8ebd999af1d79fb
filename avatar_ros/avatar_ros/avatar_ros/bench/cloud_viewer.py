"""A process of a measured cell that takes every cloud and collects the loop's statistics.

Run as ``python -m avatar_ros.bench.cloud_viewer FILE.json``; the file is written at SIGINT or
SIGTERM.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

from avatar_interfaces.msg import LoopStatistics
from avatar_ros.framework import qos, realtime
from avatar_ros.framework.managed_node import spin_until
from avatar_ros.framework.stop_signal import StopSignal


def main() -> int:
    """Take clouds and statistics until a signal comes; return the exit code."""
    output = Path(sys.argv[1])
    stop = StopSignal()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("cloud_viewer", enable_rosout=False, start_parameter_services=False)
    # counted by second: a list of all times would look like a leak
    clouds: Counter[int] = Counter()
    n_bytes = [0]
    statistics: list[dict[str, Any]] = []

    def view(cloud: bytes) -> None:
        clouds[int(time.monotonic())] += 1
        n_bytes[0] = len(cloud)

    def note(message: LoopStatistics) -> None:
        numbers = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
        del numbers["header"]
        statistics.append({"received": time.monotonic(), **numbers})

    node.create_subscription(PointCloud2, "deformation", view, qos.NEWEST, raw=True)
    node.create_subscription(LoopStatistics, "statistics", note, qos.STATISTICS)
    realtime.tune_interpreter()
    spin_until(stop, node)
    output.write_text(
        json.dumps({"clouds": clouds, "cloud_bytes": n_bytes[0], "statistics": statistics})
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
