"""Changes of the material while the tool moves, as by dragging a slider of the planning page.

Run as ``python -m avatar_ros.bench.material_slider FILE.h5 RATE COUNT.json``. It sets Young's
modulus and every coordinate of the vademecum to random values, RATE times a second. At SIGINT or
SIGTERM it writes how many changes were accepted.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum
from avatar_ros.framework import realtime
from avatar_ros.framework.managed_node import spin_until
from avatar_ros.framework.stop_signal import StopSignal
from avatar_ros.loop.settings import MATERIAL

_YOUNG = (0.5, 2.0)  # range relative to the vademecum's Young's modulus


def main() -> int:
    """Change the material until a signal comes; return the exit code."""
    vademecum, rate = load_vademecum(sys.argv[1]), float(sys.argv[2])
    ranges = _ranges(vademecum)
    rng = np.random.default_rng(0)
    stop = StopSignal()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("material_slider", enable_rosout=False, start_parameter_services=False)
    client = node.create_client(SetParameters, "contact/set_parameters")
    accepted = [0]

    def count(answer: Future) -> None:
        accepted[0] += all(result.successful for result in answer.result().results)

    def change() -> None:
        if not client.service_is_ready():
            return
        named = [
            Parameter(
                name=name,
                value=ParameterValue(
                    type=ParameterType.PARAMETER_DOUBLE, double_value=rng.uniform(low, high)
                ),
            )
            for name, (low, high) in ranges.items()
        ]
        request = SetParameters.Request(parameters=named)
        client.call_async(request).add_done_callback(count)

    node.create_timer(1.0 / rate, change)
    realtime.tune_interpreter()
    spin_until(stop, node)
    Path(sys.argv[3]).write_text(json.dumps({"accepted": accepted[0]}))
    return 0


def _ranges(vademecum: Vademecum) -> dict[str, tuple[float, float]]:
    """Return the range of each of the contact node's parameters, by name."""
    own = vademecum.material.young_modulus
    ranges = {"young": (_YOUNG[0] * own, _YOUNG[1] * own)}
    if vademecum.parametric is not None:
        ranges |= {c.name: (c.low, c.high) for c in vademecum.parametric.coordinates}
    return {name: ranges[key] for name, key in MATERIAL.items() if key in ranges}


if __name__ == "__main__":
    raise SystemExit(main())
