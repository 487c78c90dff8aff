"""The current pose of one frame in another, from /tf and /tf_static or from a topic of poses."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.serde import SerdeError
from tf2_msgs.msg import TFMessage

from q2r2_control.events import Reason
from q2r2_control.ros.base_node import STREAM_QOS, BaseNode
from q2r2_control.ros.bridge.messages import is_pose, pose_of_numbers
from q2r2_control.ros.bridge.wire import TransformNumbers, read_pose, transforms_reader
from q2r2_control.ros.monitoring import Publishers
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.target_stream import apart
from q2r2_control.supervision.targets import SequenceWatch

_TF, _TF_STATIC = "tf", "tf_static"
# If two publishers send poses of a frame that differ by more than this, they are about different robots [m], [rad].
_SAME = 0.05, 0.1
_REMEMBERED = 2.0  # A difference between two publishers is remembered for this time [s].
_PAUSE = 1.0  # After a silence of this time a publisher may have been restarted [s].
_KEPT = 16  # Number of messages that are kept, because another node of the process may have to read them too.


class ReadTransform:
    """One transform of a message on /tf."""

    __slots__ = ("_pose", "child_frame_id", "frame_id", "is_pose", "numbers")

    def __init__(self, read: TransformNumbers) -> None:
        self.child_frame_id, self.frame_id, self.numbers = _name(read.child), _name(read.parent), read.numbers
        self.is_pose = is_pose(self.numbers)  # False if a number is not finite, or the quaternion has no unit length.
        self._pose: pin.SE3 | None = None

    @property
    def pose(self) -> pin.SE3:
        """The pose. It is computed at its first use, because the poses of most links are never used."""
        if self._pose is None:
            self._pose = pose_of_numbers(self.numbers)
            assert self._pose is not None
        return self._pose


_read = transforms_reader()


@lru_cache(maxsize=_KEPT)
def read_transforms(message: bytes) -> Sequence[ReadTransform]:
    """Return the transforms in a serialized TFMessage, which is read once for all nodes; raises SerdeError."""
    return tuple(map(ReadTransform, _read(message)))


class Placement(NamedTuple):
    """The pose of a frame in another frame."""

    pose: pin.SE3
    received: float  # The oldest receipt time of its transforms [s]; inf if all of them are static.


class FrameTree:
    """The newest transforms, without interpolation and history."""

    def __init__(self) -> None:
        self._edges: dict[str, tuple[ReadTransform, float]] = {}  # By frame, its transform and receipt time [s].
        self._found: dict[tuple[str, str], Placement] = {}  # Placements that were found since the last transform.
        self._used: set[str] = set()  # Frames in the chains of transforms that were found.
        self._all = True  # True if the last search found no chain, so that any new transform may be needed.

    def set(self, transform: ReadTransform, received: float) -> None:
        """Store a transform with its receipt time [s], inf if it is static. Ignore it if its numbers are no pose."""
        if transform.is_pose:
            self._edges[transform.child_frame_id] = transform, received
            self._found.clear()

    def find(self, frame: str, within: str) -> Placement | None:
        """Return the pose of ``frame`` in ``within``; None if no chain of transforms connects them."""
        if (found := self._found.get((frame, within))) is not None:
            return found
        up = dict(self.upwards(within))
        passed = []
        for name, placement in self.upwards(frame):
            passed.append(name)
            if name in up:
                pose, received = up[name].pose.inverse() * placement.pose, min(up[name].received, placement.received)
                place = self._found[frame, within] = Placement(pose, received)
                self._used.update(up, passed)  # ``up`` contains all ancestors of ``name``.
                self._all = False
                return place  # The placement is remembered until the next transform, which clears all placements.
        self._all = True
        return None

    def wants(self, frame: str) -> bool:
        """Return whether the pose of ``frame`` is needed. The poses of most links are not needed."""
        return self._all or frame in self._used

    def moves_far(self, transform: ReadTransform) -> bool:
        """Return whether a transform is far from the last transform of the same frame."""
        before = self._edges.get(transform.child_frame_id)
        if before is None or not transform.is_pose:
            return False
        return any(np.greater(apart(before[0].pose, transform.pose), _SAME))

    def upwards(self, frame: str) -> Iterator[tuple[str, Placement]]:
        """Yield the frame and all its ancestors, each only once, together with the frame's pose in the ancestor."""
        frame, pose, received = _name(frame), pin.SE3.Identity(), math.inf
        seen: set[str] = set()
        while frame not in seen:
            yield frame, Placement(pose, received)
            seen.add(frame)
            if frame not in self._edges:
                return
            transform, at = self._edges[frame]
            pose, received, frame = transform.pose * pose, min(received, at), transform.frame_id


