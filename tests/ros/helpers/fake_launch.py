"""A stand-in for the packages launch and launch_ros, sufficient to evaluate our launch file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any


@dataclass
class LaunchContext:
    """Command line, and the values of the arguments."""

    argv: list[str] = field(default_factory=list)
    launch_configurations: dict[str, str] = field(default_factory=dict)


@dataclass
class LaunchDescription:
    entities: list[Any]


@dataclass
class DeclareLaunchArgument:
    name: str
    default_value: Any
    description: str


@dataclass
class OpaqueFunction:
    function: Callable[[LaunchContext], list[Any]]


@dataclass
class LaunchConfiguration:
    name: str

    def perform(self, context: LaunchContext) -> str:
        return context.launch_configurations[self.name]


@dataclass
class FindPackageShare:
    package: str

    def perform(self, context: LaunchContext) -> str:
        from ament_index_python.packages import get_package_share_directory

        return str(get_package_share_directory(self.package))


@dataclass
class PathJoinSubstitution:
    parts: list[Any]

    def perform(self, context: LaunchContext) -> str:
        return "/".join(p if isinstance(p, str) else p.perform(context) for p in self.parts)


@dataclass
class ParameterValue:
    value: Any
    value_type: type

    def evaluate(self, context: LaunchContext) -> Any:
        return self.value_type(self.value.perform(context))


@dataclass
class Node:
    package: str
    executable: str
    parameters: list[Any]


def modules() -> dict[str, ModuleType]:
    """Return the modules for ``sys.modules``."""
    contents: dict[str, tuple[type, ...]] = {
        "launch": (LaunchContext, LaunchDescription),
        "launch.actions": (DeclareLaunchArgument, OpaqueFunction),
        "launch.substitutions": (LaunchConfiguration, PathJoinSubstitution),
        "launch_ros": (),
        "launch_ros.actions": (Node,),
        "launch_ros.parameter_descriptions": (ParameterValue,),
        "launch_ros.substitutions": (FindPackageShare,),
    }
    found = {name: ModuleType(name) for name in contents}
    for name, types in contents.items():
        vars(found[name]).update({one.__name__: one for one in types})
    return found


def evaluate(description: LaunchDescription, argv: list[str]) -> dict[str, list[Any]]:
    """Return the parameters of each started node: a file, then values by name."""
    context = LaunchContext(argv, dict(word.split(":=", 1) for word in argv))
    started: dict[str, list[Any]] = {}
    for entity in description.entities:
        if isinstance(entity, DeclareLaunchArgument):
            default = entity.default_value
            value = default if isinstance(default, str) else default.perform(context)
            context.launch_configurations.setdefault(entity.name, value)
        else:
            for node in entity.function(context):
                file, values = node.parameters
                values = {
                    name: value.evaluate(context) if isinstance(value, ParameterValue) else value
                    for name, value in values.items()
                }
                started[node.executable] = [file, values]
    return started
