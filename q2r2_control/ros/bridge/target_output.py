"""The last step before a controller that is not ours: it gets targets on its own terms, or none."""

from __future__ import annotations

import math

import pinocchio as pin
from geometry_msgs.msg import PoseStamped, WrenchStamped

from q2r2_control.config.presets import Hold, Preset
from q2r2_control.config.teleop import GuardSettings
from q2r2_control.ros.base_node import LATCHED_QOS, BaseNode
from q2r2_control.ros.bridge.messages import stamped_pose, time_message
from q2r2_control.ros.monitoring.endpoints import WatchedPublisher
from q2r2_control.supervision.target_stream import apart
from q2r2_control.teleop.guard import TargetGuard

_GRAPH_PERIOD = 0.1  # between two looks at who else is there [s]
# After somebody came every tick looks, since names are known later than endpoints. Until they are known nothing is
# sent: it may be the controller, started anew, and what it is asked for first must not be a jump. After this long that
# pauses an arm that is engaged [s].
_ALERT = 3.0
_NAMELESS = "_NODE_NAME_UNKNOWN_"  # as rcl says it
# A tool farther from a held target than this was moved by something else, and the target is not asked for again.
_HELD = 0.15, 0.6  # [m, rad]


class TargetOutput:
    """Publishes one arm's target to one controller.

    While there is a target it is followed by a :class:`TargetGuard`, which starts where the tool is, so engaging moves
    nothing. When there is none any more the guard brakes, and then the last pose is repeated
    or not, as the preset says. It is never repeated to a tool that has gone elsewhere, nor to a controller that was
    started anew: both would be a jump.
    """

    def __init__(
        self,
        node: BaseNode,
        preset: Preset,
        controller: str,
        topic: str,
        frame: str,
        guard: GuardSettings,
        listener_timeout: float,
        prefix: str = "",
    ) -> None:
        self.preset = preset
        self.guard = TargetGuard(guard)
        self._node, self._controller, self._frame = node, controller, frame
        self._publisher = WatchedPublisher(node, PoseStamped, topic, listener_timeout)
        self._wrench = None
        if preset.zero_wrench is not None:
            self._wrench = node.create_publisher(WrenchStamped, preset.zero_wrench.format(ctrl=prefix), LATCHED_QOS)
        self.following = False  # a hand's target
        self._restarted = False
        self._endpoints: set[bytes] = set()  # of the controller
        self._listeners = 0
        self._strange = False  # somebody listens who is not known yet
        self._looked = self._came = -math.inf
        self.sent = 0
        self.lives = 0  # how often the controller was seen to come

    @property
    def topic(self) -> str:
        """Where the targets go."""
        return self._publisher.topic_name

    @property
    def others(self) -> int:
        """Publishers of the same topic besides this one."""
        return max(0, self._node.count_publishers(self.topic) - 1)

    @property
    def conflict(self) -> str | None:
        """One line on publishers that should not be there."""
        if self.others == 0:
            return None
        return f"{self.others + 1} publishers of {self.topic}, allowed is one (a killed one counts for some seconds)"

    @property
    def unheard(self) -> str | None:
        """One line where nobody takes the targets, or it is not known yet who will."""
        if self._publisher.listeners == 0:
            return f"nobody listens to {self.topic}"
        strange = self._strange and not self.following
        return f"it is not known who listens to {self.topic}" if strange else None

    def take_fault(self, now: float) -> str | None:
        """Look who is there; says once that the controller was started anew, or is gone, while it was driven."""
        listeners = self._present
        if listeners > self._listeners or listeners == 0:
            self._came = now
            if not self.following:
                self.forget(now)  # whoever it is, it is not to be greeted with a target of the past
        self._listeners = listeners
        if self._strange or now - self._came < _ALERT or not 0.0 <= now - self._looked <= _GRAPH_PERIOD:
            self._looked = now
            self._look(now)
        if self._strange and self.following and now - self._came > _ALERT:
            self.forget(now)
            return f"it is not known who listens to {self.topic}"
        restarted, self._restarted = self._restarted, False
        if restarted:
            return f"{self._controller} was started anew"
        silence = self._publisher.silence() if self.following else None
        if silence is not None:
            self.forget(now)  # it is gone, and whoever comes is not to be asked for a target of the past
            return f"{self._controller}: {silence}"
        return None

    def step(
        self,
        target: pin.SE3 | None,
        tool: pin.SE3 | None,
        base: pin.SE3 | None,
        now: float,
        start: pin.SE3 | None = None,
    ) -> pin.SE3 | None:
        """Publish for ``now`` [s]; returns what was published, in the world frame.

        ``target``: where the tool should be, None: nowhere new; ``tool``: where it is; both in the world frame, as is
        ``base``, the frame that the controller reads its targets in. None of the latter two: not known.
        ``start``: where a stream begins that does not begin at its first target.
        """
        if self._strange or self._present > self._listeners:
            return None
        idle = not self.following and self.guard.at_rest
        self.following = target is not None
        if target is not None and idle:
            self.guard.reset(target if start is None else start, now)
            self._publisher.begin()
            self._send_zero_wrench(now)
        pose = self.guard.step(target, now)
        if pose is None or base is None or not (self.following or not self.guard.at_rest or self._holds(tool, now)):
            return None
        if not (self.following and self._publisher.waits()):
            self._publisher.publish(stamped_pose(base.actInv(pose), self._frame, now))
            self.sent += 1
        return pose

    def forget(self, now: float) -> None:
        """Hold nothing any more; the next target starts anew."""
        self.following = False
        self.guard.reset(None, now)

    @property
    def _present(self) -> int:
        """How many listen; the graph knows of one before anything can be sent to it."""
        return max(self._publisher.listeners, self._node.count_subscribers(self.topic))

    def _holds(self, tool: pin.SE3 | None, now: float) -> bool:
        """Whether the last target is repeated."""
        if self.guard.pose is None:
            return False
        if tool is None or not near(self.guard.pose, tool, *_HELD):
            self.forget(now)
            return False
        return self.preset.hold is Hold.REPEAT

    def _look(self, now: float) -> None:
        """Notice a controller that has come."""
        found = self._node.get_subscriptions_info_by_topic(self.topic)
        self._strange = len(found) < self._listeners or any(info.node_name == _NAMELESS for info in found)
        endpoints = {
            bytes(info.endpoint_gid)
            for info in found
            if f"{info.node_namespace.rstrip('/')}/{info.node_name}" == self._controller
        }
        if endpoints - self._endpoints:
            self.lives += 1
            self._restarted = self.following
            self.forget(now)
            self._send_zero_wrench(now)
        self._endpoints = endpoints

    def _send_zero_wrench(self, now: float) -> None:
        if self._wrench is not None:
            message = WrenchStamped()
            message.header.frame_id = self._frame
            message.header.stamp = time_message(now)
            self._wrench.publish(message)


def near(pose: pin.SE3, other: pin.SE3, distance: float, angle: float) -> bool:
    """Whether two poses are within ``distance`` [m] and ``angle`` [rad] of each other."""
    way, turn = apart(pose, other)
    return way <= distance and turn <= angle