class FrameListener:
    """Keeps a :class:`FrameTree` up to date for a node, and notices two publishers that disagree about a frame.

    Publishers are distinguished by the sequence numbers of their messages, which some middlewares do not give. Two
    publishers of the same poses, such as robot_state_publisher beside a simulation, are allowed.
    """

    def __init__(self, node: Any) -> None:
        self.tree = FrameTree()
        self._node = node
        self._numbers: defaultdict[str, SequenceWatch] = defaultdict(SequenceWatch)  # Sequence numbers by frame.
        self._publishers = Publishers(node, [_TF])
        self._disagree: dict[str, float] = {}  # By disputed frame, the time of the last difference [s].
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, _TF, self._take, 100, raw=True)
        node.create_subscription(TFMessage, _TF_STATIC, self._take_fixed, latched, raw=True)

    def conflict(self, frame: str) -> Reason | None:
        """Return a reason while two publishers disagree about ``frame`` or its ancestors, else None."""
        if not self._disagree:
            return None
        now = time.monotonic()
        for name, _ in self.tree.upwards(frame):
            if now - self._disagree.get(name, -math.inf) <= _REMEMBERED:
                return Reason.of(RosReason.FRAME_DISPUTED, frame=name, publishers=self._publishers.of(_TF))
        return None

    def _take(self, message: bytes, info: Mapping[str, int | None]) -> None:
        received, now, number = self._node.now, time.monotonic(), info["publication_sequence_number"]
        for transform in self._read(_TF, message):
            frame = transform.child_frame_id
            if not self.tree.wants(frame):
                continue
            if number is not None:
                senders = self._numbers[frame].take(number, now, _PAUSE)
                if senders >= 2 and self.tree.moves_far(transform):
                    self._disagree[frame] = now
            self.tree.set(transform, received)

    def _take_fixed(self, message: bytes) -> None:
        for transform in self._read(_TF_STATIC, message):
            self.tree.set(transform, math.inf)

    def _read(self, topic: str, message: bytes) -> Sequence[ReadTransform]:
        try:
            return read_transforms(message)
        except SerdeError:  # The bytes are no valid message. This is a fault of the sender.
            self._node.drop(f"/{topic}", f"{len(message)} bytes")
            return ()


def _name(frame: str) -> str:
    return frame.lstrip("/")


class ToolFrame:
    """The pose of one frame on /tf, in the world frame."""

    def __init__(self, node: BaseNode, frame: str, tree: FrameTree, world: str, timeout: float) -> None:
        self._tree, self._frame, self._world, self._timeout = tree, frame, world, timeout
        self.received = -math.inf  # Receipt time of the newest pose [s].
        self._publishers = Publishers(node, [_TF])
        self.problem: Reason | None = None

    def at(self, now: float) -> pin.SE3 | None:
        """Return the newest pose at ``now`` [s]. If it is not known, return None, and ``problem`` says why."""
        placement = self._tree.find(self._frame, self._world)
        if placement is not None:
            self.received = placement.received
        if placement is None:
            self.problem = Reason.of(RosReason.NO_TRANSFORM, frame=self._frame, world=self._world)
        elif (age := now - placement.received) > self._timeout:
            source = self._publishers.source(_TF)
            self.problem = Reason.of(RosReason.TRANSFORM_OLD, frame=self._frame, source=source, age=age)
        else:
            self.problem = None
            return placement.pose
        return None


class PoseTopic:
    """The pose on a topic, in the world frame. The frame of the message is looked up on /tf."""

    def __init__(self, node: BaseNode, topic: str, tree: FrameTree, world: str, timeout: float) -> None:
        self._node, self._tree, self._world, self._timeout = node, tree, world, timeout
        # Frame, stamp [ns] and receipt time [s] of the newest message.
        self._newest: tuple[str, int, float] | None = None
        self._pose: pin.SE3 | None = None  # The newest pose, in the message's frame.
        self.topic, self._publishers = topic, Publishers(node, [topic])
        self.problem: Reason | None = None
        node.create_subscription(
            PoseStamped, topic, lambda message: self._take(message, node.now), STREAM_QOS, raw=True
        )

    def at(self, now: float) -> pin.SE3 | None:
        if self._newest is None:
            self.problem = Reason.of(RosReason.TOPIC_EMPTY, topic=self.topic)
            return None
        frame, _, received = self._newest
        if now - received > self._timeout:
            source = self._publishers.source(self.topic)
            self.problem = Reason.of(RosReason.TOPIC_SILENT, topic=self.topic, source=source, age=now - received)
            return None
        if frame in ("", self._world):
            placement: Placement | None = Placement(pin.SE3.Identity(), math.inf)
        else:
            placement = self._tree.find(frame, self._world)
        if self._pose is None:
            self.problem = Reason.of(RosReason.TOPIC_NOT_A_POSE, topic=self.topic)
        elif placement is None:
            self.problem = Reason.of(RosReason.NO_TRANSFORM, frame=f"{frame} of {self.topic}", world=self._world)
        else:
            self.problem = None
            return placement.pose * self._pose
        return None

    @property
    def received(self) -> float:
        """Receipt time of the newest message [s]; -inf if there is none."""
        return -math.inf if self._newest is None else self._newest[2]

    @property
    def stamp(self) -> int | None:
        """Stamp of the newest message by its sender's clock [ns]; None if there is none."""
        return None if self._newest is None else self._newest[1]

    def take_silence(self, now: float) -> Reason | None:
        """Return a reason once if poses came and have stopped, else None."""
        if self._newest is None or now - self._newest[2] <= self._timeout:
            return None
        self.at(now)
        self._newest = None
        return self.problem

    def _take(self, message: bytes, now: float) -> None:
        try:
            read = read_pose(message)
        except SerdeError as error:  # The bytes are no valid message. This is a fault of the sender.
            self._node.drop(self.topic, str(error))
            return
        self._newest, self._pose = (read.frame, read.stamp, now), pose_of_numbers(read.numbers)
