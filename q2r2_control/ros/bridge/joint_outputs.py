"""Send joint commands, on one topic for all arms or one topic for each arm.

The parameter ``output`` selects the drive and the kind of messages.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import lru_cache
from importlib import import_module
from itertools import islice
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pinocchio as pin
from builtin_interfaces.msg import Duration, Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.config.cell import Config
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.drives.base import Drive, make_drive
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.messages import joint_state_message
from q2r2_control.ros.bridge.wire import Template
from q2r2_control.ros.commanders import CommandWatch, takers_of
from q2r2_control.ros.monitoring import WatchedPublisher
from q2r2_control.ros.reasons import RosReason
from q2r2_control.types import Command, CommandMode, RobotState

NONE = "none"


class Kind(ABC):
    """One kind of command message. It is made for the control loop's period [s] and a robot."""

    topic: ClassVar[str]  # The default topic.
    # The last part of the topic's name in older releases of the receiver. Commands are also sent on that topic.
    older: str | None = None
    mode = CommandMode.POSITION  # The mode of the drive whose commands a message of this kind contains.
    joints_each: int | None = None  # The number of joints that a message must have; None for any number.
    message: Any  # The type of the messages.

    def __init__(self, period: float, robot: Robot) -> None:
        self._due, self._model = Duration(sec=int(period), nanosec=int(1e9 * (period % 1.0))), robot.model

    @abstractmethod
    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        """Return a message, possibly serialized, about the joints with these names and velocity indices.

        ``t`` is the time of the node's clock [s].
        """


class TrajectoryOutput(Kind):
    """A JointTrajectory with one point that is due after a period, as a setpoint for joint_trajectory_controller."""

    topic = "joint_trajectory"
    message = JointTrajectory

    def __init__(self, period: float, robot: Robot) -> None:
        super().__init__(period, robot)
        self._template = lru_cache(maxsize=8)(self._make)

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> bytes:
        numbers = [*command.q[joints].tolist(), *command.v[joints].tolist()]
        # Stamp 0 means "now", whichever clock the receiver uses.
        return self._template(tuple(names)).fill(numbers, 0.0)

    def _make(self, names: tuple[str, ...]) -> Template:
        def make(numbers: Iterator[float], stamp: Any) -> JointTrajectory:
            q, v = (list(islice(numbers, len(names))) for _ in range(2))
            point = JointTrajectoryPoint(positions=q, velocities=v, time_from_start=self._due)
            message = JointTrajectory(joint_names=list(names), points=[point])
            message.header.stamp = stamp
            return message

        return Template(make, Time())


class PositionArray(Kind):
    """A Float64MultiArray in the order of the joints, for forward_command_controller."""

    topic = "position_commands"
    message = Float64MultiArray
    field: ClassVar[str] = "q"

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        return Float64MultiArray(data=getattr(command, self.field)[joints].tolist())


class VelocityArray(PositionArray):
    topic, mode, field = "velocity_commands", CommandMode.VELOCITY, "v"


class TorqueArray(PositionArray):
    topic, mode, field = "torque_commands", CommandMode.TORQUE, "tau"  # Torques contain gravity and Coriolis.


class JointStates(Kind):
    """A JointState with positions and velocities by name."""

    topic = "joint_commands"
    message = JointState

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        return joint_state_message(names, command.q[joints], command.v[joints], np.zeros(0), t)


class LbrPosition(Kind):
    """An LBRJointPositionCommand of lbr_fri_idl, on one topic for each arm."""

    topic, joints_each, older = "{arm}/command/lbr_joint_position_command", 7, "joint_position"
    type_name = "LBRJointPositionCommand"

    def __init__(self, period: float, robot: Robot) -> None:
        super().__init__(period, robot)
        self.message = _lbr_message(self.type_name)

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        return self.message(joint_position=command.q[joints].tolist())


