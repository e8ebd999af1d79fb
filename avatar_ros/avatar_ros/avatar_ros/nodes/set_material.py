"""Sets values of the material in the running contact node, all or none of them.

Command for ``avatar calibrate --set``: ``python -m avatar_ros.nodes.set_material young=5300
support.bare_area=2e6``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from avatar_ros.loop.settings import MATERIAL

_FOUND_WITHIN = 10.0  # time to find the contact node [s]
_ANSWERED_WITHIN = 60.0  # time for its answer; the node then prepares the material [s]


def main(arguments: Sequence[str] | None = None) -> int:
    """Set the given values; return 1 after an error line if no contact node accepts them."""
    given = sys.argv[1:] if arguments is None else arguments
    values = dict(word.split("=", 1) for word in given)
    if others := sorted(values.keys() - set(MATERIAL.values())):
        print(
            f"avatar: no parameter of the contact node is {others[0]}; set material.supports of a "
            "scene",
            file=sys.stderr,
        )
        return 1
    rclpy.init()
    try:
        node = Node("avatar_calibrate")
        refusal = _set(node, {name: float(value) for name, value in values.items()})
    finally:
        rclpy.try_shutdown()
    if refusal:
        print(f"avatar: {refusal}", file=sys.stderr)
        return 1
    print(f"accepted by the contact node: {', '.join(given)}")
    return 0


def _set(node: Node, values: dict[str, float]) -> str:
    """Set values by coordinate; return why not, or "" if the node accepted them."""
    names = {coordinate: name for name, coordinate in MATERIAL.items()}
    client = AsyncParameterClient(node, "contact")
    if not client.wait_for_services(_FOUND_WITHIN):
        return "no contact node answers; start one with 'avatar cell', and try again"
    parameters = [
        Parameter(names[name], Parameter.Type.DOUBLE, value) for name, value in values.items()
    ]
    future = client.set_parameters_atomically(parameters)
    rclpy.spin_until_future_complete(node, future, timeout_sec=_ANSWERED_WITHIN)
    if not future.done() or future.result() is None:
        return f"the contact node did not answer within {_ANSWERED_WITHIN:g} s"
    result = future.result().result
    return "" if result.successful else str(result.reason)


if __name__ == "__main__":
    raise SystemExit(main())
