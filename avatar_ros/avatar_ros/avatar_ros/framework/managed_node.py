"""Life cycle that all nodes share: managed transitions, start, signals, exit code."""

from __future__ import annotations

import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.timer import Timer
from rclpy.utilities import get_rmw_implementation_identifier

from avatar_core.errors import AvatarError
from avatar_ros.framework import discovery
from avatar_ros.framework.answering import answer_always, never_raising
from avatar_ros.framework.ending import end_within
from avatar_ros.framework.parameters import Parameter, ParameterError, declare
from avatar_ros.framework.ports import Ports
from avatar_ros.framework.stop_signal import Stopped, StopSignal

_END = 1.0  # limit from the last answer to the end of the process [s]
_LAST_ANSWERS = 1.0  # limit for requests that are pending when the node ends [s]
_LOOK = 0.1  # period of checks whether pending requests are answered [s]


class ManagedNode(LifecycleNode, ABC):
    """Lifecycle node whose transitions may raise; the error is the reason of the refusal.

    A subclass implements ``configure``, ``activate``, ``deactivate`` and ``clean_up``; the last two
    may be called in any state. Parameters are declared here, so that a wrong value is refused
    before anything starts.

    Attributes
    ----------
    refusal : str
        Reason why the last transition failed.
    is_shut_down : bool
        Whether the process or a client shut it down.
    ports : Ports
        Makes publishers and subscriptions.
    """

    def __init__(self, name: str, declared: tuple[Parameter, ...]) -> None:
        super().__init__(name)
        self.refusal = ""
        self.is_shut_down = False
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.ports = Ports(self)
        declare(self, declared)

    @abstractmethod
    def configure(self) -> None:
        """Do all work that may fail."""

    @abstractmethod
    def activate(self) -> None:
        """Start to serve."""

    @abstractmethod
    def deactivate(self) -> None:
        """Stop serving."""

    @abstractmethod
    def clean_up(self) -> None:
        """Release what ``configure`` acquired."""

    @property
    def failure(self) -> str:
        """Return why the node cannot continue; empty otherwise. Read after each callback."""
        return ""

    @property
    def has_pending_answers(self) -> bool:
        """Return whether requests must still be answered before the node is destroyed."""
        return False

    def create_timer(self, *what: Any, **how: Any) -> Timer:
        """Create a timer that runs even with ``use_sim_time`` while nobody sends ``/clock``."""
        return super().create_timer(*what, **{"clock": self._steady_clock, **how})

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *what: Any, **how: Any
    ) -> Any:
        """Create a subscription that logs its callback's exceptions: no message ends the node."""
        heard = never_raising(self, topic, callback)
        return super().create_subscription(msg_type, topic, heard, *what, **how)

    def bring_up(self) -> bool:
        """Configure and activate; return false if the node refused."""
        return all(
            trigger() == TransitionCallbackReturn.SUCCESS
            for trigger in (self.trigger_configure, self.trigger_activate)
        )

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure as a transition; on failure, clean up."""
        return self._attempt(self.configure, self.clean_up)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate as a transition; on failure, deactivate."""
        return self._attempt(self.activate, self.deactivate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate as a transition."""
        return self._attempt(self.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up as a transition."""
        return self._attempt(self.clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Shut down as a transition, from any state."""
        self.is_shut_down = True
        return self._attempt(self.release)

    def release(self) -> None:
        """Stop serving and release everything, in any state."""
        self.deactivate()
        self.clean_up()

    def _attempt(
        self, transition: Callable[[], None], undo: Callable[[], None] | None = None
    ) -> TransitionCallbackReturn:
        try:
            transition()
            return TransitionCallbackReturn.SUCCESS
        except (ParameterError, AvatarError, OSError) as error:
            self.refusal = str(error)
        except Exception as error:  # rclpy would drop the error
            self.refusal = f"{type(error).__name__}: {error}"
            traceback.print_exc()
        self.get_logger().error(self.refusal)
        if undo is not None:
            undo()
        return TransitionCallbackReturn.FAILURE


def spin_until(stop: StopSignal, node: Node) -> None:
    """Serve a plain node until the signal is received, then shut it and rclpy down."""
    answer_always(node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        with stop.wakes(executor):
            while not stop:
                executor.spin_once()
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def run(make_node: Callable[[], ManagedNode], keeps_time: bool = False) -> int:
    """Bring a node up, spin it until SIGINT or SIGTERM, shut it down; return the exit code.

    The signal handlers of rclpy are not used: they shut the middleware down while the loop still
    has a last message to send.

    Parameters
    ----------
    make_node : callable
        Makes the node, after ``rclpy.init``.
    keeps_time : bool
        Whether no other process may delay what the node publishes.
    """
    stop, code = StopSignal(), 1
    node: ManagedNode | None = None
    try:
        discovery.stay_local()
        middleware = get_rmw_implementation_identifier()
        with discovery.udp_alone(middleware) if keeps_time else nullcontext():
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
            node = make_node()
        code = _live(node, stop)
    except (ParameterError, AvatarError) as error:
        print(error, file=sys.stderr)
    finally:
        end_within(_END, code)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def _live(node: ManagedNode, stop: StopSignal) -> int:
    answer_always(node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    leave: Callable[[], object] = node.trigger_shutdown
    try:
        with stop.interrupts():  # a large organ takes a while to read
            if node.get_parameter("autostart").value and not node.bring_up():
                return 1  # the node has logged the reason
        with stop.wakes(executor):
            while not stop and not node.failure:
                executor.spin_once()
        if node.failure:
            node.get_logger().fatal(node.failure)
        return 1 if node.failure else 0
    except Stopped:
        leave = node.release  # no other transition leads out of an unfinished one
        return 0
    finally:
        if not node.is_shut_down:
            leave()
        end = time.monotonic() + _LAST_ANSWERS
        while node.has_pending_answers and time.monotonic() < end:
            executor.spin_once(timeout_sec=_LOOK)
        executor.shutdown(timeout_sec=_LAST_ANSWERS)  # otherwise it waits forever for open requests
