"""The last step before the controller of an arm: it gets targets on its preset's terms, or none."""

from __future__ import annotations

import math

import pinocchio as pin
from geometry_msgs.msg import PoseStamped, WrenchStamped
from std_msgs.msg import Empty

from q2r2_control.config.presets import BUILTIN, POSE, Hold, Preset
from q2r2_control.config.teleop import GuardSettings
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.ros.base_node import LATCHED_QOS, SENT_COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge.messages import ended_topic, fill_pose, pose_template, time_message
from q2r2_control.ros.bridge.parameters import ArmParameters
from q2r2_control.ros.commanders import OnePublisher
from q2r2_control.ros.monitoring import WatchedPublisher, node_of
from q2r2_control.supervision.target_stream import apart
from q2r2_control.supervision.tick_pacer import PoseRateLimiter
from q2r2_control.teleop.arm_states import ArmState

_GRAPH_PERIOD = 0.1  # of asking the graph for subscribers [s]
# After a subscriber appeared the graph is asked at every tick, because it knows an endpoint before it knows its node.
# Until the node is known nothing is sent: it may be the restarted controller, whose first target must not be a jump.
# If that takes longer than this, an engaged arm is paused [s].
_NAME_TIMEOUT = 3.0
_LAST_ON_ITS_WAY = 0.03  # a stream's last target and its end are on two topics: the end must not overtake it [s]
# A tool farther from a held target than this was moved by something else: the target is not repeated.
_HELD = 0.15, 0.6  # [m, rad]


class TargetOutput:
    """Publishes one arm's target to one controller, through a :class:`PoseRateLimiter`.

    The limiter starts at the tool, so engaging moves nothing. When the target ends the limiter brakes, and then the
    last pose is repeated or not, as the preset says. It is never repeated when the tool is elsewhere, nor to a
    controller that was restarted: both would be a jump.
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
        self._publisher = WatchedPublisher(node, PoseStamped, topic, values.listener_timeout)
        self.topic = self._publisher.topic_name  # as the graph knows it
        self._one = OnePublisher(node, [self.topic])
        self._unknown_node = Reason.of(ReasonKind.SUBSCRIBER_UNKNOWN, topic=self.topic)
        self._wrench = None
        if preset.zero_wrench is not None:
            wrench = preset.zero_wrench.format(ctrl=values.prefix)
            self._wrench = node.create_publisher(WrenchStamped, wrench, LATCHED_QOS)
        self.following = False  # a hand's target
        self.last_sent: pin.SE3 | None = None  # what the controller was asked for last, world frame; None: nothing
        self._ends = node.create_publisher(Empty, ended_topic(topic), SENT_COMMAND_QOS) if preset is BUILTIN else None
        self._sent_at = -math.inf  # the last target of a stream that has not ended yet [s]
        self._fault: Reason | None = None  # why the controller that is driven is not the one of before
        self._endpoints: set[bytes] = set()  # of the controller
        self._listeners = 0
        self._unknown = False  # a subscriber's node is not known yet
        self._asked_at = self._appeared_at = -math.inf  # the graph, and a subscriber [s]
        self.starts = 0  # how often the controller has appeared

    @property
    def sent(self) -> int:
        return self._publisher.sent

    @property
    def conflict(self) -> Reason | None:
        """A reason if there are other publishers of the same topic."""
        return self._one.conflict()

    @property
    def unready(self) -> Reason | None:
        """A reason if the topic has no subscriber, or one whose node is not known yet."""
        if self._publisher.listeners == 0:
            return Reason.of(ReasonKind.NO_SUBSCRIBER, topic=f"{self.topic} ({POSE})")
        return self._unknown_node if self._unknown and not self.following else None

    def take_fault(self, now: float) -> Reason | None:
        """Check the subscribers; returns once why the controller that is driven is not there any more."""
        listeners = self._present()
        if listeners > self._listeners or listeners == 0:
            self._appeared_at = now
            if not self.following:
                self.forget(now)  # a new subscriber must not get an old target
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
            self.forget(now)  # the controller is gone, and its successor must not get an old target
            return Reason.of(ReasonKind.CONTROLLER_SILENT, silence, controller=self._controller)
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
        """Publish for ``now`` [s]; returns what was published, in the world frame.

        ``target``: where the tool should be, None while paused; ``tool``: where it is; ``base``: the frame in which
        the controller reads its targets. All are in the world frame; the latter two are None while not known.
        ``decided``: see :func:`publish_in_time`; ``start``: where a stream begins, by default at its first target.
        ``state``: of the arm. The stream goes on while its operator may only begin to pause it, and then ends in order.
        A stream that stops in any other way has ceased, for which the built-in controller holds linked arms too.
        """
        if self._unknown or self._present() > self._listeners:
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
        if self._publisher.publish(fill_pose(self._template, base.actInv(pose), now), decided):
            self.last_sent, self._sent_at = pose, now
        return pose

    def _end_stream(self, state: ArmState, now: float) -> None:
        """Say that the stream ends where its operator paused the arm; what has ceased says nothing."""
        if self._ends is None or state is not ArmState.PAUSED:
            self._sent_at = -math.inf
        elif _LAST_ON_ITS_WAY < now - self._sent_at < math.inf:
            self._sent_at = -math.inf
            self._ends.publish(Empty())

    def forget(self, now: float) -> None:
        """Drop the held target; the next target begins a new stream."""
        self.following, self.last_sent, self._sent_at = False, None, -math.inf
        self.guard.reset(None, now)

    def _present(self) -> int:
        """Number of subscribers, also those that the graph lists before the publisher can send to them."""
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
            kind = ReasonKind.CONTROLLER_RESTARTED if appeared else ReasonKind.CONTROLLER_ENDED
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
    """Whether two poses are within ``distance`` [m] and ``angle`` [rad] of each other."""
    length, rotation = apart(pose, other)
    return length <= distance and rotation <= angle