class LbrTorque(LbrPosition):
    """An LBRTorqueCommand of lbr_fri_idl. Its torques contain no gravity, which KUKA's cabinet compensates itself.

    Each message contains the measured position, because the driver ignores torques with a position of NaN.
    """

    topic, mode, older = "/{arm}/command/lbr_torque_command", CommandMode.TORQUE, "torque"
    type_name = "LBRTorqueCommand"

    def __init__(self, period: float, robot: Robot) -> None:
        super().__init__(period, robot)
        self._data = robot.model.createData()

    def encode(self, command: Command, state: RobotState, t: float, names: list[str], joints: np.ndarray) -> Any:
        overlay = command.tau - pin.computeGeneralizedGravity(self._model, self._data, state.q)
        return self.message(joint_position=state.q[joints].tolist(), torque=overlay[joints].tolist())


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
    try:
        return getattr(import_module("lbr_fri_idl.msg"), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"output: lbr_fri_idl cannot be imported ({error}); source a workspace with lbr_fri_ros2_stack, "
            "or use trajectory, float64, joint_state, velocity, torque"
        ) from error


class Channel(NamedTuple):
    """One topic and the joints that its messages are about."""

    names: list[str]
    joints: np.ndarray  # Velocity indices in the robot's order.
    publisher: WatchedPublisher
    optional: bool = False  # True if messages are sent only while somebody listens.

    @property
    def namespace(self) -> str | None:
        """The namespace of a driver whose topic is <namespace>/command/<topic>, or None for another topic."""
        namespace, command, _ = self.publisher.topic_name.rpartition("/command/")
        return namespace if command else None


class JointOutput:
    """Sends references to the arms. Without channels (``output: none``), another controller moves the arms."""

    def __init__(self, drive: Drive, kind: Kind, channels: list[Channel]) -> None:
        self.drive, self._kind, self._channels, self._listeners = drive, kind, channels, 0
        self.theirs: Mapping[str, str] = {}  # By our name of a joint, the receiver's different name.
        self.withheld: Collection[str] = ()  # Namespaces of drivers that get no commands.

    def watch(self, node: BaseNode) -> CommandWatch:
        return CommandWatch(node, self._kind.message, [channel.publisher for channel in self._channels])

    def takers(self, node: BaseNode, joints: np.ndarray) -> str:
        """Return the receivers of commands for joints with these velocity indices: " /node", or "" if not known."""
        topics = [one.publisher.topic_name for one in self._channels if np.isin(joints, one.joints).all()]
        names = (takers_of(node, topic) for topic in topics)
        return next((f" {name}" for name in names if name), "")

    def send(self, command: Command, state: RobotState, t: float, decided: float) -> None:
        """Send a command of the tick at ``t`` [s] by the node's clock. See :func:`publish_in_time` for ``decided``."""
        for channel in self._channels:
            if channel.namespace in self.withheld or (channel.optional and not channel.publisher.listeners):
                continue
            names = [self.theirs.get(name, name) for name in channel.names]
            message = self._kind.encode(command, state, t, names, channel.joints)
            channel.publisher.publish(message, decided)

    @property
    def sent(self) -> dict[str, int]:
        return {channel.publisher.topic_name: channel.publisher.sent for channel in self._channels}

    def end(self, state: RobotState, t: float) -> None:
        """Send a last command that holds the arms, for drives that need one."""
        command = self.drive.last_command(state, {})
        if command is not None and command.mode is self.drive.mode:
            self.send(command, state, t, time.monotonic())

    def driver_namespaces(self, robot: Robot) -> dict[str, str]:
        """Return by arm, for outputs ``lbr_*``, the namespace in which its driver reports the session; otherwise {}.

        Raises :class:`ConfigError` if a command topic does not tell the namespace.
        """
        found: dict[str, str] = {}
        for arm, its in robot.arms.items() if self._kind.older is not None else ():
            channel = next(one for one in self._channels if np.isin(its.joints, one.joints).all())
            if (namespace := channel.namespace) is None or namespace in found.values():
                raise ConfigError(
                    f"{arm}.output_topic = {channel.publisher.topic_name!r:.80}: allowed: <namespace>/command/<name>, "
                    "with a namespace for each arm, where its driver publishes LBRState"
                )
            found[arm] = namespace
        return found

    def waits(self) -> bool:
        """Return whether nothing should be sent in this tick, so that the last command can be acknowledged.

        The reference must not move during this time, because the arms would jump afterwards.
        """
        # ``waits`` is called for every publisher, even after one has returned True, because each publisher times its
        # own pause in sending.
        return True in [channel.publisher.waits() for channel in self._channels]

    def listener_fault(self, off_reference: bool) -> Reason | None:
        """Return a reason if the receiver of the commands has gone, or if there is a new one; else None.

        It is called before each command. Receivers are checked only while the arms are ``off_reference``, because for
        these checks a message sometimes has to be left out. Receivers of torques are not checked: compliant arms are
        off their reference by design, and a torque for the measured posture causes no jump.
        """
        publishers = [channel.publisher for channel in self._channels]
        before, self._listeners = self._listeners, sum(publisher.listeners for publisher in publishers)
        if self.drive.yields or not off_reference:
            for publisher in publishers:
                publisher.begin(acknowledged=True)
            return None
        if self._listeners > before:
            return Reason(RosReason.NEW_RECEIVER)
        return next((silence for publisher in publishers if (silence := publisher.silence())), None)


