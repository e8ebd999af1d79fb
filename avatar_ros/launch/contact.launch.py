"""The loader and the contact node: `ros2 launch avatar_ros contact.launch.py params:=FILE`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    default = PathJoinSubstitution([FindPackageShare("avatar_ros"), "params", "contact.yaml"])
    params = LaunchConfiguration("params")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params", default_value=default, description="YAML for both nodes"
            ),
            Node(package="avatar_ros", executable="vademecum_loader", parameters=[params]),
            Node(package="avatar_ros", executable="contact", parameters=[params]),
        ]
    )
