"""Start the nodes of ``q2r2 ros up`` by ROS's own command.

    ros2 launch q2r2_control teleop.launch.py config:=... input:=... robot:=...

With ``record:=FOLDER``, the run is recorded.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from q2r2_control.ros.launch.processes import ROBOTS, nodes_of


def generate_launch_description():
    """Return the description of all nodes. If one node ends, all nodes end, and no node is started again."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value="config/dual_iiwa7.yaml", description="YAML of the cell"),
            DeclareLaunchArgument("input", default_value="scripted", description="an installed input, or none"),
            DeclareLaunchArgument(
                "robot", default_value="auto", choices=list(ROBOTS), description="auto: mujoco for controller: builtin"
            ),
            DeclareLaunchArgument("record", default_value="", description="folder for a recording; empty: none"),
            DeclareLaunchArgument(
                "separate", default_value="false", choices=["true", "false"], description="each arm a process"
            ),
            DeclareLaunchArgument("namespace", default_value="", description="of all nodes, such as /cell"),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", choices=["true", "false"], description="the time is on /clock"
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context):
    given = [LaunchConfiguration(name).perform(context) for name in ("config", "input", "robot")]
    folder = LaunchConfiguration("record").perform(context)
    recording = {"folder": folder} if folder else None
    separate = LaunchConfiguration("separate").perform(context) == "true"
    namespace = LaunchConfiguration("namespace").perform(context)
    sim_time = LaunchConfiguration("use_sim_time").perform(context) == "true"
    return [
        Node(
            package="q2r2_control",
            executable=node.name,
            namespace=namespace,
            output="screen",
            # Each value has a type. Otherwise, launch would read a text that looks like a number as a number.
            parameters=[
                {key: ParameterValue(value, value_type=type(value)) for key, value in node.parameters.items()},
                {"use_sim_time": sim_time},
            ],
            on_exit=Shutdown(reason=f"{node.name} ended"),
        )
        for node in nodes_of(*given, recording, separate)
    ]
