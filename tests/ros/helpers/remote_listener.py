"""Listener to a contact node on its own host, which reports twenty times a second.

Run as ``python tests/ros/helpers/remote_listener.py``. Each line is one JSON object: time on the
monotonic clock [s], number of wrenches, largest force since the last line [N], whether all numbers
were finite, the last status and the vademecum in use.
"""

from __future__ import annotations

import json
import math
import time

import rclpy
from geometry_msgs.msg import WrenchStamped

from avatar_interfaces.msg import ContactState
from avatar_ros.framework import qos


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("remote_listener", enable_rosout=False, start_parameter_services=False)
    heard = {"n": 0, "largest": 0.0, "finite": True, "status": -1, "id": ""}

    def force(wrench: WrenchStamped) -> None:
        f = wrench.wrench.force
        size = math.hypot(f.x, f.y, f.z)
        heard["n"] += 1
        heard["largest"] = max(heard["largest"], size)
        heard["finite"] = heard["finite"] and math.isfinite(size)

    def state(message: ContactState) -> None:
        heard["status"], heard["id"] = message.status, message.vademecum_id

    node.create_subscription(WrenchStamped, "tool/servo_cf", force, qos.COMMAND)
    node.create_subscription(ContactState, "contact_state", state, qos.NEWEST)
    said = time.monotonic()
    while True:
        rclpy.spin_once(node, timeout_sec=0.01)
        if time.monotonic() > said + 0.05:
            said = time.monotonic()
            print(json.dumps({"at": said, **heard}), flush=True)
            heard["largest"] = 0.0


if __name__ == "__main__":
    main()
