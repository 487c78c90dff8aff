"""Joint commands out, on one topic or one an arm; the parameter ``output`` chooses the drive and its messages."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.config.timeouts import STREAM_TIMEOUT
from q2r2_control.drives.base import Drive
from q2r2_control.drives.factory import make_drive
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.joint_messages import KINDS, NONE, Kind
from q2r2_control.ros.monitoring.command_watch import CommandWatch
from q2r2_control.ros.monitoring.endpoints import WatchedPublisher
from q2r2_control.types import Command, CommandMode, RobotState

_ARM = "{arm}"  # where an arm's name goes in a topic


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic and the joints that its messages are about."""

    names: list[str]
    joints: np.ndarray  # velocity indices in the robot's order
    publisher: WatchedPublisher


class JointOutput:
    """Where references go. Without channels, ``output: none``, another controller moves the arms."""

    def __init__(self, drive: Drive, kind: Kind, channels: list[Channel]) -> None:
        self.drive = drive
        self._kind, self._channels = kind, channels
        self._listeners = 0

    def watch(self, node: BaseNode) -> CommandWatch:
        """What tells whether another node sends such commands."""
        return CommandWatch(node, self._kind.message, [channel.publisher.topic_name for channel in self._channels])

    def send(self, command: Command, state: RobotState, t: float, decided: float) -> None:
        """Send a command of the tick at ``t`` [s] of the node's clock; ``decided``: see :func:`publish_in_time`."""
        for channel in self._channels:
            message = self._kind.encode(command, state, t, channel.names, channel.joints)
            channel.publisher.publish(message, decided)

    @property
    def sent(self) -> dict[str, int]:
        """How many messages went out on each topic."""
        return {channel.publisher.topic_name: channel.publisher.sent for channel in self._channels}

    def end(self, state: RobotState, t: float) -> None:
        """What holds the arms where no more commands come, for drives that need it."""
        command = self.drive.last_command(state, {})
        if command is not None and command.mode is self.drive.mode:
            self.send(command, state, t, time.monotonic())

    def waits(self) -> bool:
        """Whether nothing should be sent now, so that the last command can be acknowledged; to be asked once a tick.

        The reference must not go on meanwhile: it would leave as one jump afterwards.
        """
        waiting = [channel.publisher.waits() for channel in self._channels]  # asked all: each has a gap of its own
        return True in waiting

    def listener_fault(self, off_reference: bool) -> str | None:
        """One line where what took the commands is gone, or is not alone any more; to be asked before each is sent.

        Asked only where the arms are ``off_reference``, since looking costs a message now and then, and not of torques:
        arms that yield are off their reference by design, and a torque for where they are is no jump.
        """
        publishers = [channel.publisher for channel in self._channels]
        before, self._listeners = self._listeners, sum(publisher.listeners for publisher in publishers)
        if self.drive.yields or not off_reference:
            for publisher in publishers:
                publisher.begin(acknowledged=True)
            return None
        if self._listeners > before:
            return "a new receiver takes the commands, and the arms are not where these are"
        return next((line for publisher in publishers if (line := publisher.silence())), None)


def joints_of(robot: Robot, arms: Iterable[str]) -> np.ndarray:
    """Velocity indices of the joints that move some of ``arms``, in the robot's order."""
    return np.unique(np.concatenate([robot.arms[arm].joints for arm in arms]))


def output_name(node: BaseNode) -> str:
    """Declare the parameter ``output`` and return it."""
    allowed = (*KINDS, NONE)
    name: str = node.parameter("output", "trajectory", "what the arms are commanded with", one_of=allowed)
    return name


def make_output(name: str, node: BaseNode, robot: Robot, config: Config, period: float) -> JointOutput:
    """The output called ``name`` on the topics that the parameters ask for; ``period`` [s] of the control loop.

    Raises :class:`ConfigError`.
    """
    what = "arms that do not follow and whose joint positions nobody acknowledges are given up after [s]"
    listener_timeout = node.parameter("listener_timeout", STREAM_TIMEOUT, what, within=(0.1, 5.0))
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
        channels.append(Channel(names, joints, WatchedPublisher(node, kind.message, topic, listener_timeout)))
    return JointOutput(drive, kind, channels)


def _topics(name: str, node: BaseNode, robot: Robot) -> dict[str, str]:
    """The topic that carries each arm's joints; arms with the same one share its messages."""
    what = f"joint commands of all arms, {_ARM} stands for an arm's name; \"\": the output's usual one"
    shared = node.parameter("output_topic", "", what) or ("" if name == NONE else KINDS[name].topic)
    topics: dict[str, str] = {}
    for arm in robot.arms:
        its = node.parameter(f"{arm}.output_topic", "", 'joint commands of this arm alone; "": output_topic')
        topics[arm] = (its or shared).replace(_ARM, arm)
    return topics
