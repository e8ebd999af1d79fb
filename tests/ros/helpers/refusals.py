"""Reasons why a node does not start, found in the test's own process.

Other tests start a node of each kind as a process.
"""

from __future__ import annotations

import gc

import rclpy
from rclpy.signals import SignalHandlerOptions

from avatar_core.errors import AvatarError
from avatar_ros.framework.managed_node import ManagedNode
from avatar_ros.framework.parameters import ParameterError
from avatar_ros.nodes.contact import ContactNode
from avatar_ros.nodes.patient_interpolation import PatientInterpolationNode
from avatar_ros.nodes.vademecum_loader import LoaderNode
from tests.ros.conftest import free_domain

NODES: dict[str, type[ManagedNode]] = {
    "contact": ContactNode,
    "patient_interpolation": PatientInterpolationNode,
    "vademecum_loader": LoaderNode,
}


def refusal(name: str, *values: str) -> str:
    """Return one line, or "" if the node starts; ``values`` are parameters, ``name:=value``.

    The domain is empty. A participant that ends waits for news of others, possibly forever (Fast
    DDS, issue 6513).
    """
    arguments = ["--ros-args", *(word for value in values for word in ("-p", value))]
    with free_domain() as number:
        no_handlers = SignalHandlerOptions.NO
        rclpy.init(args=arguments, signal_handler_options=no_handlers, domain_id=number)
        try:
            return _refusal(NODES[name])
        finally:
            rclpy.try_shutdown()
            gc.collect(1)  # an unfinished node keeps its participant, which others would hear


def _refusal(kind: type[ManagedNode]) -> str:
    try:
        node = kind()
    except (ParameterError, AvatarError) as error:
        return str(error)
    try:
        return "" if node.bring_up() else node.refusal
    except (ParameterError, AvatarError) as error:
        return str(error)
    finally:
        node.trigger_shutdown()
        node.destroy_node()
