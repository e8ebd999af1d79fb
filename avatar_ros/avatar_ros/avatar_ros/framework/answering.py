"""Services that answer any request, and topics that survive any message."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import iscoroutinefunction
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node

from avatar_core.errors import one_line
from avatar_ros.framework.parameters import ParameterError

Answer = Callable[[Any, Any], Any]  # takes a request and an empty response


def answer_always(node: Node) -> None:
    """Make each service of a node refuse, and log, requests for which its callback raises.

    rclpy's own services raise, e.g. for a transition that is not allowed now. The exception would
    end the node, and its client would wait forever.
    """
    for service in node.services:
        # our own services, which catch all exceptions
        if not iscoroutinefunction(service.callback):
            service.callback = _answering(node, service)


def never_raising(node: Node, topic: str, callback: Callable[..., Any]) -> Callable[..., None]:
    """Wrap the callback of a topic so that its exceptions are logged."""

    @wraps(callback)  # keeps the signature, which rclpy inspects
    def hear(*message: Any) -> None:
        try:
            callback(*message)
        except Exception as error:
            node.get_logger().error(f"{topic}: a message is not taken: {one_line(error)}")

    return hear


def _answering(node: Node, service: Any) -> Answer:
    ask, kind, name = service.callback, service.srv_type, service.srv_name.rpartition("/")[2]

    def answer(request: Any, response: Any) -> Any:
        try:
            _require_declared(node, kind, request)
            return ask(request, response)
        except Exception as error:
            reason = one_line(error)
            node.get_logger().error(f"{name}: {reason}")
            return _refused(kind, request, reason)

    return _one_by_one(answer) if kind is SetParameters else answer


def _require_declared(node: Node, kind: Any, request: Any) -> None:
    """Name parameters that a node does not have; rclpy's own refusal names none."""
    if kind in (SetParameters, SetParametersAtomically):
        unknown = [one.name for one in request.parameters if not node.has_parameter(one.name)]
        if unknown:
            raise ParameterError(f"{node.get_name()} has no parameter {', '.join(unknown)}")


def _one_by_one(answer: Answer) -> Answer:
    """Set each parameter separately, so that a refused value does not block the others."""

    def answer_each(request: SetParameters.Request, response: SetParameters.Response) -> Any:
        for parameter in request.parameters:
            alone = answer(SetParameters.Request(parameters=[parameter]), SetParameters.Response())
            response.results = [*response.results, *alone.results]
        return response

    return answer_each


def _refused(kind: Any, request: Any, reason: str) -> Any:
    """Return a response with the reason where the type has a field for it, else an empty one."""
    response = kind.Response()  # its ``success`` is false
    result = SetParametersResult(successful=False, reason=reason)
    if kind is SetParameters:
        response.results = [result for _ in request.parameters]
    elif kind is SetParametersAtomically:
        response.result = result
    return response
