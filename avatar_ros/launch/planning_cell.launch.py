"""A planning cell: `ros2 launch avatar_ros planning_cell.launch.py params:=FILE.yaml`.

The file ``params`` holds the parameters of all nodes; the arguments ``library_dir``,
``vademecum``, ``scene``, ``atlas`` and ``state_dir`` override those of the same name. The node
patient_interpolation runs only if there is an atlas.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

OVERRIDES = {
    "vademecum_loader": ("library_dir", "vademecum", "state_dir"),
    "contact": ("scene", "state_dir"),
    "patient_interpolation": ("library_dir", "atlas"),
}


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("avatar_ros")
    default = PathJoinSubstitution([share, "params", "planning_cell.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params", default_value=default, description="parameters of all nodes"
            ),
            DeclareLaunchArgument(
                "library_dir", default_value="", description="directory of the vademecums"
            ),
            DeclareLaunchArgument("vademecum", default_value="", description="vademecum to load"),
            DeclareLaunchArgument("scene", default_value="", description="scene to simulate"),
            DeclareLaunchArgument(
                "atlas", default_value="", description="atlas; empty: no patient_interpolation"
            ),
            DeclareLaunchArgument(
                "state_dir", default_value="", description="directory of saved state; empty: none"
            ),
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
        for node, names in OVERRIDES.items()
        if node != "patient_interpolation" or given("atlas")
    ]
