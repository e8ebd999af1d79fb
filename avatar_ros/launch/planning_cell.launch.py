"""A planning cell: `ros2 launch avatar_ros planning_cell.launch.py params:=FILE.yaml`.

All that the nodes are told stands in ``params``; ``library_dir``, ``vademecum``, ``scene``,
``atlas`` and ``state_dir`` go before what it says of them. The node that makes patients runs with
an atlas only.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TAKES = {
    "vademecum_loader": ("library_dir", "vademecum", "state_dir"),
    "contact": ("scene", "state_dir"),
    "patient_interpolation": ("library_dir", "atlas"),
}


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("avatar_ros")
    default = PathJoinSubstitution([share, "params", "planning_cell.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=default, description="of all nodes"),
            DeclareLaunchArgument("library_dir", default_value="", description="of vademecums"),
            DeclareLaunchArgument("vademecum", default_value="", description="file to load"),
            DeclareLaunchArgument("scene", default_value="", description="effects to simulate"),
            DeclareLaunchArgument("atlas", default_value="", description="empty: no patients"),
            DeclareLaunchArgument("state_dir", default_value="", description="empty: none is kept"),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context: LaunchContext) -> list[Node]:
    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    return [
        Node(
            package="avatar_ros",
            executable=node,
            parameters=[given("params"), {name: given(name) for name in names if given(name)}],
        )
        for node, names in TAKES.items()
        if node != "patient_interpolation" or given("atlas")
    ]
