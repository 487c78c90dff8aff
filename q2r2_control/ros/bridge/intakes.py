"""The inputs of the built-in controller: targets on one topic for each arm, and joint states merged by joint name."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from rosbags.serde import SerdeError
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty

from q2r2_control.config.cell import Config
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason
from q2r2_control.robot.compose import WORLD
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turns import TurnCounter
from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS, BaseNode
from q2r2_control.ros.bridge.joint_outputs import joints_of
from q2r2_control.ros.bridge.messages import (
    age,
    called_otherwise,
    delay,
    ended_topic,
    order_of,
    pose_of_numbers,
    robot_state,
)
from q2r2_control.ros.bridge.wire import JointNumbers, joint_state_reader, read_pose
from q2r2_control.ros.monitoring import Publishers
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.targets import DelayWatch
from q2r2_control.types import ArmTiming, Array, RobotState
from q2r2_control.wording import sentence

_SHARED = "joint_states"  # The default topic of joint states.
# If a target's delay exceeds the usual delay by more than this, the stamp does not say when the target is due [s].
_LATEST = 0.02
# The age of a target is the time from its stamp to its receipt. If it exceeds the age of the previous target by more
# than this, the sender stood still between making and sending the target [s].
_OLD = 0.5
# Longest period of joint states from which the lags of two arms can be compared [s], and the weight of a new period in
# the mean period.
_LONGEST_PERIOD, _PERIOD_SHARE = 0.02, 0.05
COMMAND_TIME = 0.01  # Time from a command to the arm's motion, if drivers do not report this time [s].
_PARTS = 64  # Largest number of sets of joint names whose joints are remembered.
_LAG_NOISE = 0.01  # Noise of a lag that is estimated from joint states [s].
_WARNING_TIME = 1.0  # Time for which refused targets are reported [s].
# A function that takes a target, and returns why it is not followed, or None. Its arguments are: the arm; the target in
# the world frame, or None if the message was no pose; the time of receipt [s]; the message's number or None; the time
# at which the target is due [s], or None.
Take = Callable[[str, pin.SE3 | None, float, int | None, float | None], Reason | None]
TakeState = Callable[[RobotState | Reason, float], None]
Look = Callable[[JointNumbers], None]


class TargetFrame(NamedTuple):
    """The frame of target poses."""

    name: str
    pose: pin.SE3  # Pose in the world frame.


class TargetIntake:
    """Subscribes to the targets of all arms. It calls ``changed`` when :meth:`faults` has something new."""

    def __init__(self, node: BaseNode, robot: Robot, changed: Callable[[], None]) -> None:
        self._node, self._changed = node, changed
        self.frames = {arm: _frame_of(node, robot, arm) for arm in robot.arms}
        self.topics: dict[str, str] = {}
        for arm in robot.arms:
            name = node.parameter(f"{arm}.target_topic", f"q2r2/{arm}/target_frame", "targets of this arm")
            topic = node.full_name(name)
            if topic in self.topics.values():
                raise ConfigError(f"{arm}.target_topic = {topic!r:.80}: another arm has it; allowed: one of its own")
            self.topics[arm] = topic
        self.publishers = Publishers(node, self.topics.values())
        self._delays = {arm: DelayWatch(STREAM_TIMEOUT) for arm in robot.arms}
        # The delay of each target from its stamp to its receipt.
        self._stamps = {arm: DelayWatch(_LATEST) for arm in robot.arms}
        self._newest = dict.fromkeys(robot.arms, (0, 0.0))  # Stamp of the last target [ns], and its age at receipt [s].
        # By arm, why its last target was refused, and the time of the refusal [s].
        self._refused: dict[str, tuple[Reason, float]] = {}
        self.rejected = dict.fromkeys(robot.arms, 0)

    def subscribe(self, take: Take, release: Callable[[str], None]) -> None:
        """Pass each target to ``take``. If a sender ends the stream of an arm, pass the arm's name to ``release``."""
        for arm, topic in self.topics.items():
            on_target = partial(self._on_target, take, arm)
            self._node.create_subscription(PoseStamped, topic, on_target, COMMAND_QOS, raw=True)
            on_end = partial(lambda arm, _: release(arm), arm)
            self._node.create_subscription(Empty, ended_topic(topic), on_end, COMMAND_QOS)

    def source(self, arm: str) -> str:
        return self.publishers.source(self.topics[arm])

    def faults(self) -> dict[str, Reason]:
        """Return why targets were refused lately, for each arm with refused targets."""
        now = self._node.now
        self._refused = {arm: entry for arm, entry in self._refused.items() if now - entry[1] <= _WARNING_TIME}
        return {arm: refusal for arm, (refusal, _) in self._refused.items()}

    def _on_target(self, take: Take, arm: str, message: bytes | PoseStamped, info: Mapping[str, int | None]) -> None:
        try:
            made, frame_id, numbers = read_pose(message)
        except SerdeError as error:  # The bytes are no valid message. This is a fault of the sender.
            self._node.drop(self.topics[arm], str(error))
            return
        frame, now = self.frames[arm], self._node.now
        pose = pose_of_numbers(numbers) if frame_id == frame.name else None
        received = now - age(info)
        late = self._delays[arm].take(delay(info), time.monotonic()) or self._stood_still(arm, made, received)
        wanted = None if pose is None or late else frame.pose * pose
        due = self._due(arm, made, received)
        refusal = take(arm, wanted, now, info["publication_sequence_number"], due)
        if refusal is not None:
            self._refuse(arm, refusal)
        elif late:
            self._refuse(arm, Reason.of(RosReason.TARGET_LATE, late=late))
        elif frame_id != frame.name:
            self._refuse(arm, Reason.of(RosReason.TARGET_FRAME, frame=frame_id[:40], allowed=frame.name))
        elif pose is None:
            self._refuse(arm, Reason(RosReason.TARGET_NOT_A_POSE))
        else:
            self._refused.pop(arm, None)

    def _due(self, arm: str, made: int, received: float) -> float | None:
        """Return when a target is due [s], from its stamp ``made`` [ns]; None if the stamp does not show this."""
        stamp, stamps = 1e-9 * made, self._stamps[arm]
        known = stamp > 0.0 and stamps.take(received - stamp, received) == 0.0
        return stamp + stamps.usual if known else None

    def _stood_still(self, arm: str, made: int, received: float) -> float:
        """Return the time for which the sender was frozen between making and sending a target [s]; 0 if it was short.

        If the process froze just before its middleware recorded the time of sending, only the stamp of the target shows
        this.
        """
        (before, usual), self._newest[arm] = self._newest[arm], (made, received - 1e-9 * made)
        late = received - 1e-9 * made - usual
        return late if 0 < before < made and late > _OLD else 0.0

    def _refuse(self, arm: str, refusal: Reason) -> None:
        """Log why targets are not used, once for each kind of fault, until a target is used or no more targets come."""
        self.rejected[arm] += 1
        before = self._refused.get(arm)
        self._refused[arm] = (refusal, self._node.now)
        if before is None or before[0].kind != refusal.kind:
            self._node.get_logger().warning(f"target of {arm} not used: {sentence(refusal)}")
            self._changed()


