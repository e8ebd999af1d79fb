"""The loader and the contact node: `ros2 launch avatar_ros contact.launch.py vademecum:=FILE.h5`.

``library_dir`` and ``vademecum`` override what the YAML file ``params`` says. With
``atlas:=FILE.h5`` also the node that makes patients from it.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import (
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    default = PathJoinSubstitution([FindPackageShare("avatar_ros"), "params", "contact.yaml"])
    params = LaunchConfiguration("params")
    patients = PathJoinSubstitution(
        [FindPackageShare("avatar_ros"), "params", "patient_interpolation.yaml"]
    )
    atlas = LaunchConfiguration("atlas")
    base = {"atlas": atlas, "library_dir": LaunchConfiguration("library_dir")}
    library = {name: LaunchConfiguration(name) for name in ("library_dir", "vademecum")}
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params", default_value=default, description="YAML for both nodes"
            ),
            DeclareLaunchArgument("library_dir", default_value=".", description="vademecums"),
            DeclareLaunchArgument("vademecum", default_value="", description="file to load"),
            DeclareLaunchArgument("atlas", default_value="", description="empty: no patients"),
            Node(package="avatar_ros", executable="vademecum_loader", parameters=[params, library]),
            Node(package="avatar_ros", executable="contact", parameters=[params]),
            Node(
                package="avatar_ros",
                executable="patient_interpolation",
                parameters=[patients, base],
                condition=IfCondition(NotEqualsSubstitution(atlas, "")),
            ),
        ]
    )
