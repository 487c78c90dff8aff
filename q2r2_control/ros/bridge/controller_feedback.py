"""Outputs of the built-in controller besides joint commands.

These are the safe targets, whether each arm follows its targets, and the openings of grippers.

Fingers and held objects are bodies that must not collide. Openings are numbers from 0, closed, to 1, fully open. The
client of a gripper publishes the wanted opening and the last commanded opening. The name of its topic is the name of
the arm's topic of targets with ``/wanted_opening`` at its end. On ``~/opening/<arm>`` the controller answers with the
wanted opening and the opening that is proven to be safe. The client commands the second opening. The fingers count as
anywhere between closed and open if there is no client, if they are not measured, or if another controller moves the
arms.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, ColorRGBA, Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker

from q2r2_control.config.cell import Config
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.control.controller import CartesianController
from q2r2_control.loop.control_loop import ArmConditions, ControlLoop
from q2r2_control.recording.messages import CONTROLLER_TICK, REFERENCE
from q2r2_control.robot.compose import WORLD
from q2r2_control.ros.base_node import LATCHED_QOS, RECORDED_QOS, SENT_COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge.arm_feedback import ConditionPublishers
from q2r2_control.ros.bridge.gripper_client import wanted_topic
from q2r2_control.ros.bridge.intakes import Fingers, TargetIntake
from q2r2_control.ros.bridge.messages import fill_pose, pose_template, time_message
from q2r2_control.ros.bridge.wire import JointNumbers
from q2r2_control.ros.monitoring import publish_in_time
from q2r2_control.types import Array, Reference, RobotState, StepStatus

_STATUSES = tuple(StepStatus)
# Time from the grant of an opening until the gripper moves to it [s]. The answer has to arrive, and the client then
# waits for the next of its ten goals per second.
GRIPPER_DELAY = 0.3
_DISCOVERY = 1.0  # Time in which the latched messages of other nodes reach a new node, even on a busy machine [s].
_UNMEASURED = "its fingers are not in the joint states, or nothing is proven while the arms are stopped"
_MARKER_PERIOD = 0.1  # Time between two markers [s].
_FAR, _NEAR = 0.10, 0.02  # The marker of a distance is green above the first value, and red below the second value [m].


class ControllerFeedback:
    """Publishes all outputs except openings at every tick, and most of them only while somebody listens."""

    def __init__(self, node: BaseNode, controller: CartesianController, targets: TargetIntake, every: int) -> None:
        """Make the publishers; ``every`` is the number of ticks from one safe target to the next."""
        self._node, self._controller, self._targets, self._every = node, controller, targets, every
        self._ticks = 0
        self._reference: Reference | None = None
        self._safe_targets = {
            arm: node.create_publisher(PoseStamped, f"~/safe_target/{arm}", SENT_COMMAND_QOS) for arm in targets.topics
        }
        self._templates = {arm: pose_template(targets.frames[arm].name) for arm in targets.topics}
        self._follows: dict[str, bool | None] = dict.fromkeys(targets.topics)
        self._following = {arm: node.create_publisher(Bool, f"~/following/{arm}", LATCHED_QOS) for arm in self._follows}
        self._conditions = ConditionPublishers(node, self._follows, ArmConditions(controller))
        self._distances = node.create_publisher(Marker, "~/distances", 10)
        self._recorded_reference = node.create_publisher(JointTrajectory, node.name_in_set(REFERENCE), RECORDED_QOS)
        self._recorded_tick = node.create_publisher(Float64MultiArray, node.name_in_set(CONTROLLER_TICK), RECORDED_QOS)
        self._last = 0.0  # Time of the last tick [s].
        self._shown = 0.0  # Time of the last marker [s].

    def publish(self, reference: Reference, state: RobotState, now: float, dt: float, decided: float) -> None:
        """Publish the outputs of one tick of ``dt`` at ``now`` [s]. See :func:`publish_in_time` for ``decided``."""
        self._reference = reference
        self._conditions.update(reference.report, state, now)
        self._ticks += 1
        if self._recorded_tick.get_subscription_count():
            self._record(reference, now, dt, decided)
        self._last = now
        if not 0.0 <= now - self._shown < _MARKER_PERIOD:
            self._shown = now
            self._show_distance()
        if self._ticks % self._every:
            return
        for arm, publisher in self._safe_targets.items():
            if publisher.get_subscription_count():
                tool = self._targets.frames[arm].pose.actInv(self._controller.tool_pose(arm))
                publish_in_time(publisher, fill_pose(self._templates[arm], tool, now), decided)

    def tell_followed(self, follows: Callable[[str], bool]) -> None:
        """Publish for each arm whether its targets are followed, each time that this changes."""
        for arm, publisher in self._following.items():
            if (followed := follows(arm)) != self._follows[arm]:
                self._follows[arm] = followed
                publisher.publish(Bool(data=followed))

    def _show_distance(self) -> None:
        if self._reference is not None and self._distances.get_subscription_count():
            points = self._controller.robot.closest_points(self._reference.q, self._reference.report.closest_pair)
            if points is not None:
                self._distances.publish(_distance_marker(points, self._node.now))

    def _record(self, reference: Reference, now: float, step: float, decided: float) -> None:
        """Publish the reference of a tick and the report of the step for a recording."""
        passed = now - self._last if self._ticks > 1 else step
        point = JointTrajectoryPoint(
            positions=reference.q.tolist(), velocities=reference.v.tolist(), accelerations=reference.a.tolist()
        )
        message = JointTrajectory(joint_names=list(self._controller.robot.joint_names), points=[point])
        message.header.stamp = time_message(now)
        self._recorded_reference.publish(message)
        report = reference.report
        # The numbers are in the order of tick_fields.
        numbers = (
            *(self._ticks, now, passed, step, time.monotonic() - decided, report.solve_time),
            *(_STATUSES.index(report.status), report.certified, report.fallback),
            *(report.closest_distance, report.margin, report.slack),
            *(arm in report.rejected for arm in self._targets.topics),
        )
        self._recorded_tick.publish(Float64MultiArray(data=[float(number) for number in numbers]))


def _distance_marker(points: Array, now: float) -> Marker:
    share = float(np.clip((np.linalg.norm(points[1] - points[0]) - _NEAR) / (_FAR - _NEAR), 0.0, 1.0))
    marker = Marker(ns="closest_pair", type=Marker.LINE_LIST, action=Marker.ADD)
    marker.header.frame_id, marker.header.stamp = WORLD, time_message(now)
    marker.pose.orientation.w = 1.0
    marker.scale.x = 0.006
    marker.color = ColorRGBA(r=1.0 - share, g=share, b=0.0, a=1.0)
    marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
    marker.lifetime.sec = 1
    return marker


class GripperLimits:
    """Requests openings of grippers from the control loop, and publishes the granted openings."""

    def __init__(self, node: BaseNode, config: Config, loop: ControlLoop, targets: Mapping[str, str]) -> None:
        """Listen to grippers; ``targets`` are the topics of targets, by arm."""
        self._node, self._loop, self._began = node, loop, time.monotonic()
        robot = loop.controller.robot
        self._fingers = Fingers(robot, config)
        self._measured: dict[str, tuple[float, float]] = {}  # By arm, the opening and the time of its measurement [s].
        self.wanted: dict[str, float] = {}  # By arm, the wanted opening: 0 closed .. 1 fully open.
        self._answered: dict[str, tuple[float, float]] = {}
        self._answers: dict[str, Any] = {}
        for arm in (arm for arm in targets if arm in self._fingers.arms or arm in robot.objects.by_arm):
            self._answers[arm] = node.create_publisher(Float64MultiArray, f"~/opening/{arm}", LATCHED_QOS)
            topic = wanted_topic(targets[arm])
            node.create_subscription(Float64MultiArray, topic, partial(self._on_wanted, arm, topic), LATCHED_QOS)

    @property
    def held(self) -> dict[str, str]:
        """By arm, the reason why its gripper does not get the wanted opening."""
        openings = self._loop.granted_openings.items()
        held = {arm: _UNMEASURED for arm, (wanted, granted) in openings if granted != wanted}
        pairs = self._loop.held_grippers.items()
        return held | {arm: f"{'|'.join(pair)} would come too close" for arm, pair in pairs}

    def take_joint_state(self, message: JointState | JointNumbers) -> None:
        """Store the positions of fingers in a message. Other joints are ignored."""
        if self._answers:
            now = self._node.now
            self._measured |= {arm: (opening, now) for arm, opening in self._fingers.openings(message).items()}

    def openings(self, now: float) -> dict[str, float]:
        """Return the openings of arms with current measurements of fingers: 0 closed .. 1 open, or slightly beyond."""
        return {
            arm: opening
            for arm, (opening, at) in self._measured.items()
            if now - at <= STREAM_TIMEOUT and math.isfinite(opening)
        }

    def awaits(self, now: float) -> bool:
        """Return whether the last commanded opening of a measured gripper can still arrive over ROS.

        Without this opening, the fingers count as anywhere between closed and open. Arms that rest near an object would
        then move away from it.
        """
        if time.monotonic() - self._began > _DISCOVERY:
            return False
        return any(arm in self._answers and arm not in self.wanted for arm in self.openings(now))

    def answer(self) -> None:
        for arm, answer in self._loop.granted_openings.items():
            if self._answered.get(arm) != answer:
                self._answered[arm] = answer
                self._answers[arm].publish(Float64MultiArray(data=answer))

    def _on_wanted(self, arm: str, topic: str, message: Float64MultiArray) -> None:
        told = list(message.data)
        if len(told) != 2 or not 0.0 <= told[0] <= 1.0 or (told[1] == told[1] and not 0.0 <= told[1] <= 1.0):
            allowed = "two, wanted and commanded last (or NaN), 0 closed .. 1 open"
            self._node.drop(topic, f"{told!s:.60}; allowed: {allowed}")
            return
        wanted, commanded = told
        if arm not in self.wanted and commanded == commanded:
            # This opening was requested before the node began, maybe long ago. Therefore the gripper stays at the last
            # commanded opening.
            now = self._node.now
            self._loop.resume_gripper(arm, wanted, commanded, self.openings(now), now)
            self.answer()
        self.wanted[arm] = wanted