def joints_of(robot: Robot, arms: Iterable[str]) -> np.ndarray:
    """Return the velocity indices of the joints that move any of ``arms``, in the robot's order."""
    return np.unique(np.concatenate([robot.arms[arm].joints for arm in arms]))


def make_output(name: str, node: BaseNode, robot: Robot, config: Config, period: float) -> JointOutput:
    """Make the output ``name`` on the topics of its parameters; raises :class:`ConfigError`.

    ``period`` is the period of the loop [s].
    """
    what = "arms that do not follow and whose joint positions nobody acknowledges are given up after [s]"
    timeout = node.parameter("listener_timeout", STREAM_TIMEOUT, what, within=(0.1, 5.0))
    topics = _topics(name, node, robot)
    if name == NONE:
        return JointOutput(make_drive(CommandMode.POSITION, robot, config), KINDS["trajectory"](period, robot), [])
    kind = KINDS[name](period, robot)
    drive = make_drive(kind.mode, robot, config, has_servos=False)
    channels = []
    for topic in dict.fromkeys(topics.values()):
        joints = joints_of(robot, (arm for arm, its in topics.items() if its == topic))
        names = [robot.joint_names[joint] for joint in joints]
        if kind.joints_each is not None and len(names) != kind.joints_each:
            raise ConfigError(
                f"output: {topic} carries {len(names)} joints; {name} has {kind.joints_each} a message, and each arm "
                "needs a topic of its own"
            )
        channels.append(Channel(names, joints, WatchedPublisher(node, kind.message, topic, timeout)))
        parent, _, last = topic.rpartition("/")
        if kind.older is not None and last == kind.topic.rpartition("/")[2]:
            older = WatchedPublisher(node, kind.message, f"{parent}/{kind.older}", timeout)
            channels.append(Channel(names, joints, older, optional=True))
    return JointOutput(drive, kind, channels)


def _topics(name: str, node: BaseNode, robot: Robot) -> dict[str, str]:
    """Return the topic for the joint commands of each arm. Arms with the same topic share its messages."""
    what = "joint commands of all arms, {arm} stands for an arm's name; \"\": the output's usual one"
    shared = node.parameter("output_topic", "", what) or ("" if name == NONE else KINDS[name].topic)
    topics: dict[str, str] = {}
    for arm in robot.arms:
        its = node.parameter(f"{arm}.output_topic", "", 'joint commands of this arm alone; "": output_topic')
        topics[arm] = (its or shared).replace("{arm}", arm)
    return topics
