"""The kinds of joint command messages that controllers and drivers take: one class a kind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin
from builtin_interfaces.msg import Duration
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.bridge.messages import joint_state_message
from q2r2_control.types import Command, CommandMode, RobotState

NONE = "none"
_LBR_JOINTS = 7


class Kind(ABC):
    """One kind of message. Made with the control loop's period [s] and the robot."""

    topic: ClassVar[str]  # where no other is asked for
    mode = CommandMode.POSITION  # of the drive whose commands it carries
    joints_each: int | None = None  # that a message has to have; None: any number
    message: type  # of ROS

    def __init__(self, period: float, robot: Robot) -> None:
        self._due = Duration(sec=int(period), nanosec=int(1e9 * (period % 1.0)))
        self._model = robot.model

    @abstractmethod
    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        """A message about the joints with these names and velocity indices.

        ``command`` was made for ``state`` at ``t`` [s] of the node's clock.
        """


class TrajectoryOutput(Kind):
    """JointTrajectory with one point, due after a period: what joint_trajectory_controller calls a setpoint."""

    topic = "joint_trajectory"
    message = JointTrajectory

    def encode(
        self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray
    ) -> JointTrajectory:
        """See :class:`Kind`. A stamp of 0 means now, whatever the receiver's clock says."""
        q, v = command.q[joints].tolist(), command.v[joints].tolist()
        point = JointTrajectoryPoint(positions=q, velocities=v, time_from_start=self._due)
        return JointTrajectory(joint_names=names, points=[point])


class PositionArray(Kind):
    """Float64MultiArray of positions in the order of the joints, as forward_command_controller takes them."""

    topic = "position_commands"
    message = Float64MultiArray
    field: ClassVar[str] = "q"

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        """See :class:`Kind`."""
        return Float64MultiArray(data=getattr(command, self.field)[joints].tolist())


class VelocityArray(PositionArray):
    """Float64MultiArray of velocities, as a velocity forward_command_controller takes them."""

    topic, mode, field = "velocity_commands", CommandMode.VELOCITY, "v"


class TorqueArray(PositionArray):
    """Float64MultiArray of torques; gravity and Coriolis are in them."""

    topic, mode, field = "torque_commands", CommandMode.TORQUE, "tau"


class JointStates(Kind):
    """JointState with positions and velocities by name."""

    topic = "joint_commands"
    message = JointState

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        """See :class:`Kind`."""
        q, v = command.q[joints], command.v[joints]
        return joint_state_message(names, q, v, np.zeros(0), t)


class LbrPosition(Kind):
    """LBRJointPositionCommand of lbr_fri_idl, one topic an arm."""

    topic, joints_each = "/{arm}/command/joint_position", _LBR_JOINTS

    def __init__(self, period: float, robot: Robot) -> None:
        super().__init__(period, robot)
        self.message = _lbr_message("LBRJointPositionCommand")

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        """See :class:`Kind`."""
        return self.message(joint_position=command.q[joints].tolist())


class LbrTorque(Kind):
    """LBRTorqueCommand of lbr_fri_idl: torques without gravity, which the KUKA bears itself.

    Each carries the measured position, since the driver ignores torques beside a position that is NaN.
    """

    topic, mode, joints_each = "/{arm}/command/torque", CommandMode.TORQUE, _LBR_JOINTS

    def __init__(self, period: float, robot: Robot) -> None:
        super().__init__(period, robot)
        self.message = _lbr_message("LBRTorqueCommand")
        self._data = robot.model.createData()

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        """See :class:`Kind`."""
        q = state.q
        overlay = command.tau - pin.computeGeneralizedGravity(self._model, self._data, q)
        return self.message(joint_position=q[joints].tolist(), torque=overlay[joints].tolist())


KINDS: dict[str, type[Kind]] = {
    "trajectory": TrajectoryOutput,
    "float64": PositionArray,
    "joint_state": JointStates,
    "velocity": VelocityArray,
    "torque": TorqueArray,
    "lbr_position": LbrPosition,
    "lbr_torque": LbrTorque,
}


def _lbr_message(name: str) -> Any:
    """A message type of lbr_fri_idl. Raises :class:`ConfigError` where that package is not to be had."""
    try:
        return getattr(import_module("lbr_fri_idl.msg"), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"output: lbr_fri_idl cannot be imported ({error}); source a workspace with lbr_fri_ros2_stack, "
            "or use trajectory, float64, joint_state, velocity, torque"
        ) from error
