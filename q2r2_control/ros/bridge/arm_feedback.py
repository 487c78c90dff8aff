"""Report on the teleoperation of one arm: as vibrations of its hand, in the log, in RViz and in a recording."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import Point, PoseStamped
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from std_msgs.msg import ColorRGBA, Float64MultiArray, String
from visualization_msgs.msg import Marker

from q2r2_control.events import Event
from q2r2_control.recording.messages import WORLD, arm_events, arm_flags, asked_target
from q2r2_control.ros.base_node import RECORDED_QOS, STREAM_QOS, BaseNode
from q2r2_control.ros.bridge.gripper_client import GripperClient
from q2r2_control.ros.bridge.hand_topics import HandIntake
from q2r2_control.ros.bridge.messages import stamped_pose, time_message
from q2r2_control.ros.bridge.parameters import ArmParameters
from q2r2_control.teleop.arm_states import AT_REST, is_refusal
from q2r2_control.teleop.hand_motion import with_offset
from q2r2_control.teleop.haptics import ArmCondition, HapticPulses
from q2r2_control.types import ArmTarget, Array, RobotState, StepReport
from q2r2_control.wording import event_line

if TYPE_CHECKING:
    from q2r2_control.loop.control_loop import ArmConditions

_AXIS_LENGTH, _AXIS_WIDTH, _PATH_WIDTH, _BALL = 0.1, 0.008, 0.004, 0.04  # Sizes of markers [m].
_PATH_POINTS = 200
_PATH_STEP = 0.005  # Distance between two points of the path [m].
_RGB = ((1.0, 0.1, 0.1), (0.1, 0.8, 0.1), (0.2, 0.3, 1.0))
_SIDES = {"left": (0.1, 0.6, 1.0), "right": (1.0, 0.55, 0.1)}
_PAUSED = 0.35  # Opacity of the markers while the arm is paused.
_MARKER_PERIOD, _CONDITION_PERIOD = 0.05, 0.04  # Times between two messages [s].


class TargetMarkers:
    """The RViz markers of one arm.

    The axes and the ball are given in the tool's frame. While the arm is paused, they therefore stay at the real tool.
    """

    def __init__(self, arm: str, tool_frame: str, world_frame: str) -> None:
        self._arm, self._tool_frame, self._world_frame = arm, tool_frame, world_frame
        self._path: deque[Array] = deque(maxlen=_PATH_POINTS)

    def at(self, target: pin.SE3 | None, tool: pin.SE3 | None, engaged: bool, now: float) -> list[Marker]:
        """Return the markers at ``now`` [s] for a target and a tool pose in the world frame; [] if ``tool`` is None."""
        if tool is None:
            return []
        shown = target if engaged and target is not None else tool
        if engaged and (not self._path or np.linalg.norm(shown.translation - self._path[-1]) > _PATH_STEP):
            self._path.append(np.array(shown.translation))
        opacity = 1.0 if engaged else _PAUSED
        in_tool = tool.inverse() * shown
        ball = self._marker("engaged", Marker.SPHERE, self._tool_frame, opacity, now)
        ball.pose = stamped_pose(in_tool, self._tool_frame, now).pose
        ball.scale.x = ball.scale.y = ball.scale.z = _BALL
        axes = self._marker("axes", Marker.LINE_LIST, self._tool_frame, opacity, now)
        axes.pose = ball.pose
        axes.scale.x = _AXIS_WIDTH
        axes.points = list(chain.from_iterable((Point(), _point(row)) for row in _AXIS_LENGTH * np.eye(3)))
        axes.colors = [ColorRGBA(r=r, g=g, b=b, a=opacity) for r, g, b in _RGB for _ in range(2)]
        path = self._marker("path", Marker.LINE_STRIP, self._world_frame, opacity, now)
        path.scale.x = _PATH_WIDTH
        path.points = [_point(position) for position in self._path]
        return [ball, axes, path] if len(self._path) > 1 else [ball, axes]

    def _marker(self, name: str, kind: int, frame: str, opacity: float, now: float) -> Marker:
        marker = Marker(ns=f"{self._arm}_{name}", id=0, type=kind, action=Marker.ADD, frame_locked=True)
        marker.header.frame_id, marker.header.stamp = frame, time_message(now)
        r, g, b = _SIDES[self._arm]
        marker.color = ColorRGBA(r=r, g=g, b=b, a=opacity)
        marker.pose.orientation.w = 1.0
        return marker


def _point(position: Array) -> Point:
    x, y, z = position.tolist()
    return Point(x=x, y=y, z=z)


class ArmFeedback:
    """Reports on one arm, and keeps its last event."""

    def __init__(self, node: BaseNode, arm: str, values: ArmParameters, hand: HandIntake) -> None:
        self._node, self._hand = node, hand
        self.haptics = HapticPulses(values.teleop.haptics)
        # The text of the last event, and the kind of this event's reason.
        self.last_line, self.last_kind = "not engaged yet", ""
        # The text of the last event after which the arm rested, and the kind of this event's reason.
        self.paused, self.paused_kind = "not engaged yet", ""
        self._drawn = TargetMarkers(arm, values.tool_frame, values.world_frame)
        self._markers = node.create_publisher(Marker, "visualization_marker", 10)
        self._shown = 0.0
        # These publishers are for recordings.
        flags, events, target = map(node.name_in_set, (arm_flags(arm), arm_events(arm), asked_target(arm)))
        self._flags = node.create_publisher(Float64MultiArray, flags, RECORDED_QOS)
        self._events = node.create_publisher(String, events, RECORDED_QOS)
        self._target = node.create_publisher(PoseStamped, target, RECORDED_QOS)

    def tell(self, event: Event) -> None:
        self.last_line, self.last_kind = event_line(event), str(event.reason.root.kind)
        if event.destination in AT_REST and not is_refusal(event):
            self.paused, self.paused_kind = self.last_line, self.last_kind
        self._node.get_logger().info(self.last_line)
        self.haptics.start_pulse(event)
        self._events.publish(String(data=json.dumps(event.as_json())))
        self._node.report_health()

    def publish(
        self,
        engaged: bool,
        target: ArmTarget,
        sent: pin.SE3 | None,
        tool: pin.SE3 | None,
        gripper: GripperClient,
        hand: str,
        now: float,
    ) -> None:
        """Publish the report of one tick at ``now`` [s].

        ``sent`` is the pose that was sent to the controller for ``target``, in the world frame.
        """
        if self._flags.get_subscription_count():
            if (command := target.command) is not None:
                self._target.publish(stamped_pose(command, WORLD, now))
            # The numbers are in the order of ARM_FIELDS.
            numbers = (engaged, target.slip, target.slip_angle, target.gripper, gripper.opening)
            self._flags.publish(Float64MultiArray(data=[float(number) for number in numbers]))
        self.haptics.slip(target.slip, target.slip_angle)
        self.haptics.grasps(gripper.holds)
        if (pulse := self.haptics.at(now, hand)) is not None:
            self._hand.feel(pulse)
        if not 0.0 <= now - self._shown < _MARKER_PERIOD:
            self._shown = now
            if not self._markers.get_subscription_count():
                return
            # The pose that the measured tool should have.
            asked = None if sent is None else with_offset(sent, target.offset)
            for marker in self._drawn.at(asked, tool, engaged, now):
                self._markers.publish(marker)


class _Condition(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    spare_distance: float | None = None
    joints_at_limit: frozenset[str] = Field(frozenset(), max_length=100)
    contact_force: float | None = None


class ConditionPublishers:
    """Publishes each arm's condition while its topic has subscribers.

    A condition is the spare distance, the joints at a limit and the contact force.
    """

    def __init__(self, node: BaseNode, arms: Any, conditions: ArmConditions) -> None:
        self._conditions = conditions
        self._publishers = {arm: node.create_publisher(String, f"~/condition/{arm}", STREAM_QOS) for arm in arms}
        self._due = -math.inf

    def update(self, report: StepReport, state: RobotState, now: float) -> None:
        self._conditions.note(report, now)
        if 0.0 <= self._due - now <= _CONDITION_PERIOD:
            return
        self._due = now + _CONDITION_PERIOD
        if not any(publisher.get_subscription_count() for publisher in self._publishers.values()):
            return
        for arm, felt in self._conditions.look(state, now).items():
            spare = felt.spare if math.isfinite(felt.spare) else None
            told = _Condition(spare_distance=spare, joints_at_limit=felt.limits, contact_force=felt.force)
            self._publishers[arm].publish(String(data=told.model_dump_json()))


def listen_to_condition(node: BaseNode, controller: str, arm: str, notice: Callable[[ArmCondition], None]) -> None:
    """Call ``notice`` with each condition of an arm that the controller reports."""
    topic = f"{controller}/condition/{arm}"

    def take(message: String) -> None:
        try:
            told = _Condition.model_validate_json(message.data)
        except ValidationError:
            node.drop(topic, f"{message.data!r:.60}")
            return
        spare = math.inf if told.spare_distance is None else told.spare_distance
        notice(ArmCondition(spare, told.joints_at_limit, told.contact_force))

    node.create_subscription(String, topic, take, STREAM_QOS)
