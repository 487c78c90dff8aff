"""Send targets to the controller of an arm, as the controller's preset requires."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from std_msgs.msg import Empty

from q2r2_control.config.presets import BUILTIN, TWIST, Hold, Preset
from q2r2_control.config.teleop import GuardSettings
from q2r2_control.events import Reason
from q2r2_control.ros.base_node import LATCHED_QOS, SENT_COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge.messages import ended_topic, fill_pose, pose_template, time_message, twist_stamped
from q2r2_control.ros.bridge.parameters import ArmParameters
from q2r2_control.ros.commanders import OnePublisher
from q2r2_control.ros.monitoring import WatchedPublisher, node_of
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.target_stream import apart
from q2r2_control.supervision.tick_pacer import PoseRateLimiter
from q2r2_control.teleop.arm_states import ArmState

_GRAPH_PERIOD = 0.1  # Time between two queries of the graph for subscribers [s].
# After a subscriber appeared, the graph is asked at every tick, because it lists an endpoint before the name of the
# endpoint's node. Until the name is known nothing is sent: the node may be the restarted controller, whose first target
# must not cause a jump. If the name is not known after this time, an engaged arm is paused [s].
_NAME_TIMEOUT = 3.0
# Time from a stream's last target to the message that ends the stream [s]. That message is on another topic, and must
# not arrive before the target.
_END_DELAY = 0.03
# If a tool is farther from its held target than this, something else has moved the tool. The target is not repeated.
_HELD = 0.15, 0.6  # [m], [rad]


class TargetOutput:
    """Publishes one arm's target, or its velocity, to one controller, through a :class:`PoseRateLimiter`.

    The limiter starts at the tool, so that engaging moves nothing. When no more targets come, the limiter brakes. The
    preset says whether the last pose is then repeated. The pose is not repeated if the tool is far from it, or if the
    controller was restarted, because the arm would jump.
    """

    def __init__(
        self,
        node: BaseNode,
        values: ArmParameters,
        preset: Preset,
        controller: str,
        topic: str,
        frame: str,
        guard: GuardSettings,
    ) -> None:
        self.preset = preset
        self.guard = PoseRateLimiter(guard, 1.0 / values.rate)
        self._node, self._controller, self._frame = node, controller, frame
        self._template = pose_template(frame)
        # True if the controller gets the velocity of the guarded pose instead of the pose.
        self._is_twist = preset.message == TWIST
        kind = TwistStamped if self._is_twist else PoseStamped
        self._publisher = WatchedPublisher(node, kind, topic, values.listener_timeout)
        self.topic = self._publisher.topic_name  # The full name of the topic.
        self._one = OnePublisher(node, [self.topic])
        self._unknown_node = Reason.of(RosReason.SUBSCRIBER_UNKNOWN, topic=self.topic)
        self._wrench = None
        if preset.zero_wrench is not None:
            wrench = preset.zero_wrench.format(ctrl=values.prefix)
            self._wrench = node.create_publisher(WrenchStamped, wrench, LATCHED_QOS)
        self.following = False  # Whether a target is followed now.
        self.last_sent: pin.SE3 | None = None  # The last target sent, in the world frame; None if there is none.
        self._ends = node.create_publisher(Empty, ended_topic(topic), SENT_COMMAND_QOS) if preset is BUILTIN else None
        self._sent_at = -math.inf  # Time of the last target of a stream that has not ended yet [s].
        # The reason that the controller was restarted or has ended; None if neither has happened.
        self._fault: Reason | None = None
        self._endpoints: set[bytes] = set()  # Endpoints of the controller.
        self._listeners = 0
        self._unknown = False  # Whether a subscriber's node is not known yet.
        # Times at which the graph was last asked, and at which a subscriber last appeared [s].
        self._asked_at = self._appeared_at = -math.inf
        self.starts = 0  # Number of times that the controller has appeared.

    @property
    def sent(self) -> int:
        return self._publisher.sent

    @property
    def conflict(self) -> Reason | None:
        """The reason if there are other publishers of the same topic, or None."""
        return self._one.conflict()

    @property
    def unready(self) -> Reason | None:
        """The reason if the topic has no subscriber, or a subscriber whose node is not known yet; else None."""
        if self._publisher.listeners == 0:
            return Reason.of(RosReason.NO_SUBSCRIBER, topic=f"{self.topic} ({self.preset.message})")
        return self._unknown_node if self._unknown and not self.following else None

    def take_fault(self, now: float) -> Reason | None:
        """Check the subscribers. If the controller is no longer there, return the reason once."""
        listeners = self._present()
        if listeners > self._listeners or listeners == 0:
            self._appeared_at = now
            if not self.following:
                self.forget(now)  # A new subscriber must not get an old target.
        self._listeners = listeners
        recently = now - self._appeared_at < _NAME_TIMEOUT
        if self._unknown or recently or not 0.0 <= now - self._asked_at <= _GRAPH_PERIOD:
            self._asked_at = now
            self._ask_graph(now)
        if self._unknown and self.following and now - self._appeared_at > _NAME_TIMEOUT:
            self.forget(now)
            return self._unknown_node
        fault, self._fault = self._fault, None
        if fault is None and self.following and (silence := self._publisher.silence()) is not None:
            self.forget(now)  # The successor of the controller must not get an old target.
            return Reason.of(RosReason.CONTROLLER_SILENT, silence, controller=self._controller)
        return fault

    def step(
        self,
        target: pin.SE3 | None,
        tool: pin.SE3 | None,
        base: pin.SE3 | None,
        now: float,
        decided: float,
        start: pin.SE3 | None = None,
        state: ArmState = ArmState.ENGAGED,
    ) -> pin.SE3 | None:
        """Publish the target of one tick, and return the published pose in the world frame, or None.

        Args:
            target: The target of the tool, in the world frame; None while the arm is paused.
            tool: The measured tool pose, in the world frame; None if it is not known.
            base: The frame of the controller's targets, in the world frame; None if it is not known.
            now: The time [s].
            decided: See :func:`publish_in_time`.
            start: The pose at which a new stream begins, in the world frame; None if it begins at the first target.
            state: The state of the arm. In PAUSING the stream continues, because the press may become another gesture.
                In PAUSED a message ends the stream. Without this message, the built-in controller also holds linked
                arms.
        """
        if self._unknown or self._present() > self._listeners or (self._is_twist and base is None):
            if self._is_twist:  # The controller would continue at the last velocity, so it is told to stop.
                self.forget(now)
            return None
        idle = not self.following and self.guard.at_rest
        self.following = target is not None
        if target is not None and idle:
            self.guard.reset(target if start is None else start, now)
            self._publisher.begin()
            self._send_zero_wrench(now)
        pose = self.guard.step(target, now)
        moves = self.following or not self.guard.at_rest
        if pose is None or base is None or not (moves or self._holds(tool, state, now)):
            self._end_stream(state, now)
            return None
        if self.following and self._publisher.waits():
            return pose
        if self._publisher.publish(self._message(pose, base, now), decided):
            self.last_sent, self._sent_at = pose, now
        return pose

    def _message(self, pose: pin.SE3, base: pin.SE3, now: float) -> Any:
        """Return the message of a guarded ``pose`` in the world frame, or of its velocity in the axes of ``base``."""
        if not self._is_twist:
            return fill_pose(self._template, base.actInv(pose), now)
        linear, angular = self.guard.velocity
        return twist_stamped(base.rotation.T @ linear, base.rotation.T @ angular, self._frame, now)

    def _end_stream(self, state: ArmState, now: float) -> None:
        """Publish the end of the stream if the operator paused the arm, but not if the arm stops for another reason."""
        if self._ends is None or state is not ArmState.PAUSED:
            self._sent_at = -math.inf
        elif _END_DELAY < now - self._sent_at < math.inf:
            self._sent_at = -math.inf
            self._ends.publish(Empty())

    def forget(self, now: float) -> None:
        """Drop the held target. The next target begins a new stream. A controller of velocities is told to stop."""
        if self._is_twist and self.last_sent is not None:
            still = twist_stamped(np.zeros(3), np.zeros(3), self._frame, now)
            self._publisher.publish(still, time.monotonic())
        self.following, self.last_sent, self._sent_at = False, None, -math.inf
        self.guard.reset(None, now)

    def _present(self) -> int:
        """Return the number of subscribers. The graph can list a subscriber before the publisher can send to it."""
        return max(self._publisher.listeners, self._node.handle.get_count_subscribers(self.topic))

    def _holds(self, tool: pin.SE3 | None, state: ArmState, now: float) -> bool:
        if self.guard.pose is None:
            return False
        if tool is None or not near(self.guard.pose, tool, *_HELD):
            self.forget(now)
            return False
        pausing = self.preset is BUILTIN and state is ArmState.PAUSING
        return self.preset.hold is Hold.REPEAT or pausing

    def _ask_graph(self, now: float) -> None:
        """Ask the graph whether the controller has appeared or gone.

        Acknowledgements do not tell this, because other subscribers of the topic acknowledge as well.
        """
        found = [(node_of(info), info) for info in self._node.get_subscriptions_info_by_topic(self.topic)]
        self._unknown = len(found) < self._listeners or any(name is None for name, _ in found)
        endpoints = {bytes(info.endpoint_gid) for name, info in found if name == self._controller}
        appeared, gone = endpoints - self._endpoints, self._endpoints and not endpoints
        if self.following and (appeared or gone):
            kind = RosReason.CONTROLLER_RESTARTED if appeared else RosReason.CONTROLLER_ENDED
            self._fault = Reason.of(kind, controller=self._controller)
        if appeared or gone:
            self.forget(now)
        if appeared:
            self.starts += 1
            self._send_zero_wrench(now)
        self._endpoints = endpoints

    def _send_zero_wrench(self, now: float) -> None:
        if self._wrench is not None:
            message = WrenchStamped()
            message.header.frame_id, message.header.stamp = self._frame, time_message(now)
            self._wrench.publish(message)


def near(pose: pin.SE3, other: pin.SE3, distance: float, angle: float) -> bool:
    """Return whether two poses are within ``distance`` [m] and ``angle`` [rad] of each other."""
    length, rotation = apart(pose, other)
    return length <= distance and rotation <= angle
