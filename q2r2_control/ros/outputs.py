"""Output adapters: a reference as the messages of one kind of joint controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, Protocol

import numpy as np
import pinocchio as pin
from builtin_interfaces.msg import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.config import Config
from q2r2_control.control.impedance import ImpedanceController
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.messages import joint_state_message
from q2r2_control.ros.node import COMMAND_QOS
from q2r2_control.types import Reference, RobotState

LBR_JOINTS = 7


class Output(Protocol):
    """Where references go."""

    def activate(self, state: RobotState) -> None:
        """Begin anew at a measured state."""
        ...

    def send(self, reference: Reference, state: RobotState, dt: float, t: float) -> None:
        """Command the reference that is due ``dt`` [s] from now, at ``t`` [s] of the node's clock."""
        ...


class _PositionOutput:
    """What only needs the reference, not the measured state."""

    def __init__(self, node: Node, kind: Any, topic: str, names: Sequence[str]) -> None:
        self._names = list(names)
        self._publisher = node.create_publisher(kind, topic, COMMAND_QOS)

    def activate(self, state: RobotState) -> None:
        """Nothing to begin."""


class TrajectoryOutput(_PositionOutput):
    """JointTrajectory with one point, due after ``horizon`` [s]: what joint_trajectory_controller calls a setpoint."""

    def __init__(self, node: Node, topic: str, names: Sequence[str], horizon: float) -> None:
        super().__init__(node, JointTrajectory, topic, names)
        self._time = Duration(sec=int(horizon), nanosec=int(1e9 * (horizon % 1.0)))

    def send(self, reference: Reference, state: RobotState, dt: float, t: float) -> None:
        """See :class:`Output`."""
        point = JointTrajectoryPoint(
            positions=reference.q.tolist(), velocities=reference.v.tolist(), time_from_start=self._time
        )
        # A stamp of 0 means now, whatever the receiver's clock says.
        self._publisher.publish(JointTrajectory(joint_names=self._names, points=[point]))


class ArrayOutput(_PositionOutput):
    """Float64MultiArray of positions in the order of the joints, as forward_command_controller takes it."""

    def __init__(self, node: Node, topic: str, names: Sequence[str]) -> None:
        super().__init__(node, Float64MultiArray, topic, names)

    def send(self, reference: Reference, state: RobotState, dt: float, t: float) -> None:
        """See :class:`Output`."""
        self._publisher.publish(Float64MultiArray(data=reference.q.tolist()))


class JointStateOutput(_PositionOutput):
    """JointState with positions and velocities by name."""

    def __init__(self, node: Node, topic: str, names: Sequence[str]) -> None:
        super().__init__(node, JointState, topic, names)

    def send(self, reference: Reference, state: RobotState, dt: float, t: float) -> None:
        """See :class:`Output`."""
        self._publisher.publish(joint_state_message(self._names, reference.q, reference.v, np.zeros(0), t))


class LbrOutput:
    """lbr_fri_idl positions or torques, one topic an arm.

    Torques are those of the cell's impedance about the reference, without gravity, which the KUKA bears itself; each
    carries the measured position, since the driver ignores torques beside a position that is NaN.
    """

    def __init__(
        self, node: Node, topics: Mapping[str, str], robot: Robot, impedance: ImpedanceController | None
    ) -> None:
        try:
            messages = import_module("lbr_fri_idl.msg")
        except ImportError as error:
            raise ConfigError(
                f"output: lbr_fri_idl cannot be imported ({error}); source a workspace with lbr_fri_ros2_stack, "
                "or use trajectory, float64, joint_state"
            ) from error
        self._kind = messages.LBRJointPositionCommand if impedance is None else messages.LBRTorqueCommand
        self._robot, self._impedance = robot, impedance
        for name, arm in robot.arms.items():
            if len(arm.joints) != LBR_JOINTS:
                raise ConfigError(f"output: arm {name} has {len(arm.joints)} joints; an LBR has {LBR_JOINTS}")
        self._publishers = {arm: node.create_publisher(self._kind, topics[arm], COMMAND_QOS) for arm in robot.arms}
        self._data = robot.model.createData()

    def activate(self, state: RobotState) -> None:
        """See :class:`Output`."""
        if self._impedance is not None:
            self._impedance.reset(state)

    def send(self, reference: Reference, state: RobotState, dt: float, t: float) -> None:
        """See :class:`Output`."""
        torque = None if self._impedance is None else self._overlay(self._impedance, reference, state, dt)
        for name, publisher in self._publishers.items():
            joints = self._robot.arms[name].joints
            if torque is None:
                publisher.publish(self._kind(joint_position=reference.q[joints].tolist()))
            else:
                publisher.publish(self._kind(joint_position=state.q[joints].tolist(), torque=torque[joints].tolist()))

    def _overlay(
        self, impedance: ImpedanceController, reference: Reference, state: RobotState, dt: float
    ) -> np.ndarray:
        gravity = pin.computeGeneralizedGravity(self._robot.model, self._data, state.q)
        return np.asarray(impedance.step(reference, state, dt).tau - gravity)


def make_output(
    name: str, topic: str, node: Node, robot: Robot, config: Config, period: float, lbr_topics: Mapping[str, str]
) -> Output:
    """The adapter called ``name``; ``topic`` is empty for its usual one. Raises :class:`ConfigError`."""
    names = robot.joint_names
    makers: dict[str, Callable[[], Output]] = {
        "trajectory": lambda: TrajectoryOutput(node, topic or "joint_trajectory", names, period),
        "float64": lambda: ArrayOutput(node, topic or "position_commands", names),
        "joint_state": lambda: JointStateOutput(node, topic or "joint_commands", names),
        "lbr_position": lambda: LbrOutput(node, lbr_topics, robot, None),
        "lbr_torque": lambda: LbrOutput(node, lbr_topics, robot, ImpedanceController(robot, config.impedance)),
    }
    if name not in makers:
        raise ConfigError(f"output = {name!r:.40}: allowed: {', '.join(makers)}")
    return makers[name]()
