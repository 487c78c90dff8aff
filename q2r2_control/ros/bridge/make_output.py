"""Which output a controller has, and on which topics: the parameters ``output``, ``output_topic`` and its arms'."""

from __future__ import annotations

from collections.abc import Callable

from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.config import Config
from q2r2_control.config.timeouts import STREAM_TIMEOUT
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.outputs import (
    Channel,
    NoOutput,
    Output,
    PositionOutput,
    as_array,
    as_joint_state,
    as_trajectory,
    channels,
)
from q2r2_control.ros.bridge.torque_outputs import LbrOutput, TorqueOutput, Torques, lbr_message

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
    what = "arms that do not follow and whose joint positions nobody acknowledges are given up after [s]"
    listener_timeout = node.parameter("listener_timeout", STREAM_TIMEOUT, what, at_least=0.1, at_most=5.0)

    def on(kind: type) -> list[Channel]:
        return channels(node, kind, topics, robot, listener_timeout)

    makers: dict[str, Callable[[], Output]] = {
        "trajectory": lambda: PositionOutput(on(JointTrajectory), as_trajectory(period)),
        "float64": lambda: PositionOutput(on(Float64MultiArray), as_array),
        "joint_state": lambda: PositionOutput(on(JointState), as_joint_state),
        "torque": lambda: TorqueOutput(on(Float64MultiArray), Torques(robot, config.impedance)),
        "lbr_position": lambda: _lbr(on, "LBRJointPositionCommand", None),
        "lbr_torque": lambda: _lbr(on, "LBRTorqueCommand", Torques(robot, config.impedance)),
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


def _lbr(on: Callable[[type], list[Channel]], name: str, torques: Torques | None) -> LbrOutput:
    kind = lbr_message(name)
    return LbrOutput(on(kind), kind, torques)
