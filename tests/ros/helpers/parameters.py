"""Parameters of a running node, read and set by a probe."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python


def parameter_names(probe: Any, node: str) -> set[str]:
    """Return the names that a node declares itself."""
    listed = probe.ask(ListParameters, f"/{node}/list_parameters", ListParameters.Request())
    return set(listed.result.names) - {"use_sim_time", "start_type_description_service"}


def parameter_values(probe: Any, node: str, names: Iterable[str]) -> dict[str, Any]:
    """Return values by name."""
    request = GetParameters.Request(names=list(names))
    values = probe.ask(GetParameters, f"/{node}/get_parameters", request).values
    return dict(zip(request.names, map(parameter_value_to_python, values), strict=True))


def set_parameters(probe: Any, node: str, values: Mapping[str, Any]) -> list[bool]:
    """Set one after the other; return whether each was accepted."""
    return [answer.successful for answer in _answers(probe, node, values)]


def set_parameter(probe: Any, node: str, name: str, value: Any) -> Any:
    """Return the answer: ``successful``, and else a ``reason``."""
    return _answers(probe, node, {name: value})[0]


def _answers(probe: Any, node: str, values: Mapping[str, Any]) -> Any:
    messages = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    request = SetParameters.Request(parameters=messages)
    return probe.call(SetParameters, f"/{node}/set_parameters", request).results
