"""What the built-in controller tells, besides joint commands: safe targets, what it follows, what hands feel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Point, PoseStamped
from std_msgs.msg import Bool, ColorRGBA
from visualization_msgs.msg import Marker

from q2r2_control.control.controller import CartesianController
from q2r2_control.loop.control_loop import ArmConditions
from q2r2_control.robot.compose import WORLD
from q2r2_control.ros.base_node import LATCHED_QOS, SENT_COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge.arm_feedback import ConditionPublishers
from q2r2_control.ros.bridge.intakes import TargetIntake
from q2r2_control.ros.bridge.messages import stamped_pose, time_message
from q2r2_control.ros.bridge.reports import TickReport
from q2r2_control.ros.monitoring.endpoints import publish_in_time
from q2r2_control.types import Array, Reference, RobotState

_MARKER_PERIOD = 0.1  # [s]
_WIDTH = 0.006  # [m]
_FAR, _NEAR = 0.10, 0.02  # green beyond the first distance, red below the second [m]
_LIFETIME = 1  # after which RViz drops the marker [s]


class ControllerFeedback:
    """Publishes it, tick by tick; each only while somebody listens."""

    def __init__(self, node: BaseNode, controller: CartesianController, targets: TargetIntake, every: int) -> None:
        """``every``: ticks from one safe target to the next."""
        self._node, self._controller, self._targets, self._every = node, controller, targets, every
        self._ticks = 0
        self._reference: Reference | None = None
        self._safe_targets = {
            arm: node.create_publisher(PoseStamped, f"~/safe_target/{arm}", SENT_COMMAND_QOS) for arm in targets.topics
        }
        self._follows: dict[str, bool | None] = dict.fromkeys(targets.topics)
        self._following = {arm: node.create_publisher(Bool, f"~/following/{arm}", LATCHED_QOS) for arm in self._follows}
        self._conditions = ConditionPublishers(node, self._follows, ArmConditions(controller))
        self._distances = node.create_publisher(Marker, "~/distances", 10)
        self._report = TickReport(node, list(controller.robot.joint_names), list(targets.topics))
        node.create_timer(_MARKER_PERIOD, self._show_distance)

    def publish(self, reference: Reference, state: RobotState, now: float, dt: float, decided: float) -> None:
        """Of one tick of ``dt`` at ``now`` [s]; see :func:`publish_in_time`."""
        self._reference = reference
        self._conditions.update(reference.report, state, now)
        self._report.publish(reference, now, dt, decided)
        self._ticks += 1
        if self._ticks % self._every == 0:
            self._publish_safe_targets(now, decided)

    def tell_followed(self, follows: Callable[[str], bool]) -> None:
        """Say of each arm whether its targets are followed, when that changes."""
        for arm, publisher in self._following.items():
            if (followed := follows(arm)) != self._follows[arm]:
                self._follows[arm] = followed
                publisher.publish(Bool(data=followed))

    def _publish_safe_targets(self, now: float, decided: float) -> None:
        for arm, publisher in self._safe_targets.items():
            if publisher.get_subscription_count():
                frame = self._targets.frames[arm]
                tool = frame.pose.actInv(self._controller.tool_pose(arm))
                publish_in_time(publisher, stamped_pose(tool, frame.name, now), decided)

    def _show_distance(self) -> None:
        if self._reference is not None and self._distances.get_subscription_count():
            now = self._node.now
            points = self._controller.robot.closest_points(self._reference.q, self._reference.report.closest_pair)
            if points is not None:
                self._distances.publish(distance_marker(points, now))


def distance_marker(points: Array, now: float) -> Marker:
    """A line between two points (2, 3) [m] of the world at ``now`` [s]: green if they are far apart, red if near."""
    share = float(np.clip((np.linalg.norm(points[1] - points[0]) - _NEAR) / (_FAR - _NEAR), 0.0, 1.0))
    marker = Marker(ns="closest_pair", type=Marker.LINE_LIST, action=Marker.ADD)
    marker.header.frame_id, marker.header.stamp = WORLD, time_message(now)
    marker.pose.orientation.w = 1.0
    marker.scale.x = _WIDTH
    marker.color = ColorRGBA(r=1.0 - share, g=share, b=0.0, a=1.0)
    marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
    marker.lifetime.sec = _LIFETIME
    return marker
