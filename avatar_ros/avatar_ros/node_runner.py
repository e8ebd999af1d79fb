"""The life of a node's process: start, transitions to active, signals, exit code."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from typing import Any, Protocol

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from avatar_core.errors import AvatarError
from avatar_ros.parameters import ParameterError

_SIGNAL_LATENCY = 0.1  # longest until a signal is noticed [s]


class CellNode(Protocol):
    """A lifecycle node that says why it refused a transition, or why it cannot go on."""

    refusal: str
    failure: str


def run(make_node: Callable[[], Any]) -> int:
    """Bring a node up, spin it until SIGINT or SIGTERM, take it down; returns the exit code.

    The signal handlers of rclpy are not used: they pull the middleware away from under a loop
    that still has a last message to send.
    """
    stop = StopSignal()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        return _live(make_node, stop)
    except (ParameterError, AvatarError) as error:
        print(error, file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()


class StopSignal:
    """True once SIGINT or SIGTERM came."""

    def __init__(self) -> None:
        self._came = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, *_: object) -> None:
        self._came = True

    def __bool__(self) -> bool:
        return self._came


def _live(make_node: Callable[[], Any], stop: StopSignal) -> int:
    node = make_node()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        if node.get_parameter("autostart").value and not bring_up(node):
            print(node.refusal, file=sys.stderr)
            return 1
        while not stop and not node.failure:
            executor.spin_once(timeout_sec=_SIGNAL_LATENCY)
        if node.failure:
            print(node.failure, file=sys.stderr)
        return 1 if node.failure else 0
    finally:
        node.trigger_shutdown()
        executor.shutdown()
        node.destroy_node()


def bring_up(node: LifecycleNode) -> bool:
    """Configure and activate; false if the node refused."""
    for trigger in (node.trigger_configure, node.trigger_activate):
        if trigger() != TransitionCallbackReturn.SUCCESS:
            return False
    return True
