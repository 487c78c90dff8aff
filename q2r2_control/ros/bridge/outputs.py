"""Output adapters: a reference as the messages of one kind of joint controller, on one topic or one an arm."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from builtin_interfaces.msg import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.robot.robot import Robot
from q2r2_control.ros.bridge.messages import joint_state_message
from q2r2_control.ros.monitoring.endpoints import WatchedPublisher
from q2r2_control.types import Array, Reference, RobotState

# What makes a message of joint names, positions, velocities and the time [s] of the node's clock.
Encode = Callable[[list[str], Array, Array, float], Any]


class Output(Protocol):
    """Where references go."""

    def activate(self, state: RobotState) -> None:
        """Begin anew at a measured state."""
        ...

    def send(self, reference: Reference, state: RobotState, dt: float, t: float, trusted: bool) -> None:
        """Command the reference that is due ``dt`` [s] from now, at ``t`` [s] of the node's clock.

        ``trusted`` is False where ``state`` is out of date, and for the last command before there are no more: what
        pushes according to the state must not push then.
        """
        ...

    def doubt(self, astray: bool) -> str | None:
        """One line where who took the commands is gone, or is not alone any more; to be asked before each is sent.

        Only doubted where the arms are ``astray`` from the reference: looking costs a message now and then.
        """
        ...


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic and the joints that its messages are about."""

    names: list[str]
    joints: np.ndarray  # velocity indices in the robot's order
    publisher: WatchedPublisher

    def send(self, message: Any) -> None:
        """Publish a message, or leave it out while the last one's acknowledgement is waited for."""
        if not self.publisher.waits():
            self.publisher.publish(message)


def channels(node: Node, kind: type, topics: Mapping[str, str], robot: Robot, listener_timeout: float) -> list[Channel]:
    """A publisher for every topic; ``topics`` says for each arm which one carries its joints."""
    made = []
    for topic in dict.fromkeys(topics.values()):
        joints = joints_of(robot, (arm for arm, its in topics.items() if its == topic))
        names = [robot.joint_names[joint] for joint in joints]
        made.append(Channel(names, joints, WatchedPublisher(node, kind, topic, listener_timeout)))
    return made


def joints_of(robot: Robot, arms: Iterable[str]) -> np.ndarray:
    """Velocity indices of the joints that move some of ``arms``, in the robot's order."""
    return np.unique(np.concatenate([robot.arms[arm].joints for arm in arms]))


class NoOutput:
    """Nothing: another controller moves the arms, after the safe targets."""

    def activate(self, state: RobotState) -> None:
        """Nothing to begin."""

    def send(self, reference: Reference, state: RobotState, dt: float, t: float, trusted: bool) -> None:
        """See :class:`Output`."""

    def doubt(self, astray: bool) -> str | None:
        """See :class:`Output`."""
        return None


class ChannelOutput:
    """What is sent on topics. With ``doubts`` it is found out whether anybody takes it."""

    def __init__(self, into: list[Channel], doubts: bool) -> None:
        self._channels, self._doubts = into, doubts
        self._listeners = 0

    def activate(self, state: RobotState) -> None:
        """Nothing to begin."""

    def doubt(self, astray: bool) -> str | None:
        """See :class:`Output`."""
        publishers = [channel.publisher for channel in self._channels]
        before, self._listeners = self._listeners, sum(publisher.listeners for publisher in publishers)
        if not (self._doubts and astray):
            for publisher in publishers:
                publisher.begin(acknowledged=True)
            return None
        if self._listeners > before:
            return "somebody new takes the commands, and the arms are not where these are"
        return next((line for publisher in publishers if (line := publisher.silence())), None)


class PositionOutput(ChannelOutput):
    """The reference's positions and velocities; what was measured does not matter."""

    def __init__(self, into: list[Channel], encode: Encode) -> None:
        super().__init__(into, doubts=True)
        self._encode = encode

    def send(self, reference: Reference, state: RobotState, dt: float, t: float, trusted: bool) -> None:
        """See :class:`Output`."""
        for channel in self._channels:
            message = self._encode(channel.names, reference.q[channel.joints], reference.v[channel.joints], t)
            channel.send(message)


def as_trajectory(horizon: float) -> Encode:
    """JointTrajectory with one point, due after ``horizon`` [s]: what joint_trajectory_controller calls a setpoint."""
    due = Duration(sec=int(horizon), nanosec=int(1e9 * (horizon % 1.0)))

    def encode(names: list[str], q: Array, v: Array, t: float) -> JointTrajectory:
        point = JointTrajectoryPoint(positions=q.tolist(), velocities=v.tolist(), time_from_start=due)
        # A stamp of 0 means now, whatever the receiver's clock says.
        return JointTrajectory(joint_names=names, points=[point])

    return encode


def as_array(names: list[str], q: Array, v: Array, t: float) -> Float64MultiArray:
    """Positions in the order of the joints, as forward_command_controller takes them."""
    return Float64MultiArray(data=q.tolist())


def as_joint_state(names: list[str], q: Array, v: Array, t: float) -> JointState:
    """Positions and velocities by name."""
    return joint_state_message(names, q, v, np.zeros(0), t)