def _frame_of(node: BaseNode, robot: Robot, arm: str) -> TargetFrame:
    """Return the frame of an arm's targets; raises :class:`ConfigError` for a link that moves."""
    what = "frame_id that targets have to have: a link that does not move, or any other name for the cell's world"
    name, model = node.parameter(f"{arm}.target_frame_id", WORLD, what), robot.model
    if name == WORLD or not model.existFrame(name, pin.FrameType.BODY):
        return TargetFrame(name, pin.SE3.Identity())
    frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
    if frame.parentJoint != 0:
        raise ConfigError(f"{arm}.target_frame_id = {name!r:.60}: that link moves; allowed: one that does not")
    return TargetFrame(name, frame.placement.copy())


class JointIntake:
    """Merges joint states from one or more topics into one state of all arms, with the time of its oldest part."""

    def __init__(
        self, node: BaseNode, robot: Robot, needs_external_torque: bool = False, told_by_drivers: bool = False
    ) -> None:
        """Declare the parameters; raises :class:`ConfigError`.

        With ``needs_external_torque``, a state without external torques counts as a fault. The topic of these torques
        must then be set, unless drivers report the torques (``told_by_drivers``).
        """
        self._node, self._needs_external_torque = node, needs_external_torque
        self._topics: dict[str, list[str]] = {}  # By topic, the arms whose joint states come on it.
        for arm in robot.arms:
            topic = node.parameter(f"{arm}.joint_states_topic", _SHARED, "carries all joints of this arm")
            self._topics.setdefault(topic, []).append(arm)
        self._joints = {topic: joints_of(robot, arms) for topic, arms in self._topics.items()}
        self._others = {topic: tuple(set(robot.arms).difference(its)) for topic, its in self._topics.items()}
        self._stamps = np.full(len(robot.joint_names), -math.inf)  # Time of each joint's measurement (nv,) [s].
        # For each topic and list of names in a message, the names of our joints in it, and their indices.
        self._parts: dict[tuple[str, tuple[str, ...]], tuple[list[str], npt.NDArray[np.intp]]] = {}
        self._periods = dict.fromkeys(self._topics, _LONGEST_PERIOD)  # By topic, the mean time between messages [s].
        self._names = {topic: [robot.joint_names[joint] for joint in joints] for topic, joints in self._joints.items()}
        what = 'external torques of all joints, for admittance and vibrations: effort of a JointState; "": none'
        self._external_topic = node.parameter("external_torque_topic", "", what)
        if needs_external_torque and not self._external_topic and not told_by_drivers:
            raise ConfigError("admittance.enabled = true: set the parameter external_torque_topic, which it needs")
        self._external: Array | None = None  # The newest external torques (nv,) [Nm].
        self._external_stamp = -math.inf
        self._joint_names = list(robot.joint_names)
        self._publishers = Publishers(node, self._topics)
        self._values = np.zeros((3, len(robot.joint_names)))
        self._turns = TurnCounter(robot)
        self.state: RobotState | None = None  # The newest state of all arms.
        self._own_names: set[str] = set()  # Topics on which messages with our own names of joints have come.
        # By our name of a joint, the name that the driver uses for it. Joints with equal names are left out.
        self.theirs: dict[str, str] = {}
        # Two functions that return what drivers report. The first one returns why arms do not follow, or None. The
        # second one gets a measured posture (nv,), and returns the posture at which the drivers hold the arms (nv,)
        # [rad], or None.
        self.driver_fault: Callable[[], Reason | None] = lambda: None
        self.driver_held: Callable[[Array], Array | None] = lambda q: None

    def subscribe(self, take: TakeState, look: Look) -> None:
        """Pass states of all arms, or a fault, to ``take`` with the time [s], and each message to ``look``."""
        for topic in self._topics:
            on_message = partial(self._on_message, take, look, topic, joint_state_reader())
            self._node.create_subscription(JointState, topic, on_message, STREAM_QOS, raw=True)
        if self._external_topic:
            on_external = partial(self._on_external, joint_state_reader())
            self._node.create_subscription(JointState, self._external_topic, on_external, STREAM_QOS, raw=True)

    def source(self) -> str:
        """Return the publishers of the oldest joint states, for the middle of a sentence."""
        topic = min(self._topics, key=self._stamp)
        where = f" on {topic}" if len(self._topics) > 1 else ""
        return self._publishers.source(topic) + where

    def _stamp(self, topic: str) -> float:
        """Return the time of the oldest measurement of a topic's joints [s]."""
        return float(self._stamps[self._joints[topic]].min())

    def timings(self, now: float) -> dict[str, ArmTiming]:
        """Return the timing of each arm at ``now`` [s]; {} if all arms share one topic, or if there is no state."""
        if len(self._topics) < 2 or self.state is None:
            return {}
        silent = {topic: now - self._stamp(topic) for topic in self._topics}
        return {
            arm: ArmTiming(None, silent[topic], self._periods[topic], _LAG_NOISE)
            for topic, arms in self._topics.items()
            for arm in arms
        }

    def _on_message(
        self, take: TakeState, look: Look, topic: str, read: Callable[[Any], JointNumbers], data: bytes | JointState
    ) -> None:
        try:
            message = read(data)
        except SerdeError:  # The bytes are no valid message. This is a fault of the sender.
            self._node.drop(topic, f"{len(bytes(data))} bytes")
            return
        look(message)
        names, joints = self._part(topic, tuple(message.name))
        if names:
            if topic not in self._own_names:
                self._own_names.add(topic)
                for name in self._names[topic]:
                    self.theirs.pop(name, None)
        elif names := self._named_otherwise(topic, message.name):
            joints = self._joints[topic]
        else:
            return  # The message is about a gripper or another robot.
        now = self._node.now
        part = robot_state(message, names, now)
        if isinstance(part, str):
            take(Reason.of(RosReason.BAD_JOINT_STATES, text=self._on_topic(topic, part)), now)
            return
        passed = min(now - float(self._stamps[joints].min()), _LONGEST_PERIOD)
        self._periods[topic] += _PERIOD_SHARE * (passed - self._periods[topic])
        self._stamps[joints] = now
        for values, numbers in zip(self._values, (part.q, part.v, part.tau), strict=True):
            values[joints] = numbers
        oldest = float(self._stamps.min())
        if oldest == -math.inf:
            unknown = self._stamps[self._joints[topic]] == -math.inf
            if missing := [name for name, is_unknown in zip(self._names[topic], unknown, strict=True) if is_unknown]:
                text = f"no joint {missing[0]}" + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
                take(Reason.of(RosReason.BAD_JOINT_STATES, text=self._on_topic(topic, text)), now)
            return
        q, v, tau = self._values.copy()
        q = self._turns.counted(q, self._stamps)
        silent = now - self._external_stamp > STREAM_TIMEOUT
        external = None if silent else self._external
        self.state = RobotState(q=q, v=v, tau=tau, tau_external=external, stamp=oldest, held=self.driver_held(q))
        if silent and self._needs_external_torque:
            take(Reason.of(RosReason.NO_EXTERNAL_TORQUES, topic=self._external_topic), now)
        else:
            take(self.driver_fault() or self.state, now)

    def _on_topic(self, topic: str, text: str) -> str:
        return text if len(self._topics) == 1 else f"{topic}: {text}"

    def _part(self, topic: str, given: tuple[str, ...]) -> tuple[list[str], npt.NDArray[np.intp]]:
        """Return names and indices of those joints of a topic that are in a message with the names ``given``.

        A message can contain only some of the topic's joints, because each arm can have its own publisher.
        """
        if (part := self._parts.get((topic, given))) is None:
            if len(self._parts) >= _PARTS:  # The cache fills only if a publisher sends new names again and again.
                self._parts.clear()
            pairs = zip(self._names[topic], self._joints[topic], strict=True)
            found = {name: joint for name, joint in pairs if name in given}
            part = self._parts[topic, given] = list(found), np.array(list(found.values()), dtype=np.intp)
        return part

    def _named_otherwise(self, topic: str, given: Sequence[str]) -> list[str]:
        """Return the sender's own names of an arm's joints; [] if they cannot be found. They are logged once."""
        names = self._names[topic]
        # Any robot can publish on the default topic. If messages with our names came on a topic, other names on this
        # topic are not needed.
        if topic == _SHARED or len(self._topics[topic]) > 1 or topic in self._own_names:
            return []
        theirs = called_otherwise(tuple(names), tuple(given), self._others[topic])
        if theirs and names[0] not in self.theirs:
            self.theirs |= theirs
            pairs = ", ".join(f"{name} is {its}" for name, its in theirs.items())
            self._node.get_logger().info(f"{topic}: {pairs}")
        return list(theirs.values()) if theirs.items() <= self.theirs.items() else []

    def take_external(self, torques: Array) -> None:
        """Store the external torques of all joints (nv,) [Nm]."""
        self._external, self._external_stamp = torques, self._node.now

    def _on_external(self, read: Callable[[Any], JointNumbers], data: bytes | JointState) -> None:
        try:
            message = read(data)
        except SerdeError:  # The bytes are no valid message. This is a fault of the sender.
            self._node.drop(self._external_topic, f"{len(bytes(data))} bytes")
            return
        if not set(message.name) >= set(self._joint_names):
            return  # The message is about another robot.
        effort = dict(zip(message.name, message.effort.tolist(), strict=False))
        torques = np.array([effort.get(name, math.nan) for name in self._joint_names])
        if len(message.effort) == len(message.name) and np.isfinite(torques).all():
            self.take_external(torques)
        else:
            self._node.drop(self._external_topic, f"{message.effort.tolist()!s:.60}")


class Fingers:
    """Finds the finger joints of a cell's grippers in joint states."""

    def __init__(self, robot: Robot, config: Config) -> None:
        self._grippers = {
            str(arm): (tuple(robot.arms[arm].finger_joints), each.gripper.closed_position, each.gripper.open_position)
            for arm, each in config.arms.items()
            if robot.arms[arm].stroke > 0.0
        }

    @property
    def arms(self) -> tuple[str, ...]:
        """The arms with a gripper."""
        return tuple(self._grippers)

    def openings(self, message: JointState | JointNumbers) -> dict[str, float]:
        """Return the openings of arms whose fingers are in the message: 0 closed .. 1 open, or slightly beyond."""
        found: dict[str, float] = {}
        if len(message.position) != len(message.name):
            return found
        for arm, (joints, closed, opened) in self._grippers.items():
            if not isinstance(order := order_of(tuple(message.name), joints), str):
                position = sum(message.position[index] for index in order) / len(joints)
                found[arm] = (position - closed) / (opened - closed)
        return found
