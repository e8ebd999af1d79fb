"""A tool that sends one stream of poses after the other, each from a publisher of its own.

Run as ``python tests/ros/stream_tool.py X Y Z SECONDS KIND:RATE ...``: where it is [m], how long
each stream lasts [s], and what it sends how often [Hz]. Prints a line for each stream: when it
began and ended, by the monotonic clock, and the longest time between two poses [s].
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node

PAUSE = 2.0  # between two streams [s]
MATCHED = 0.5  # after which both ends know each other [s]


def _frame(message: PoseStamped) -> None:
    message.header.frame_id = "world"


def _stamp(message: PoseStamped) -> None:
    message.header.stamp.sec = message.header.stamp.nanosec = 0


def _nan(message: PoseStamped) -> None:
    message.pose.position.y = math.nan


def _quaternion(message: PoseStamped) -> None:
    message.pose.orientation.w = 0.0


SPOIL: dict[str, Callable[[PoseStamped], None]] = {
    "valid": lambda message: None,
    "frame": _frame,
    "stamp": _stamp,
    "NaN": _nan,
    "quaternion": _quaternion,
}


def stream(node: Node, message: PoseStamped, kind: str, rate: float, seconds: float) -> None:
    publisher = node.create_publisher(PoseStamped, "tool/measured_cp", 1)
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    time.sleep(MATCHED)
    begin = due = last = time.monotonic()
    longest = 0.0
    while last < begin + seconds:
        message.header.stamp = node.get_clock().now().to_msg()
        SPOIL[kind](message)
        publisher.publish(message)
        due = max(due + 1.0 / rate, last)
        time.sleep(max(due - time.monotonic(), 0.0))
        now = time.monotonic()
        longest, last = max(longest, now - last), now
    print(begin, last, longest, flush=True)
    node.destroy_publisher(publisher)


def main() -> None:
    x, y, z, seconds = (float(word) for word in sys.argv[1:5])
    rclpy.init()
    node = rclpy.create_node("stream_tool", enable_rosout=False, start_parameter_services=False)
    for word in sys.argv[5:]:
        kind, rate = word.split(":")
        message = PoseStamped()
        message.header.frame_id, message.pose.orientation.w = "organ", 1.0
        message.pose.position.x, message.pose.position.y, message.pose.position.z = x, y, z
        stream(node, message, kind, float(rate), seconds)
        time.sleep(PAUSE)


if __name__ == "__main__":
    main()
