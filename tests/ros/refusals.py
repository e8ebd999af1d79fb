"""Why a node does not start, found in the test's own process; a node of each kind is started
as a process elsewhere."""

from __future__ import annotations

from collections.abc import Callable

import rclpy
from avatar_ros.framework.managed_node import ManagedNode
from avatar_ros.framework.parameters import ParameterError
from avatar_ros.nodes.contact import ContactNode
from avatar_ros.nodes.patient_interpolation import PatientInterpolationNode
from avatar_ros.nodes.vademecum_loader import LoaderNode
from rclpy.signals import SignalHandlerOptions

from avatar_core.errors import AvatarError

NODES: dict[str, Callable[[], ManagedNode]] = {
    "contact": ContactNode,
    "patient_interpolation": PatientInterpolationNode,
    "vademecum_loader": LoaderNode,
}


def refusal(name: str, *values: str) -> str:
    """One line, or empty if the node starts; ``values`` are parameters, ``name:=value``."""
    arguments = ["--ros-args", *(word for value in values for word in ("-p", value))]
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = NODES[name]()
        try:
            return "" if node.bring_up() else node.refusal
        finally:
            node.trigger_shutdown()
            node.destroy_node()
    except (ParameterError, AvatarError) as error:
        return str(error)
    finally:
        rclpy.try_shutdown()
