"""What nodes publish for a recording, and what the recorder's node tells them."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.events import Event, Reason
from q2r2_control.recording.messages import (
    CONTROLLER_TICK,
    RECORDER,
    REFERENCE,
    WORLD,
    arm_events,
    arm_flags,
    asked_target,
)
from q2r2_control.ros.base_node import RECORDED_QOS
from q2r2_control.ros.bridge.messages import stamped_pose, time_message
from q2r2_control.teleop.both_arms import EpisodeMarks
from q2r2_control.types import ArmTarget, Reference, StepStatus

_STATUSES = tuple(StepStatus)
_PATIENCE = 2.0  # with a recorder that says nothing [s]


class TickReport:
    """The controller's reference and how it came about, at each tick that moves it; while anybody listens."""

    def __init__(self, node: Node, joints: Sequence[str], arms: Sequence[str]) -> None:
        self._joints, self._arms = list(joints), tuple(arms)
        self._reference = node.create_publisher(JointTrajectory, REFERENCE, RECORDED_QOS)
        self._tick = node.create_publisher(Float64MultiArray, CONTROLLER_TICK, RECORDED_QOS)
        self._count, self._last = 0, 0.0

    def publish(self, reference: Reference, now: float, step: float, decided: float) -> None:
        """Of the tick at ``now`` [s] that moved it by ``step`` [s] and began at ``decided`` [s] of steady time."""
        self._count += 1
        passed = now - self._last if self._count > 1 else step
        self._last = now
        if not self._tick.get_subscription_count():
            return
        point = JointTrajectoryPoint(
            positions=reference.q.tolist(), velocities=reference.v.tolist(), accelerations=reference.a.tolist()
        )
        message = JointTrajectory(joint_names=self._joints, points=[point])
        message.header.stamp = time_message(now)
        self._reference.publish(message)
        report = reference.report
        # In the order of tick_fields.
        numbers = (
            *(self._count, now, passed, step, time.monotonic() - decided, report.solve_time),
            *(_STATUSES.index(report.status), report.certified, report.fallback),
            *(report.closest_distance, report.margin, report.slack),
            *(arm in report.rejected for arm in self._arms),
        )
        self._tick.publish(Float64MultiArray(data=[float(number) for number in numbers]))


class ArmReport:
    """What happens to an arm's teleoperation, and its flags at each tick; the latter while anybody listens."""

    def __init__(self, node: Node, arm: str) -> None:
        self._flags = node.create_publisher(Float64MultiArray, arm_flags(arm), RECORDED_QOS)
        self._events = node.create_publisher(String, arm_events(arm), RECORDED_QOS)
        self._target = node.create_publisher(PoseStamped, asked_target(arm), RECORDED_QOS)

    def tell(self, event: Event) -> None:
        """Publish an event."""
        self._events.publish(String(data=json.dumps(event.as_json())))

    def publish(self, engaged: bool, target: ArmTarget, opening: float, now: float) -> None:
        """Publish the numbers of ``ARM_FIELDS`` at ``now`` [s], and the target in the world, where there is one."""
        if self._flags.get_subscription_count():
            if (command := target.command) is not None:
                self._target.publish(stamped_pose(command, WORLD, now))
            numbers = (engaged, target.slip, target.slip_angle, target.gripper, opening)
            self._flags.publish(Float64MultiArray(data=[float(number) for number in numbers]))


class RecorderLink:
    """What the recorder's node says: whether it records, and whether an episode is open, whoever began it."""

    def __init__(self, node: Node) -> None:
        self._state: dict[str, Any] | None = None  # the newest that has not been used
        self._heard = 0.0  # [s] of steady time
        self._served: int | None = None  # services that it has answered
        self._reasons: list[Reason] = []
        node.create_subscription(String, f"{RECORDER}/state", self._on_state, 10)

    def update(self, marks: EpisodeMarks) -> list[Reason]:
        """Once a tick, before the teleoperation; returns the reasons of new events of its services."""
        if (state := self._state) is not None:
            marks.recorded, marks.open, marks.any = state["records"], state["episode_open"], state["any_episode"]
            self._state = None
        if marks.recorded and time.monotonic() - self._heard > _PATIENCE:
            marks.recorded = False
        reasons, self._reasons = self._reasons, []
        return reasons

    def _on_state(self, message: String) -> None:
        self._state = state = json.loads(message.data)
        self._heard = time.monotonic()
        if self._served is not None and state["served"] != self._served:
            self._reasons.append(Reason.from_json(state["served_last"]))
        self._served = state["served"]
