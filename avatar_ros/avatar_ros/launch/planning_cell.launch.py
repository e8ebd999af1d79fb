"""A planning cell: `ros2 launch avatar_ros planning_cell.launch.py params:=FILE.yaml`.

The file ``params`` holds the parameters of all nodes; the other arguments override those of the
same name. The node patient_interpolation runs only if there is an atlas, planning_ui only with
``ui:=true``. The arguments are the options of `avatar cell`.
"""

import sys
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# as in avatar_ros.nodes.cell, which the Python of `ros2 launch` may not be able to import
OVERRIDES = {
    "vademecum_loader": ("library_dir", "vademecum", "state_dir"),
    "contact": ("tools", "scene", "state_dir"),
    "patient_interpolation": ("library_dir", "atlas"),
    "planning_ui": ("library_dir", "host", "port"),
}
REQUIRED = {"patient_interpolation": "atlas", "planning_ui": "ui"}
ARGUMENTS = {
    "library_dir": "directory of the vademecums",
    "vademecum": "file in library_dir to load",
    "tools": "names of the tools, as left,right",
    "scene": "scene to simulate, of as many tools: name of a shipped one, or a path",
    "atlas": "atlas; empty: no patient_interpolation",
    "state_dir": "directory of saved state; empty: none",
    "ui": "true: also serve the planning page",
    "host": "network address to serve the page on",
    "port": "port of the page",
}
# Arguments that launch itself takes.
OF_LAUNCH = {
    "launch-prefix",
    "launch-prefix-filter",
    "emulate_tty",
    "sigterm_timeout",
    "sigkill_timeout",
}


def generate_launch_description() -> LaunchDescription:
    """Return the launch description: one argument for each option of `avatar cell`."""
    default = PathJoinSubstitution([FindPackageShare("avatar_params"), "planning_cell.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params", default_value=default, description="parameters of all nodes (YAML)"
            ),
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for name, description in ARGUMENTS.items()
            ),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for."""
    refuse_unknown(context.argv)
    values = {n: LaunchConfiguration(n).perform(context) for n in ("params", *ARGUMENTS)}
    given = {name: value for name, value in values.items() if value}
    if given.get("ui", "false").lower() not in ("true", "false"):
        raise ValueError(f"ui is {given['ui']!r}; give true or false")
    if given.get("ui", "").lower() == "false":
        del given["ui"]
    params = Path(given.get("params", "")).expanduser()
    if not params.is_file():  # launch would warn, and start the nodes without it
        raise FileNotFoundError(f"params is {str(params)!r}, which is not a file")
    return [
        Node(
            package="avatar_ros",
            executable=node,
            parameters=[str(params), {n: typed(n, given[n]) for n in names if n in given}],
        )
        for node, names in OVERRIDES.items()
        if REQUIRED.get(node, "params") in given
    ]


def typed(name: str, given: str) -> ParameterValue | list[str]:
    """Return an argument as a parameter; launch itself would take a folder 2024 for a number."""
    if name == "tools":
        return [word.strip() for word in given.split(",")]
    return ParameterValue(LaunchConfiguration(name), value_type=int if name == "port" else str)


def refuse_unknown(words: list[str]) -> None:
    """Raise ValueError for a mistyped argument, which launch ignores.

    Only if the command line names this file: one that includes it may have arguments of its own.
    """
    if not any(Path(word).name.startswith("planning_cell.launch.") for word in sys.argv):
        return
    known = {"params", *ARGUMENTS}
    names = {word.split(":=")[0] for word in words if ":=" in word}
    for name in sorted(names - known - OF_LAUNCH):
        raise ValueError(f"there is no argument {name}; there are {', '.join(sorted(known))}")
