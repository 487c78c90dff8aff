"""What q2r2 ros up starts, for ROS: ``ros2 launch q2r2_control teleop.launch.py config:=... input:=...``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node

# Executable, and the input that it is for; None: any.
NODES = (
    ("mujoco_robot", None),
    ("cartesian_controller", None),
    ("left_arm_controller", None),
    ("right_arm_controller", None),
    ("SimulationInput", "scripted"),
    ("tcp_endpoint", "headset"),
)


def generate_launch_description() -> LaunchDescription:
    """All nodes; when one ends all end, and none is started again."""
    arguments = [
        DeclareLaunchArgument("config", default_value="config/dual_iiwa7.yaml", description="YAML of the cell"),
        DeclareLaunchArgument("input", default_value="scripted", choices=["scripted", "headset", "none"]),
    ]
    nodes = [
        Node(
            package="q2r2_control",
            executable=executable,
            output="screen",
            parameters=[{"config": LaunchConfiguration("config")}],
            condition=None if source is None else IfCondition(EqualsSubstitution(LaunchConfiguration("input"), source)),
            on_exit=Shutdown(reason=f"{executable} ended"),
        )
        for executable, source in NODES
    ]
    return LaunchDescription([*arguments, *nodes])
