"""Parameters of nodes, each declared once with type, default, range and meaning."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node


class ParameterError(ValueError):
    """Parameter value that the node cannot use; the message says which values it accepts."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    Attributes
    ----------
    range : tuple of float, optional
        Smallest and largest value of a number.
    any_type : bool
        The type may differ from the default's; the reader of the value checks it.
    """

    name: str
    default: Any
    description: str
    range: tuple[float, float] | None = None
    read_only: bool = True
    any_type: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """Return the descriptor that rclpy declares it with."""
        descriptor = ParameterDescriptor(
            description=self.description, read_only=self.read_only, dynamic_typing=self.any_type
        )
        if self.range is not None and isinstance(self.default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=self.range[0], to_value=self.range[1])
            ]
        elif self.range is not None:
            low, high = (int(bound) for bound in self.range)
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
        return descriptor

    def wanted(self) -> str:
        """Describe the accepted values, e.g. for an error message."""
        kind = "a number with a decimal point" if isinstance(self.default, float) else "a value"
        bounds = f" from {self.range[0]:g} to {self.range[1]:g}" if self.range else ""
        quoted = ", in quotes if it is off" if re.search(r"\boff\b", self.description) else ""
        return f"{kind}{bounds} like {self.default!r}{quoted}"


def declare(node: Node, parameters: tuple[Parameter, ...]) -> None:
    """Declare all parameters, with the values given by files and command line.

    Raises
    ------
    ParameterError
        If a given value has the wrong type or lies out of range.
    """
    for parameter in parameters:
        try:
            node.declare_parameter(parameter.name, parameter.default, parameter.descriptor())
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ParameterError(
                f"parameter {parameter.name}: give {parameter.wanted()} ({parameter.description})"
            ) from error


def values(node: Node, parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    """The values of declared parameters, by name."""
    return {p.name: node.get_parameter(p.name).value for p in parameters}


def frame(name: str) -> str:
    """Return a frame's name; raise ParameterError if it is empty."""
    if not name:
        raise ParameterError("parameter frame_id: give the name of the organ's frame")
    return name


IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # pose x y z, quaternion x y z w


def pose(name: str, numbers: Any) -> tuple[float, ...]:
    """Return a pose x y z [m], quaternion x y z w; raise ParameterError for other numbers."""
    found = tuple(float(number) for number in numbers)
    square = sum(number * number for number in found[3:])
    if len(found) != 7 or not all(map(math.isfinite, found)) or not abs(square - 1.0) < 2e-3:
        raise ParameterError(
            f"parameter {name}: give x y z in metres and a quaternion x y z w of length 1"
        )
    return found


AUTOSTART = Parameter(
    "autostart", True, "configure and activate at start; false: wait for lifecycle transitions"
)
FRAME_ID = Parameter("frame_id", "organ", "frame of the organ; poses in other frames are refused")
