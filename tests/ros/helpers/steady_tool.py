"""A tool that presses the organ again and again, for as long as it lives.

Run as ``python tests/ros/helpers/steady_tool.py X Y Z NX NY NZ [RATE [SWING]]``: the tip's centre
touching the surface, the outward normal there, poses per second [Hz], amplitude [m].
"""

from __future__ import annotations

import math
import sys
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped

from avatar_ros.framework import qos, realtime
from avatar_ros.framework.templates import PoseTemplate, stamp_bytes

MEAN, SWING, FREQUENCY = 1.5e-3, 1.0e-3, 2.0  # depth [m], [m], [Hz]


def main() -> None:
    numbers = np.array([float(word) for word in sys.argv[1:7]])
    rate = float(sys.argv[7]) if len(sys.argv) > 7 else 1000.0
    swing = float(sys.argv[8]) if len(sys.argv) > 8 else SWING
    rclpy.init()
    node = rclpy.create_node("steady_tool", enable_rosout=False, start_parameter_services=False)
    publisher = node.create_publisher(PoseStamped, "tool/measured_cp", qos.NEWEST)
    pose = PoseTemplate("organ")
    realtime.tune_interpreter()
    tick, period = time.monotonic_ns(), round(1e9 / rate)
    while True:
        tick = max(tick + period, time.monotonic_ns() - 20 * period)
        realtime.sleep_until(tick)
        depth = MEAN - swing * math.cos(2 * math.pi * FREQUENCY * tick * 1e-9)
        pose.position[:] = numbers[:3] - depth * numbers[3:]
        publisher.handle.publish_raw(pose.serialise(stamp_bytes(time.time_ns())))


if __name__ == "__main__":
    main()
