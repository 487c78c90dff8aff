"""The kinds of joint command messages that controllers and drivers take: one class a kind."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, Protocol

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


@dataclass(frozen=True, slots=True)
class JointCommand:
    """What is to be sent: the drive's command, the state it was made for, and the time [s] of the node's clock."""

    command: Command
    state: RobotState
    t: float


class Kind(Protocol):
    """One kind of message. Made with the control loop's period [s] and the robot."""

    topic: ClassVar[str]  # where no other is asked for
    mode: ClassVar[CommandMode]  # of the drive whose commands it carries
    joints_each: ClassVar[int | None]  # that a message has to have; None: any number

    @property
    def message(self) -> type: ...

    def encode(self, command: JointCommand, names: list[str], joints: np.ndarray) -> Any:
        """A message about the joints with these names and velocity indices."""
        ...


class TrajectoryOutput:
    """JointTrajectory with one point, due after a period: what joint_trajectory_controller calls a setpoint."""

    topic: ClassVar[str] = "joint_trajectory"
    mode: ClassVar[CommandMode] = CommandMode.POSITION
    joints_each: ClassVar[int | None] = None
    message = JointTrajectory

    def __init__(self, period: float, robot: Robot) -> None:
        self._due = Duration(sec=int(period), nanosec=int(1e9 * (period % 1.0)))

    def encode(self, command: JointCommand, names: list[str], joints: np.ndarray) -> JointTrajectory:
        """See :class:`Kind`. A stamp of 0 means now, whatever the receiver's clock says."""
        q, v = command.command.q[joints].tolist(), command.command.v[joints].tolist()
        point = JointTrajectoryPoint(positions=q, velocities=v, time_from_start=self._due)
        return JointTrajectory(joint_names=names, points=[point])


class PositionArray:
    """Float64MultiArray of positions in the order of the joints, as forward_command_controller takes them."""

    topic: ClassVar[str] = "position_commands"
    mode: ClassVar[CommandMode] = CommandMode.POSITION
    joints_each: ClassVar[int | None] = None
    message = Float64MultiArray
    field: ClassVar[str] = "q"

    def __init__(self, period: float, robot: Robot) -> None:
        pass

    def encode(self, command: JointCommand, names: list[str], joints: np.ndarray) -> Any:
        """See :class:`Kind`."""
        return Float64MultiArray(data=getattr(command.command, self.field)[joints].tolist())


class VelocityArray(PositionArray):
    """Float64MultiArray of velocities, as a velocity forward_command_controller takes them."""

    topic: ClassVar[str] = "velocity_commands"
    mode: ClassVar[CommandMode] = CommandMode.VELOCITY
    field: ClassVar[str] = "v"


class TorqueArray(PositionArray):
    """Float64MultiArray of torques; gravity and Coriolis are in them."""

    topic: ClassVar[str] = "torque_commands"
    mode: ClassVar[CommandMode] = CommandMode.TORQUE
    field: ClassVar[str] = "tau"


class JointStates(PositionArray):
    """JointState with positions and velocities by name."""

    topic: ClassVar[str] = "joint_commands"
    message = JointState

    def encode(self, command: JointCommand, names: list[str], joints: np.ndarray) -> Any:
        """See :class:`Kind`."""
        q, v = command.command.q[joints], command.command.v[joints]
        return joint_state_message(names, q, v, np.zeros(0), command.t)


class LbrPosition:
    """LBRJointPositionCommand of lbr_fri_idl, one topic an arm."""

    topic: ClassVar[str] = "/{arm}/command/joint_position"
    mode: ClassVar[CommandMode] = CommandMode.POSITION
    joints_each: ClassVar[int | None] = _LBR_JOINTS

    def __init__(self, period: float, robot: Robot) -> None:
        self.message = _lbr_message("LBRJointPositionCommand")

    def encode(self, command: JointCommand, names: list[str], joints: np.ndarray) -> Any:
        """See :class:`Kind`."""
        return self.message(joint_position=command.command.q[joints].tolist())


class LbrTorque:
    """LBRTorqueCommand of lbr_fri_idl: torques without gravity, which the KUKA bears itself.

    Each carries the measured position, since the driver ignores torques beside a position that is NaN.
    """

    topic: ClassVar[str] = "/{arm}/command/torque"
    mode: ClassVar[CommandMode] = CommandMode.TORQUE
    joints_each: ClassVar[int | None] = _LBR_JOINTS

    def __init__(self, period: float, robot: Robot) -> None:
        self.message = _lbr_message("LBRTorqueCommand")
        self._model, self._data = robot.model, robot.model.createData()

    def encode(self, command: JointCommand, names: list[str], joints: np.ndarray) -> Any:
        """See :class:`Kind`."""
        q = command.state.q
        overlay = command.command.tau - pin.computeGeneralizedGravity(self._model, self._data, q)
        return self.message(joint_position=q[joints].tolist(), torque=overlay[joints].tolist())


KINDS: dict[str, Any] = {
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
