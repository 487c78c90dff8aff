"""Joint states in: on one topic, or one an arm, merged by joint name."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from sensor_msgs.msg import JointState

from q2r2_control.robot.robot import Robot
from q2r2_control.ros.bridge.base_node import STREAM_QOS, BaseNode
from q2r2_control.ros.bridge.messages import robot_state
from q2r2_control.ros.bridge.outputs import joints_of
from q2r2_control.ros.monitoring.publishers import Publishers
from q2r2_control.types import RobotState


class JointIntake:
    """Makes one state of all arms; it is as old as the oldest of its parts."""

    def __init__(self, node: BaseNode, robot: Robot) -> None:
        self._node = node
        self._topics: dict[str, list[str]] = {}  # to the arms whose joints they bring
        for arm in robot.arms:
            topic = node.parameter(f"{arm}.joint_states_topic", "joint_states", "brings all joints of this arm")
            self._topics.setdefault(topic, []).append(arm)
        self._joints = {topic: joints_of(robot, arms) for topic, arms in self._topics.items()}
        self._stamps = dict.fromkeys(self._topics, -math.inf)
        self._names = {topic: [robot.joint_names[joint] for joint in joints] for topic, joints in self._joints.items()}
        self._expected = {topic: set(names) for topic, names in self._names.items()}
        self._publishers = Publishers(node, self._topics)
        self._values = np.zeros((3, len(robot.joint_names)))
        self.state: RobotState | None = None  # the newest of all arms

    def subscribe(self, take: Callable[[RobotState | str, float], None]) -> None:
        """Hand each state of all arms, or what is wrong with a message, to ``take``, with the time [s]."""
        for topic in self._topics:
            self._node.create_subscription(JointState, topic, partial(self._on_message, take, topic), STREAM_QOS)

    def look(self) -> None:
        """Ask the graph who publishes."""
        self._publishers.look()

    def source(self) -> str:
        """Where those come from that have not come for longest, for the middle of a sentence."""
        topic = min(self._stamps, key=lambda name: self._stamps[name])
        where = f" on {topic}" if len(self._topics) > 1 else ""
        return self._publishers.source(topic) + where

    def _on_message(self, take: Callable[[RobotState | str, float], None], topic: str, message: JointState) -> None:
        joints, names = self._joints[topic], self._names[topic]
        if not self._expected[topic] & set(message.name):
            return  # of a gripper or another robot
        now = self._node.now
        part = robot_state(message, names, now)
        if isinstance(part, str):
            take(part if len(self._topics) == 1 else f"{topic}: {part}", now)
            return
        self._stamps[topic] = now
        self._values[:, joints] = part.q, part.v, part.tau
        oldest = min(self._stamps.values())
        if oldest > -math.inf:
            q, v, tau = self._values.copy()
            self.state = RobotState(q=q, v=v, tau=tau, tau_external=None, stamp=oldest)
            take(self.state, now)
