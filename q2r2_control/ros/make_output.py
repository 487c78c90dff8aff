"""Which output a controller has, and on which topics: the parameters ``output``, ``output_topic`` and its arms'."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.config import Config
from q2r2_control.control.settings import ImpedanceSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.node import BaseNode
from q2r2_control.ros.outputs import (
    NoOutput,
    Output,
    PositionOutput,
    as_array,
    as_joint_state,
    as_trajectory,
    channels,
)
from q2r2_control.ros.torque_outputs import LbrOutput, TorqueOutput, Torques, lbr_message

NONE = "none"
_ARM = "{arm}"  # where an arm's name goes in a topic
# The topic that each output has where no other is asked for.
_USUAL = {
    "trajectory": "joint_trajectory",
    "float64": "position_commands",
    "joint_state": "joint_commands",
    "torque": "torque_commands",
    "lbr_position": f"/{_ARM}/command/joint_position",
    "lbr_torque": f"/{_ARM}/command/torque",
    NONE: "",
}


def output_name(node: BaseNode) -> str:
    """Declare the parameter ``output`` and return it."""
    name: str = node.parameter("output", "trajectory", "what the arms are commanded with", one_of=tuple(_USUAL))
    return name


def make_output(name: str, node: BaseNode, robot: Robot, config: Config, period: float) -> Output:
    """The output called ``name`` on the topics that the parameters ask for; ``period`` [s] of the control loop.

    Raises :class:`ConfigError`.
    """
    topics = _topics(name, node, robot)
    makers: dict[str, Callable[[], Output]] = {
        "trajectory": lambda: PositionOutput(channels(node, JointTrajectory, topics, robot), as_trajectory(period)),
        "float64": lambda: PositionOutput(channels(node, Float64MultiArray, topics, robot), as_array),
        "joint_state": lambda: PositionOutput(channels(node, JointState, topics, robot), as_joint_state),
        "torque": lambda: TorqueOutput(
            channels(node, Float64MultiArray, topics, robot), Torques(robot, config.impedance)
        ),
        "lbr_position": lambda: _lbr(node, topics, robot, None),
        "lbr_torque": lambda: _lbr(node, topics, robot, config.impedance),
        NONE: NoOutput,
    }
    return makers[name]()


def _topics(name: str, node: BaseNode, robot: Robot) -> dict[str, str]:
    """The topic that carries each arm's joints; arms with the same one share its messages."""
    what = f"joint commands of all arms, {_ARM} stands for an arm's name; \"\": the output's usual one"
    shared = node.parameter("output_topic", "", what) or _USUAL[name]
    topics: dict[str, str] = {}
    for arm in robot.arms:
        its = node.parameter(f"{arm}.output_topic", "", 'joint commands of this arm alone; "": output_topic')
        topics[arm] = (its or shared).replace(_ARM, arm)
    return topics


def _lbr(node: BaseNode, topics: Mapping[str, str], robot: Robot, impedance: ImpedanceSettings | None) -> LbrOutput:
    message = lbr_message("LBRJointPositionCommand" if impedance is None else "LBRTorqueCommand")
    torques = None if impedance is None else Torques(robot, impedance)
    return LbrOutput(channels(node, message, topics, robot), message, torques)
